"""Controllers for the middle-point temperature of a once-through boiler."""

from agents.controller import Controller
from agents.dahlin import DahlinController
from agents.direct_nn import DirectNNController, Weights
from agents.networks import PolicyNetwork
from agents.pi import PIController
from agents.self_tuning import SelfTuningController
from agents.smith import SmithPredictor

__all__ = [
    "Controller",
    "DahlinController",
    "DirectNNController",
    "PIController",
    "PolicyNetwork",
    "SelfTuningController",
    "SmithPredictor",
    "Weights",
]
