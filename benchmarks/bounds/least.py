"""Compute the least possible mean error of a case of the environment, and scores.

The mean error is the mean of |e(k)| over the samples k = 1 to N of an episode, where e(k) is
the set point minus the output, degC. The file README.md says for which controllers each kind of
bound holds. At sample k, a controller may know the plant's parameters, and the transmitter's
readings, the set points and the loads up to k. A controller knows neither the true output,
`info["output"]`, nor the time of the load's next jump. A controller may compensate the dead
zone.
"""

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from benchmarks.bounds.causal import SetPointLaw
from benchmarks.bounds.hidden import bounds_with_hidden_load, bounds_with_known_load
from benchmarks.bounds.linear_program import (
    LOOKAHEAD,
    TRAVEL_PRICE,
    ErrorBounds,
    plan,
    reference,
)
from benchmarks.bounds.unknown import error_bounds
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
from mptc_gym.evaluation import EPISODES, SEED
from mptc_gym.plant.parameters import PlantNumbers
from mptc_gym.plant.sampling import plant_numbers

Array = NDArray[np.float64]

# "preview": a lower bound for controllers that know future set points; "causal": a lower bound
# for controllers that do not; "reference": the least error of a controller that expects no
# change of the set point.
KINDS = "preview", "causal", "reference"


@dataclass(frozen=True)
class LeastPossible(Estimate):
    """The least possible mean |e| of a case, degC, with a 95 % interval over random episodes.

    The interval has the length 0 if the least error is the same in all episodes.
    """

    kind: str  # one of `KINDS`
    idle: Estimate  # mean |e| of the same episodes with an idle valve, degC
    # The least errors of the episodes with the seeds `seed + i`, degC; `value` is their mean.
    # There is a single number if the least error is the same in all episodes. For the kind
    # "causal", the mean is a bound, but the numbers of single episodes are not.
    episodes: tuple[float, ...]

    def score(self, errors: ArrayLike) -> Array:
        """Return scores: 0 for the error of an idle valve, 1 for the least possible error.

        Parameters
        ----------
        errors
            Mean errors of controllers, degC, of any shape.

        Returns
        -------
        ndarray
            Scores, in the shape of `errors`. The score of a single run may exceed 1 by chance.

        Raises
        ------
        ValueError
            If the least possible error is not below the error of an idle valve.
        """
        idle = self.idle.value
        if idle - self.value <= 1e-9 * max(idle, 1.0):
            raise ValueError(f"there is nothing to gain: an idle valve gives {idle:g} °C")
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
    """Return the least possible mean |e(k)| of a case over k = 1 to `samples`, degC.

    Parameters
    ----------
    samples
        N, the length of an episode.
    kind
        One of `KINDS`. With None, as in reports and in `mptc_gym.evaluate`, the kind is
        "causal" for random set points, "preview" for constant set points, and otherwise
        "reference", or "preview" if the case has no reference.
    episodes
        Number of episodes over which the least error is averaged, if plants or set points are
        random.
    seed
        Seed of the first episode: episode i is the environment's episode with the seed
        `seed + i`.
    **arguments
        Arguments of the environment, which define the case.

    Raises
    ------
    NoBoundError
        If the case has no bound of this kind: "causal" needs random set points, and "reference"
        needs set points that do not change before the plant has settled.
    ValueError
        If `samples`, `episodes`, `kind` or an argument of the environment is not allowed.
    """
    parameters = Parameters(**arguments)
    for name, count in (("samples", samples), ("episodes", episodes)):
        if not isinstance(count, int) or count < 1:
            raise ValueError(f"{name} must be an integer of at least 1, got {count!r}")
    if kind is not None and kind not in KINDS:
        raise ValueError(f"kind must be one of {', '.join(KINDS)}, got {kind!r}")
    has_random_setpoint = parameters.setpoint == "random"
    if kind == "causal" and not has_random_setpoint:
        raise NoBoundError(
            f"kind must be preview or reference, as the set point {parameters.setpoint!r} is "
            f"not random, got {kind!r}"
        )
    case = parameters, samples, episodes, seed
    if kind is not None:
        return _bound(*case, kind)
    if has_random_setpoint:
        return _bound(*case, "causal")
    setpoint = _episodes_of(parameters, samples, 1, seed).setpoints[0]
    if np.ptp(setpoint) == 0.0:  # Without a change, foresight makes no difference.
        return _bound(*case, "preview")
    try:
        return _bound(*case, "reference")
    except NoBoundError:  # The plant does not settle between changes.
        return _bound(*case, "preview")


