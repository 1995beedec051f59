"""Controllers for the middle-point temperature of a once-through boiler."""

from .controller import Controller
from .dahlin import DahlinController
from .direct_nn import DirectNNController, Weights
from .networks import PolicyNetwork
from .pi import PIController
from .self_tuning import SelfTuningController
from .smith import SmithPredictor

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
