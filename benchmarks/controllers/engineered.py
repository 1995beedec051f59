"""Make controllers as an engineer would set them up for a plant, and the paper's network."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents import (
    DirectNNController,
    NeuralSelfTuningController,
    NeuralSmithPredictor,
    PIController,
    SelfTuningController,
    SmithPredictor,
)
from agents.pi import SEARCHED_GAINS
from benchmarks.controllers.mpc import PredictiveController
from benchmarks.controllers.records import Factory
from benchmarks.controllers.step_test import step_test
from benchmarks.loop.linear import nominal
from mptc_gym import Parameters
from mptc_gym.plant import action_from_command


class Nothing:
    """Leaves the valve where it is, at 0 t/h at first, given the actuator's limits, t/h."""

    def __init__(self, u_min: float = -10.0, u_max: float = 10.0) -> None:
        self.u_min, self.u_max = u_min, u_max
        self.flow = 0.0  # t/h

    def reset(self) -> None:
        """Put the valve back to 0 t/h."""
        self.flow = 0.0

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the action of the flow, shape (runs, 1)."""
        action = action_from_command(self.flow, self.u_min, self.u_max)
        return np.full((len(observation), 1), action, np.float32)


def limits(plant: Parameters) -> dict[str, Any]:
    """Return the limits of the flow, the widest if they are drawn."""
    return {"u_min": plant.range_of("u_min")[0], "u_max": plant.range_of("u_max")[1]}


def step_test_and_data_sheet(plant: Parameters) -> dict[str, Any]:
    """Return what a step test shows and what the actuator's data sheet says.

    The dead zone is the middle of one that is drawn.
    """
    dead_zone = sum(plant.range_of("dead_zone")) / 2
    return {**asdict(step_test(plant)), **limits(plant), "dead_zone": dead_zone}


def nothing(plant: Parameters, runs: int, seed: int) -> Nothing:
    """Return what leaves the valve alone."""
    return Nothing(**limits(plant))


def direct_nn(plant: Parameters, runs: int, seed: int, **gains: Any) -> DirectNNController:
    """Return the paper's network, which is told the direction of the plant's response."""
    direction = 1 if nominal(plant).gain > 0.0 else -1
    return DirectNNController(
        num_envs=runs, seed=seed, direction=direction, **limits(plant), **gains
    )


def frozen_nn(plant: Parameters, runs: int, seed: int) -> DirectNNController:
    """Return the paper's network once it has learnt, on the plant that it is made for."""
    controller = Factory(direct_nn, learns=True).in_service(asdict(plant), runs, seed)
    assert isinstance(controller, DirectNNController)
    controller.learning = False
    return controller


def paper_pi(plant: Parameters, runs: int, seed: int, **gains: Any) -> PIController:
    """Return the paper's PI controller, with its own gains or others."""
    return PIController(**gains, **limits(plant))


def searched_pi(plant: Parameters, runs: int, seed: int) -> PIController:
    """Return the paper's PI controller with the gains of `python -m benchmarks.tune pi`."""
    return paper_pi(plant, runs, seed, **SEARCHED_GAINS)


def simc_pi(plant: Parameters, runs: int = 1, seed: int = 0) -> PIController:
    """Return a PI controller tuned by rule, from a step test of the plant alone."""
    return PIController.simc(**asdict(step_test(plant)), **limits(plant))


def smith(plant: Parameters, runs: int = 1, seed: int = 0) -> SmithPredictor:
    """Return a Smith predictor whose closed loop has half the plant's time constant."""
    known = step_test_and_data_sheet(plant)
    half = float(f"{known['time_constant'] / 2:.2g}")
    return SmithPredictor(**known, closed_loop_time_constant=half)


def self_tuning(plant: Parameters, runs: int, seed: int) -> SelfTuningController:
    """Return a self-tuning controller that starts from what a step test shows."""
    return SelfTuningController(**step_test_and_data_sheet(plant))


def nn_smith(plant: Parameters, runs: int = 1, seed: int = 0) -> NeuralSmithPredictor:
    """Return the network behind a model, told what a Smith predictor is told."""
    return NeuralSmithPredictor(**step_test_and_data_sheet(plant))


def nn_self_tuning(plant: Parameters, runs: int, seed: int) -> NeuralSelfTuningController:
    """Return the network behind a bank of models that starts from what a step test shows."""
    return NeuralSelfTuningController(**step_test_and_data_sheet(plant))


def mpc(plant: Parameters, runs: int, seed: int) -> PredictiveController:
    """Return the predictive controller, which knows everything except the future."""
    return PredictiveController(plant, runs, seed)
