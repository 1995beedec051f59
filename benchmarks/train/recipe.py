"""Define the recipes by which the project's policies are trained, and the policies' inputs.

The dict `RECIPES` has a recipe `ppo` for the paper's plant, and a recipe `ppo-hard` for plants
that differ between episodes. `for_plant` adapts the recipe `ppo` to another plant. The module
`benchmarks.train.ppo` trains by a recipe.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.controllers.known_plant import PAPER, KnownPlant
from mptc_gym import FOR_LEARNING, PRESETS, Parameters

Array = NDArray[np.float64]

# Change of the flow per sample at an action of 1, as a share of half the actuator's range: with
# 2.0, the flow can cross the entire range in a sample.
MAX_MOVE = 2.0
SETPOINT_SCALE = 0.2  # from degC to an input of order 1


class TrainingPlants(NamedTuple):
    """Training plants of one kind."""

    number: int  # number of plants
    arguments: Mapping[str, Any]  # arguments of the environment for these plants


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """Settings for the training of a policy by PPO."""

    plants: tuple[TrainingPlants, ...]  # the kinds of training plants
    # Arguments of the environment for each case of the validation, by name. No published result
    # uses these cases.
    cases: Mapping[str, Mapping[str, Any]]
    # Arguments of the environment for the plants on which policies are scored during training.
    scored_on: Mapping[str, Any]
    # The environment's argument `compensated_dead_zone`, t/h. Unless it is 0, a comparison
    # replaces it by the half width of the plant's dead zone, if that is not a range.
    dead_zone: float
    # Whether the policy's inputs include the set point and the flow, in addition to the error
    # and to changes of set point, temperature and flow.
    levels: bool
    hidden: tuple[int, ...]  # nodes of the policy's hidden layers; () for a linear policy
    memory: int  # number of past temperatures, and of past flows, in the observation
    steps: int  # samples of experience, summed over all plants
    # Natural logarithm of the standard deviation of the action, at the start and at the end of
    # the training.
    log_std: tuple[float, float] = (-1.2, -3.5)
    # Arguments of the environment for the plant to which `for_plant` has adapted the recipe.
    plant: Mapping[str, Any] = field(default_factory=dict)

    @property
    def windows(self) -> dict[str, Any]:
        """The arguments of the environment that determine the policy's observation."""
        return {
            "setpoint_window": 3,
            "error_window": 1,
            "output_window": self.memory,
            "action_window": self.memory,
        }

    @property
    def interface(self) -> dict[str, Any]:
        """The arguments of the environment that determine observations and actions."""
        return {
            "action": FOR_LEARNING["action"],
            "max_move": MAX_MOVE,
            "compensated_dead_zone": self.dead_zone,
            **self.windows,
        }

    @property
    def temperature_scale(self) -> float:
        """The plant's temperatures as a multiple of those of the paper's plant."""
        amplitude: float = Parameters(**self.plant).setpoint_amplitude
        return amplitude / PAPER.parameters.setpoint_amplitude


# An error of `error_scale`, degC, has the reward -1. With this scale, returns are of order 1,
# so that the value function is learnt quickly.
_COST: dict[str, Any] = {"reward": FOR_LEARNING["reward"], "error_scale": 50.0}
_RANDOM: dict[str, Any] = {
    **_COST,
    "setpoint": FOR_LEARNING["setpoint"],
    "setpoint_amplitude": 6.0,
}
_NOISE = 0.6  # noise variance of most training plants of the recipe `ppo`, degC^2
# The square wave of the validation differs from that of the published results.
_VALIDATION: dict[str, Any] = {"setpoint_amplitude": 5.4, "setpoint_period": 500}

RECIPES = {
    "ppo": Recipe(
        plants=(
            TrainingPlants(152, _RANDOM),
            TrainingPlants(360, {**_RANDOM, "noise_variance": _NOISE}),
        ),
        cases={"calm": _VALIDATION, "noise": {**_VALIDATION, "noise_variance": 0.4}},
        scored_on=PRESETS["noisy"],
        dead_zone=5.0,
        levels=False,
        hidden=(),
        memory=192,
        steps=5_000_000,
        log_std=(-1.2, -4.0),
    ),
    "ppo-hard": Recipe(
        plants=(TrainingPlants(512, {**PRESETS["hard"], **_COST, "setpoint_amplitude": 5.5}),),
        cases={"hard": {**PRESETS["hard"], "setpoint_amplitude": 5.5, "setpoint_period": 560}},
        scored_on=PRESETS["hard"],
        dead_zone=0.0,
        levels=True,
        hidden=(64, 64),
        memory=64,
        steps=4_000_000,
    ),
}


