"""Controllers of the middle-point temperature, in NumPy alone."""

from agents.controller import Controller
from agents.direct_nn import DirectNNController
from agents.pi import PIController
from agents.policy_network import PolicyNetwork
from agents.self_tuning import SelfTuningController
from agents.smith import SmithPredictor

__all__ = [
    "Controller",
    "DirectNNController",
    "PIController",
    "PolicyNetwork",
    "SelfTuningController",
    "SmithPredictor",
]
