"""Compute the least possible mean error of any case of the environment, and scores from it.

README.md says what each kind holds for. The mean error is that of the rewards, of |e(k)| over
k = 1 to N. A controller at k may know the transmitter's readings up to k, and perhaps any set
points, plant numbers and loads up to k, but neither the true output, `info["output"]`, nor when
the load jumps next. It may undo the dead zone.
"""

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from benchmarks.bounds.hidden import unknown_of_hidden_load, unknown_of_normal_load
from benchmarks.bounds.linear_program import SMOOTH, TAIL, Unknown, plan, reference
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
    idle: Estimate  # mean |e| of the same episodes with an idle valve, degC
    # Terms of the mean, degC; element i is for the episode of seed `seed + i`. For the kind
    # "causal" only their mean is a bound.
    episodes: tuple[float, ...]

    def score(self, errors: ArrayLike) -> Array:
        """Return scores of mean errors, degC: 0 for an idle valve, 1 for `value`.

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
        "reference", or "preview" if there is none or if the set point never changes.
    episodes
        Number of episodes, if anything is drawn.
    seed
        Episode i is the one that the environment draws with seed `seed + i`. The defaults are
        the episodes of `mptc_gym.evaluate`.
    **arguments
        Arguments of the environment.

    Raises
    ------
    NoBoundError
        If the case has no bound of this kind: "causal" is for random set points alone,
        "reference" for those that the plant settles at before they change.
    ValueError
        If an argument is out of its range.
    """
    parameters = Parameters(**arguments)
    for name, count in (("samples", samples), ("episodes", episodes)):
        if not isinstance(count, int) or count < 1:
            raise ValueError(f"{name} must be an integer of at least 1, got {count!r}")
    if kind is not None and kind not in KINDS:
        raise ValueError(f"kind must be one of {', '.join(KINDS)}, got {kind!r}")
    of_kind = partial(_least_possible, parameters, samples, episodes, seed)
    random_setpoint = parameters.setpoint == "random"
    if kind == "causal" and not random_setpoint:
        raise NoBoundError(
            f"kind must be preview or reference, as the set point {parameters.setpoint!r} has "
            f"no law, got {kind!r}"
        )
    if kind is not None:
        return of_kind(kind)
    if random_setpoint:
        return of_kind("causal")
    # Foresight makes no difference where nothing changes.
    if np.ptp(_draw(parameters, samples, 1, seed).setpoints) == 0.0:
        return of_kind("preview")
    try:
        return of_kind("reference")
    except NoBoundError:  # the plant does not settle between changes
        return of_kind("preview")


def with_hidden_load(
    *,
    samples: int,
    kind: str | None = None,
    episodes: int = EPISODES,
    seed: int = SEED,
    **arguments: Any,
) -> Estimate:
    """Estimate the least possible mean |e(k)| of controllers that do not see the load, degC.

    This is no bound: see `hidden.py`. The arguments are those of `least_possible`. Without a
    load the estimate is the bound.
    """
    least = least_possible(
        samples=samples, kind=kind, episodes=episodes, seed=seed, **arguments
    )
    parameters = Parameters(**arguments)
    if not parameters.is_disturbed:
        return least
    drawn = _draw(parameters, samples, len(least.episodes), seed)
    added = [
        _least(parameters, least.kind, numbers, setpoint, unknown_of_hidden_load)
        - _least(parameters, least.kind, numbers, setpoint, unknown_of_normal_load)
        for numbers, setpoint in zip(drawn.numbers, drawn.setpoints, strict=True)
    ]
    return student(np.array(least.episodes) + np.array(added) / samples)


class _Episodes(NamedTuple):
    """What the environment draws for some episodes."""

    numbers: Sequence[PlantNumbers[float]]
    setpoints: Array
    """y_d(k) for k = 0 to N, degC, shape (episodes, N + 1)."""
    idle_errors: Array
    """Mean |e(k)| over k = 1 to N with the valve left alone, degC, shape (episodes,)."""


def _draw(parameters: Parameters, samples: int, episodes: int, seed: int) -> _Episodes:
    """Return the episodes that the environment draws."""
    numbers = drawn_numbers(parameters, episodes, seed)
    with closing(make_plants(episodes, samples + 1, **asdict(parameters))) as plants:
        idle_valve = IdleValve(numbers.u_min, numbers.u_max)
        trajectory = rollout(plants, idle_valve, samples + 1, seed)
    return _Episodes(
        numbers=[plant_numbers(numbers, i) for i in range(episodes)],
        setpoints=trajectory.setpoint.T,
        idle_errors=np.abs(trajectory.setpoint - trajectory.output)[1:].mean(axis=0),
    )


@cache  # as a report asks for several kinds of a case
def _least_possible(
    parameters: Parameters, samples: int, episodes: int, seed: int, kind: str
) -> LeastPossible:
    drawn = _draw(parameters, samples, episodes if is_random(parameters) else 1, seed)
    # Where noise and load alone are drawn, the bound is the same for all episodes.
    differ = parameters.ranges or parameters.setpoint == "random"
    bounds = [
        _least(parameters, kind, drawn.numbers[i], drawn.setpoints[i]) / samples
        for i in range(episodes if differ else 1)
    ]
    # Rounded to be the same on every machine, as solvers differ in later digits.
    values = tuple(round(bound, 6) for bound in bounds)
    idle = student(drawn.idle_errors)
    return LeastPossible(**vars(student(values)), kind=kind, idle=idle, episodes=values)


def _least(
    parameters: Parameters,
    kind: str,
    numbers: PlantNumbers[float],
    setpoint: Array,
    unknown_of: Callable[[LinearModel], Unknown] = unknown,
) -> float:
    """Return the bound on the sum of |e(k)| over k = 1 to N of an episode, degC.

    For the kind "causal" it includes the penalty of the flows. A reference includes the small
    price of the valve's travel, as solvers agree on the sum alone.
    """
    # A reference looks beyond the end.
    ahead = int(numbers.delay) + len(parameters.b) + TAIL if kind == "reference" else 0
    model = LinearModel(parameters, numbers, np.arange(len(setpoint) + ahead))
    unforeseen = unknown_of(model)
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
