"""Compute the reference error for given arguments of the environment, and scores.

The reference error is the mean error of an ideal controller that knows the plant and the
present load, but not the future. The mean error is the mean of |e(k)| over the samples k = 1
to N of an episode, where e(k) is the set point minus the output, degC. The file README.md in
this folder says for which controllers each kind of reference error holds.

At sample k, a controller may know the plant's parameters, and the transmitter's readings, the
set points and the loads up to k. For the kind "preview", a controller may also know all later
set points. If the transmitter has noise, no controller knows the true output, `info["output"]`.
No controller knows the time at which the load jumps next. A controller may compensate for the
dead zone of the actuator.
"""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from benchmarks.bounds.causal import SetPointLaw
from benchmarks.bounds.linear_program import (
    LOOKAHEAD,
    NoReferenceError,
    plan,
    price_of_travel,
    surprised_plan,
)
from benchmarks.bounds.unknown import error_bounds
from benchmarks.lib.statistics import Estimate, student
from benchmarks.loop.linear import LinearModel
from benchmarks.loop.runs import IdleValve, drawn_numbers, is_random, make_plants, simulate
from mptc_gym import Parameters
from mptc_gym.evaluation import EPISODES, SEED
from mptc_gym.plant.parameters import ARGUMENTS, PlantNumbers
from mptc_gym.plant.sampling import plant_numbers
from mptc_gym.scores import mean_absolute_error, scores

Array = NDArray[np.float64]

# Kinds of reference errors. "preview": a lower bound for controllers that know future set
# points; "causal": a lower bound for controllers that do not know future set points;
# "surprise": the least error of a controller that expects no change of the set point.
KINDS = "preview", "causal", "surprise"
DEFAULTS = Parameters()


@dataclass(frozen=True)
class Reference(Estimate):
    """The reference error, a mean of |e|, degC, with a 95 % confidence interval.

    The confidence interval is for the mean over random episodes, and has the length 0 if all
    episodes have the same reference error.
    """

    kind: str  # one of `KINDS`
    idle: Estimate  # mean |e| with a flow of 0 t/h in the same episodes, degC
    # Reference error of each episode, degC, or a single number if all episodes have the same.
    # The field `value` is the mean over the episodes. For the kind "causal", the mean is a
    # lower bound, but the number of a single episode is not.
    episodes: tuple[float, ...]

    @property
    def is_bound(self) -> bool:
        """Whether it is proven that no controller without foresight has a smaller mean error.

        A controller with foresight knows set points in advance, such as a timetable of set
        points. Where `kind` is "surprise", such a controller can have a smaller mean error.
        """
        return self.kind != "surprise"

    def score(self, errors: ArrayLike) -> Array:
        """Return scores: 0 for the error of an idle valve, 1 for the reference error.

        Parameters
        ----------
        errors
            Mean errors of controllers, degC, of any shape.

        Returns
        -------
        ndarray
            Scores, in the shape of `errors`. The score of a single run may exceed 1 by chance.
            If `is_bound` is false, the scores of a controller with foresight may exceed 1.

        Raises
        ------
        ValueError
            If the error of an idle valve is not above the reference error.
        """
        idle = self.idle.value
        if idle - self.value <= 1e-9 * idle:
            raise ValueError(
                f"a score needs an idle-valve error above the reference error of "
                f"{self.value:g} °C, got {idle:g} °C"
            )
        return scores(errors, idle, self.value)


def reference_error(
    *,
    samples: int,
    kind: str | None = None,
    episodes: int = EPISODES,
    seed: int = SEED,
    **arguments: Any,
) -> Reference:
    """Return the reference error, the mean of |e(k)| over the samples k = 1 to `samples`, degC.

    Parameters
    ----------
    samples
        Length of an episode, samples.
    kind
        Kind of the reference error: "preview", "causal" or "surprise". If `kind` is None, as
        in reports and in `mptc_gym.evaluate`, the kind is "causal" for random set points,
        "preview" for constant set points, and otherwise "surprise", or "preview" if the set
        point changes before the plant has settled.
    episodes
        Number of episodes over which the reference error is averaged, if plants or set
        points are random.
    seed
        Seed of the first episode; episode i has the seed `seed + i`.
    **arguments
        Arguments of the environment `MiddlePoint-v0`.

    Raises
    ------
    NoReferenceError
        If `kind` is "causal" and set points are not random, or if `kind` is "surprise" and the
        set point changes before the plant has settled.
    ValueError
        If `kind` or an argument of the environment is not allowed.
    """
    parameters = Parameters(**arguments)
    if kind is not None and kind not in KINDS:
        raise ValueError(f"kind must be one of {', '.join(KINDS)}, got {kind!r}")
    has_random_setpoint = parameters.setpoint == "random"
    if kind == "causal" and not has_random_setpoint:
        raise NoReferenceError(
            f"kind must be 'preview' or 'surprise' if the set point is not random, got "
            f"{kind!r} for the set point {parameters.setpoint!r}"
        )
    case = parameters, samples, episodes, seed
    if kind is not None:
        return _reference(*case, kind)
    if has_random_setpoint:
        return _reference(*case, "causal")
    # One episode is enough, as set points that are not random are the same in all episodes.
    setpoint = _episodes_of(parameters, samples, 1, seed).setpoints[0]
    if np.ptp(setpoint) == 0.0:  # The set point is constant.
        return _reference(*case, "preview")
    try:
        return _reference(*case, "surprise")
    except NoReferenceError:  # The plant does not settle between changes.
        return _reference(*case, "preview")