def with_hidden_load(
    *, samples: int, episodes: int = EPISODES, seed: int = SEED, **arguments: Any
) -> Estimate:
    """Return an estimate of the least possible mean |e(k)| if nobody measures the load, degC.

    The estimate is not a bound: see `hidden.py`. For a case without a load, the result is the
    least possible error. `least_possible` describes the parameters and exceptions.
    """
    least = least_possible(samples=samples, episodes=episodes, seed=seed, **arguments)
    parameters = Parameters(**arguments)
    if not parameters.is_disturbed:
        return least
    sampled = _episodes_of(parameters, samples, len(least.episodes), seed)
    estimates = []
    for i, bound in enumerate(least.episodes):
        # The first arguments of `_error_sum`.
        episode = parameters, least.kind, sampled.numbers[i], sampled.setpoints[i]
        hidden_load = _error_sum(*episode, bounds_with_hidden_load)
        known_load = _error_sum(*episode, bounds_with_known_load)
        estimates.append(bound + (hidden_load - known_load) / samples)
    return student(estimates)


class _Episodes(NamedTuple):
    """Plant numbers, set points and idle-valve errors of some episodes of N samples."""

    numbers: Sequence[PlantNumbers[float]]  # the plant numbers of each episode
    setpoints: Array  # y_d(k) for k = 0 to N, degC, shape (episodes, N + 1)
    # Mean |e(k)| over k = 1 to N with an idle valve, degC, shape (episodes,).
    idle_errors: Array


def _episodes_of(parameters: Parameters, samples: int, episodes: int, seed: int) -> _Episodes:
    """Return the plants, set points and idle-valve errors of the environment's episodes.

    An episode has the samples k = 0 to `samples`, and episode i has the seed `seed + i`.
    """
    numbers = drawn_numbers(parameters, episodes, seed)
    with closing(make_plants(episodes, samples + 1, **asdict(parameters))) as plants:
        idle_valve = IdleValve(numbers.u_min, numbers.u_max)
        trajectory = rollout(plants, idle_valve, samples + 1, seed)
    return _Episodes(
        numbers=[plant_numbers(numbers, i) for i in range(episodes)],
        setpoints=trajectory.setpoint.T,
        idle_errors=np.abs(trajectory.setpoint - trajectory.output)[1:].mean(axis=0),
    )


@cache  # as a report asks for the same bound several times
def _bound(
    parameters: Parameters, samples: int, episodes: int, seed: int, kind: str
) -> LeastPossible:
    """Return the least possible error of one of `KINDS`.

    `least_possible` describes the parameters. A NoBoundError is raised if the reference does
    not exist.
    """
    if not is_random(parameters):
        episodes = 1
    sampled = _episodes_of(parameters, samples, episodes, seed)
    bounds = episodes
    if not (parameters.ranges or parameters.setpoint == "random"):
        bounds = 1  # Noise and load do not change the bound.
    values = []
    for i in range(bounds):
        error_sum = _error_sum(parameters, kind, sampled.numbers[i], sampled.setpoints[i])
        # Rounded to be the same on all machines, as solvers differ in later digits.
        values.append(round(error_sum / samples, 6))
    idle = student(sampled.idle_errors)
    return LeastPossible(**vars(student(values)), kind=kind, idle=idle, episodes=tuple(values))


def _error_sum(
    parameters: Parameters,
    kind: str,
    numbers: PlantNumbers[float],
    setpoint: Array,
    bounds_of: Callable[[LinearModel], ErrorBounds] = error_bounds,
) -> float:
    """Return the least possible sum of |e(k)| over k = 1 to N in one episode, degC.

    For the kind "causal", the sum contains the penalty for flows that use the future, and only
    the mean over many episodes is a bound. For the kind "reference", the sum contains a small
    price of valve travel: solvers agree on the sum with the price, but not without it.

    Parameters
    ----------
    parameters
        The arguments of the environment.
    kind
        One of `KINDS`.
    numbers
        The plant numbers of the episode.
    setpoint
        Set points y_d(k) for k = 0 to N, degC, shape (N + 1,).
    bounds_of
        A function that returns the lower bounds of the mean errors for a plant.
    """
    length = len(setpoint)
    if kind == "reference":  # A reference looks beyond the end of the episode.
        length += int(numbers.delay) + len(parameters.b) + LOOKAHEAD
    model = LinearModel(parameters, numbers, np.arange(length))
    bounds = bounds_of(model)
    if kind == "reference":
        errors, flow = reference(model, bounds, setpoint)
        costs = TRAVEL_PRICE * np.abs(np.diff(flow, prepend=0.0))
    else:
        penalty = np.zeros(len(setpoint))
        if kind == "causal" and parameters.setpoint_amplitude > 0.0:
            penalty = SetPointLaw(model, bounds).penalty(setpoint)
        errors, flow = plan(model, bounds, setpoint, penalty=penalty)
        costs = penalty * flow
    return float(errors[1:].sum() + costs.sum())  # without e(0), which no flow changes
