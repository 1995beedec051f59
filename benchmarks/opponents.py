"""Controllers to compare with, as an engineer would set them up for this plant."""

from __future__ import annotations

from dataclasses import dataclass

from agents import PIController, SmithPredictor
from agents.pi import SEARCHED_GAINS
from benchmarks.mpc import PredictiveController
from mptc_gym import Parameters

# The plant as a step test shows it: steady-state gain -0.0496 / 0.0727 degC per t/h, the time
# constant of the pole at 0.9515, and 19 samples until an input shows.
STEP_TEST = {"gain": -0.6825, "time_constant": 161.0, "delay": 152.0}


def simc_pi(u_min: float, u_max: float) -> PIController:
    """Return a PI controller tuned by rule, from the step test alone."""
    return PIController.simc(**STEP_TEST, u_min=u_min, u_max=u_max)


def searched_pi(u_min: float, u_max: float) -> PIController:
    """Return the paper's PI controller with the gains of `python -m benchmarks.tune pi`."""
    return PIController(**SEARCHED_GAINS, u_min=u_min, u_max=u_max)


def smith(u_min: float, u_max: float) -> SmithPredictor:
    """Return a Smith predictor: half the plant's time constant, the nominal dead zone."""
    return SmithPredictor(
        **STEP_TEST,
        closed_loop_time_constant=80.0,
        dead_zone=Parameters().dead_zone,
        u_min=u_min,
        u_max=u_max,
    )


def mpc(parameters: Parameters, num_envs: int) -> PredictiveController:
    """Return the predictive controller that knows all but the future."""
    return PredictiveController(parameters, num_envs)


@dataclass(frozen=True)
class Account:
    """What a controller costs before it runs.

    Attributes
    ----------
    told
        What it is told about the plant.
    parameters
        How many numbers shape it: gains, and weights if it has any.
    samples
        Samples of the plant, or of a simulated one, that went into tuning and training.
    """

    told: str
    parameters: str
    samples: str


ACCOUNTS: dict[str, Account] = {
    "nn": Account(
        "direction; gains searched on this plant", "25 weights, 6 gains", "566 M (search)"
    ),
    "pi": Account("gains of the paper", "2", "not stated"),
    "pi-simc": Account("gain, time constant, delay", "2", "one step test"),
    "pi-searched": Account("gains searched on this plant", "2", "566 M (search)"),
    "smith": Account(
        "gain, time constant, delay, dead zone, limits",
        "2 gains, 5 of the model",
        "one step test",
    ),
    "mpc": Account("everything but the future", "all of the plant's", "none"),
    "ppo": Account(
        "delay, by the past actions it sees",
        "6,081 weights a policy",
        "1 M a policy",
    ),
}