class _Episodes(NamedTuple):
    """Plants and set points of several episodes, and the mean errors of an idle valve."""

    numbers: Sequence[PlantNumbers[float]]  # parameter values of each plant
    setpoints: Array  # y_d(k) for k = 0 to N, degC, shape (episodes, N + 1)
    # Mean |e(k)| over k = 1 to N with an idle valve, degC, shape (episodes,).
    idle_errors: Array


def _episodes_of(parameters: Parameters, samples: int, episodes: int, seed: int) -> _Episodes:
    """Return plants and set points of several episodes, and mean errors of an idle valve.

    An episode has the samples k = 0 to `samples`, and episode i has the seed `seed + i`.
    """
    numbers = drawn_numbers(parameters, episodes, seed)
    with closing(make_plants(episodes, samples + 1, **asdict(parameters))) as plants:
        idle_valve = IdleValve(numbers.u_min, numbers.u_max)
        trajectory = simulate(plants, idle_valve, samples + 1, seed)
    return _Episodes(
        numbers=[plant_numbers(numbers, i) for i in range(episodes)],
        setpoints=trajectory.setpoint.T,
        # Without e(0), as the mean of the reference error.
        idle_errors=mean_absolute_error((trajectory.setpoint - trajectory.output)[1:]),
    )


@cache  # since reports need the same reference error several times
def _reference(
    parameters: Parameters, samples: int, episodes: int, seed: int, kind: str
) -> Reference:
    """Return the reference error of the kind `kind`, degC.

    The parameters are those of `reference_error`, but `kind` must be "preview", "causal" or
    "surprise". A NoReferenceError is raised if `kind` is "surprise" and the set point changes
    before the plant has settled.
    """
    if not is_random(parameters):
        episodes = 1
    parameters, unit = in_standard_units(parameters)
    sampled = _episodes_of(parameters, samples, episodes, seed)
    different_values = episodes
    if not (parameters.ranges or parameters.setpoint == "random"):
        different_values = 1  # Noise and load do not change the reference error.
    values = []
    for i in range(different_values):
        error_sum = _error_sum(parameters, kind, sampled.numbers[i], sampled.setpoints[i])
        # Solvers differ between machines in later digits.
        values.append(unit * round(error_sum / samples, 6))
    mean = student(values)
    idle = student(unit * sampled.idle_errors)
    return Reference(**vars(mean), kind=kind, idle=idle, episodes=tuple(values))


def in_standard_units(parameters: Parameters) -> tuple[Parameters, float]:
    """Return the same plant in units in which the numbers are as large as the paper's.

    Linear programs, whose solvers have absolute tolerances, are then as exact for a plant in
    kg/h and thousandths of a degree as for the paper's plant. In the returned arguments, the
    largest set point and the range of the flow have the magnitudes of the default arguments, 5
    and 20. The returned number is the returned unit of temperature, degC. If the set point is
    always 0, the unit of temperature stays 1 degC.
    """
    temperature = parameters.largest_setpoint / DEFAULTS.largest_setpoint or 1.0
    limits = parameters.lowest  # u_min and u_max are never ranges
    default_limits = DEFAULTS.lowest
    flow = (limits.u_max - limits.u_min) / (default_limits.u_max - default_limits.u_min)
    sizes = {
        "degC": temperature,
        "t/h": flow,
        "degC per t/h": temperature / flow,
        "degC^2": temperature**2,
    }
    arguments = asdict(parameters)
    for name, argument in ARGUMENTS.items():
        size = sizes.get(argument.metadata["unit"])
        if size and not isinstance(arguments[name], str):
            arguments[name] = (np.asarray(arguments[name]) / size).tolist()
    return Parameters(**arguments), temperature


def _error_sum(
    parameters: Parameters, kind: str, numbers: PlantNumbers[float], setpoint: Array
) -> float:
    """Return the sum of |e(k)| of the ideal controller over k = 1 to N in one episode, degC.

    If `kind` is "causal", the returned sum contains the penalty for flows that use future set
    points, and only the mean of the returned sums of many episodes is a lower bound. If `kind`
    is "surprise", the returned sum contains a small price of valve travel, since solvers agree
    on the sum of errors and price, but not on the sum of errors alone.

    `numbers` has the parameter values of the episode's plant, and `setpoint` has the set points
    y_d(k) for k = 0 to N, degC.
    """
    length = len(setpoint)
    if kind == "surprise":  # The ideal controller plans beyond the end.
        length += int(numbers.delay) + len(parameters.b) + LOOKAHEAD
    model = LinearModel(parameters, numbers, np.arange(length))
    bounds = error_bounds(model)
    if kind == "surprise":
        errors, flow = surprised_plan(model, bounds, setpoint)
        travel = np.abs(np.diff(flow, prepend=0.0))
        costs = price_of_travel(model, setpoint) * travel
    else:
        penalty = np.zeros(len(setpoint))
        if kind == "causal" and parameters.setpoint_amplitude > 0.0:
            penalty = SetPointLaw(model, bounds).penalty(setpoint)
        errors, flow = plan(model, bounds, setpoint, penalty=penalty)
        costs = penalty * flow
    return float(errors[1:].sum() + costs.sum())  # without e(0), which no flow affects