def for_plant(plant: Mapping[str, Any]) -> Recipe:
    """Return the recipe `ppo`, adapted to a plant that differs from the paper's plant.

    In the adapted recipe, set points, errors and temperatures are scaled in proportion to the
    plant's argument `setpoint_amplitude`. If the plant has no noise, most training plants get
    noise, whose standard deviation is in proportion to the steady temperature change by half
    the flow range.

    Parameters
    ----------
    plant
        Arguments of the environment for the plant.
    """
    recipe = replace(RECIPES["ppo"], plant=plant)
    scale = recipe.temperature_scale
    known = KnownPlant(plant)
    calm, noisy = recipe.plants  # the two kinds of the recipe `ppo`
    training = {
        **plant,
        **_RANDOM,
        "error_scale": _COST["error_scale"] * scale,
        "setpoint_amplitude": _RANDOM["setpoint_amplitude"] * scale,
    }
    noise = {}
    if known.parameters.range_of("noise_variance")[1] == 0.0:  # the plant never has noise
        ratio = known.temperature_range / PAPER.temperature_range
        noise["noise_variance"] = _NOISE * ratio**2
    # A period of 500 samples for the paper's 600, and always an even number of samples.
    half_period = max(1, round(known.parameters.setpoint_period * 500 / 1200))
    validation = {
        **plant,
        "setpoint": "square",
        "setpoint_amplitude": _VALIDATION["setpoint_amplitude"] * scale,
        "setpoint_period": 2 * half_period,
    }
    return replace(
        recipe,
        plants=(calm._replace(arguments=training), noisy._replace(arguments=training | noise)),
        cases={"plant": validation},
        scored_on=validation,
        dead_zone=known.dead_zone,
    )


def inputs(recipe: Recipe) -> Array:
    """Return the matrix that converts an observation to the inputs of the policy.

    The matrix has the shape (number of inputs, length of an observation). The inputs, which are
    of order 1, are the control error; the changes of set point, temperature and flow; and, if
    `recipe.levels` is true, the set point and the flow.
    """
    lengths = [*recipe.windows.values()]
    # Row i of the identity matrix selects element i of an observation.
    identity = np.eye(sum(lengths))
    identity[: -recipe.memory] /= recipe.temperature_scale  # all elements but the flows
    # The rows of each window of the observation, the newest sample first.
    setpoints, error, temperatures, flows = np.split(identity, np.cumsum(lengths[:-1]))
    rows = [
        error,
        SETPOINT_SCALE * changes(len(setpoints), short_stretches=3) @ setpoints,
        0.5 * changes(len(temperatures), short_stretches=8) @ temperatures,
        changes(len(flows), short_stretches=30) @ flows,
    ]
    if recipe.levels:
        rows += [SETPOINT_SCALE * setpoints[:1], flows[:1]]  # the newest of each
    return np.vstack(rows)


def changes(length: int, short_stretches: int) -> Array:
    """Return the matrix that converts a signal to its changes between stretches of samples.

    The matrix, shape (stretches - 1, length), is for the latest `length` samples of the signal,
    newest first. A change is the mean over a stretch of samples minus the mean over the
    next older stretch. The newest `short_stretches` stretches have one sample each, older
    stretches have 2, 4, 8 and so on, and the oldest stretch has the remaining samples.
    """
    lengths = [1] * short_stretches
    while remaining := length - sum(lengths):
        lengths.append(min(2 * lengths[-1], remaining))
    means = np.zeros((len(lengths), length))
    for row, (first, stop) in enumerate(pairwise(np.cumsum([0, *lengths]))):
        means[row, first:stop] = 1.0 / (stop - first)
    return means[:-1] - means[1:]
