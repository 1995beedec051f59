"""Provide controllers for the middle-point temperature, independent of the environment."""

from agents.controller import Controller
from agents.dahlin import DahlinController
from agents.direct_nn import DirectNNController, Weights
from agents.networks import Increments, PolicyNetwork
from agents.neural_law import LawNetwork, NeuralSmithPredictor
from agents.neural_self_tuning import NeuralSelfTuningController
from agents.pi import PIController
from agents.self_tuning import SelfTuningController
from agents.smith import SmithPredictor

__all__ = [
    "Controller",
    "DahlinController",
    "DirectNNController",
    "Increments",
    "LawNetwork",
    "NeuralSelfTuningController",
    "NeuralSmithPredictor",
    "PIController",
    "PolicyNetwork",
    "SelfTuningController",
    "SmithPredictor",
    "Weights",
]
