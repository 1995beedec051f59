"""Compute the least possible mean error of any case of the environment, and scores from it.

README.md says what each kind holds for. The mean error is that of the rewards, of |e(k)| over
k = 1 to N. A controller at k may know the transmitter's readings up to k, and perhaps any set
points, plant numbers and loads up to k, but not the true output, `info["output"]`. It may undo
the dead zone.
"""

from contextlib import closing, suppress
from dataclasses import asdict, dataclass
from functools import cache, partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from benchmarks.bounds.linear_program import SMOOTH, TAIL, plan, reference
from benchmarks.bounds.unknown import unknown
from benchmarks.lib.errors import NoBoundError
from benchmarks.lib.statistics import Estimate, student
from benchmarks.loop.linear import LinearModel
from benchmarks.loop.rollout import (
    IdleValve,
    drawn_numbers,
    is_random,
    make_plants,
    rollout,
)
from mptc_gym import Parameters
from mptc_gym.draws import plant_numbers
from mptc_gym.evaluation import EPISODES, SEED
from mptc_gym.parameters import PlantNumbers

Array = NDArray[np.float64]

KINDS = "preview", "causal", "reference"


@dataclass(frozen=True)
class LeastPossible(Estimate):
    """The least possible mean |e| of a case, degC, with a 95 % interval over drawn episodes.

    The ends of the interval equal `value` where nothing is drawn.
    """

    kind: str  # one of `KINDS`
    idle: Estimate  # mean |e| of the same episodes without control, degC
    # Terms of the mean, degC; element i is for the episode of seed `seed + i`. For the kind
    # "causal" only their mean is a bound.
    episodes: tuple[float, ...]

    def score(self, errors: ArrayLike) -> Array:
        """Return scores of mean errors, degC: 0 without control, 1 for `value`.

        A single run may exceed 1 by chance. A ValueError is raised if nothing is better than no
        control.
        """
        idle = self.idle.value
        if idle - self.value <= 1e-9 * max(idle, 1.0):
            raise ValueError(f"there is nothing to gain: doing nothing gives {idle:g} °C")
        scores: Array = (idle - np.asarray(errors, np.float64)) / (idle - self.value)
        return scores


def least_possible(
    *,
    samples: int,
    kind: str | None = None,
    episodes: int = EPISODES,
    seed: int = SEED,
    **arguments: Any,
) -> LeastPossible:
    """Return the least possible mean |e(k)| over k = 1 to `samples`.

    Parameters
    ----------
    samples
        N, length of an episode.
    kind
        One of `KINDS`: "causal" is for random set points alone, "reference" for those that the
        plant settles at before they change; otherwise a `NoBoundError` is raised. None chooses
        as reports and `mptc_gym.evaluate` do: "causal" for random set points; otherwise
        "reference", or "preview" if there is none or if both are the same.
    episodes
        Number of episodes, if anything is drawn.
    seed
        Episode i is the one that the environment draws with seed `seed + i`. The defaults are
        the episodes of `mptc_gym.evaluate`.
    **arguments
        Arguments of the environment.
    """
    parameters = Parameters(**arguments)
    for name, count in (("samples", samples), ("episodes", episodes)):
        if not isinstance(count, int) or count < 1:
            raise ValueError(f"{name} must be an integer of at least 1, got {count!r}")

    of = partial(_least_possible, parameters, samples, episodes, seed)
    drawn = parameters.setpoint == "random"
    kinds = KINDS if drawn else ("preview", "reference")
    if kind in kinds or (drawn and kind is None):
        return of(kind or "causal")
    if kind is not None:
        allowed = f"{', '.join(kinds)} for the set point {parameters.setpoint!r}"
        raise NoBoundError(f"kind must be one of {allowed}, got {kind!r}")
    preview = of("preview")
    with suppress(NoBoundError):  # the plant does not settle between changes
        unaware = of("reference")
        # Foresight makes no difference where nothing changes.
        return unaware if abs(unaware.value - preview.value) >= 1e-4 else preview
    return preview


@cache  # as a report asks for several kinds of a case
def _least_possible(
    parameters: Parameters, samples: int, episodes: int, seed: int, kind: str
) -> LeastPossible:
    # The episodes that the environment draws, with the valve left alone.
    runs = episodes if is_random(parameters) else 1
    numbers = drawn_numbers(parameters, runs, seed)
    with closing(make_plants(runs, samples + 1, **asdict(parameters))) as plants:
        alone = IdleValve(numbers.u_min, numbers.u_max)
        trajectory = rollout(plants, alone, samples + 1, seed)
    drawn = parameters.ranges or parameters.setpoint == "random"
    # Rounded to be the same on every machine, as solvers differ in later digits.
    values = tuple(
        round(_least(parameters, kind, plant_numbers(numbers, i), setpoint) / samples, 6)
        for i, setpoint in enumerate(trajectory.setpoint.T[: episodes if drawn else 1])
    )
    idle = student(np.abs(trajectory.setpoint - trajectory.output)[1:].mean(axis=0))
    return LeastPossible(**vars(student(values)), kind=kind, idle=idle, episodes=values)


def _least(
    parameters: Parameters, kind: str, numbers: PlantNumbers[float], setpoint: Array
) -> float:
    """Return the least sum of |e(k)| over k = 1 to N of an episode, degC."""
    # A reference looks beyond the end.
    ahead = int(numbers.delay) + len(parameters.b) + TAIL if kind == "reference" else 0
    model = LinearModel(parameters, numbers, np.arange(len(setpoint) + ahead))
    unforeseen = unknown(model)
    if kind == "reference":
        error, flow = reference(model, unforeseen, setpoint)
        price = SMOOTH * np.abs(np.diff(flow, prepend=0.0))
    else:
        penalty = np.zeros(len(setpoint))
        if kind == "causal" and parameters.setpoint_amplitude > 0.0:
            from benchmarks.bounds.causal import SetPointLaw  # here: few cases need it

            penalty = SetPointLaw(model, unforeseen).penalty(setpoint)
        error, flow = plan(model, unforeseen, setpoint, penalty=penalty)
        price = penalty * flow
    return float(error[1:].sum() + price.sum())  # no flow changes e(0)
