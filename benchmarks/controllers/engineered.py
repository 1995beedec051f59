"""Controllers as an engineer would set them up, from a step test of the plant."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents import DirectNNController, PIController, SelfTuningController, SmithPredictor
from agents.pi import SEARCHED_GAINS
from benchmarks.controllers.mpc import PredictiveController
from benchmarks.controllers.step_test import step_test
from benchmarks.linear import nominal
from mptc_gym import Parameters


class Nothing:
    """Leaves the valve where it is.

    Parameters
    ----------
    u_min, u_max
        The actuator's limits, t/h.
    """

    def __init__(self, u_min: float = -10.0, u_max: float = 10.0) -> None:
        self._action = np.float32(-(u_max + u_min) / (u_max - u_min))

    def reset(self) -> None:
        """Do nothing."""

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return actions of 0 t/h, shape (runs, 1)."""
        return np.full((len(observation), 1), self._action, np.float32)


def direct_nn(
    parameters: Parameters, num_envs: int, seed: int, u_min: float, u_max: float, **gains: Any
) -> DirectNNController:
    """Return the paper's network, which is told the direction of the plant's response."""
    direction = 1 if nominal(parameters).gain > 0.0 else -1
    return DirectNNController(
        num_envs=num_envs, seed=seed, u_min=u_min, u_max=u_max, direction=direction, **gains
    )


def simc_pi(parameters: Parameters, u_min: float, u_max: float) -> PIController:
    """Return a PI controller tuned by rule, from a step test of the plant alone."""
    return PIController.simc(**asdict(step_test(parameters)), u_min=u_min, u_max=u_max)


def searched_pi(u_min: float, u_max: float) -> PIController:
    """Return the paper's PI controller with the gains of `python -m benchmarks.tune pi`."""
    return PIController(SEARCHED_GAINS["kp"], SEARCHED_GAINS["ki"], u_min=u_min, u_max=u_max)


def smith(parameters: Parameters, u_min: float, u_max: float) -> SmithPredictor:
    """Return a Smith predictor whose model comes from a step test of the plant.

    Its closed loop has half the plant's time constant. It knows what the actuator's data sheet
    says: the limits and the dead zone, the middle of it if it is a range.
    """
    tested = step_test(parameters)
    return SmithPredictor(
        **asdict(tested),
        closed_loop_time_constant=float(f"{tested.time_constant / 2:.2g}"),
        dead_zone=sum(parameters.range_of("dead_zone")) / 2,
        u_min=u_min,
        u_max=u_max,
    )


def self_tuning(parameters: Parameters, u_min: float, u_max: float) -> SelfTuningController:
    """Return a self-tuning controller that starts from what a step test shows."""
    return SelfTuningController(
        **asdict(step_test(parameters)),
        dead_zone=sum(parameters.range_of("dead_zone")) / 2,
        u_min=u_min,
        u_max=u_max,
    )


def mpc(parameters: Parameters, num_envs: int, seed: int = 0) -> PredictiveController:
    """Return the predictive controller, which knows everything except the future."""
    return PredictiveController(parameters, num_envs, seed)
