"""What a controller without preview can come to if each change finds the plant settled.

Three things limit every controller of this plant: an input takes d + 1 samples to show, the
actuator has limits, and the next set point is not known. How much the last costs depends on how
set points change. Where they have no law (a square wave, a list), there is no bound but that
with preview: for one given course any controller may have the times of the changes built in.
What is here is a reference under a condition: each change of the set point comes when the plant
has settled at the one before, and was not foreseen. A controller that counts samples can come
below it.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, signal

from agents import PIController
from benchmarks.limits.course import Course, course
from benchmarks.limits.programme import Plan, plan
from benchmarks.limits.unknown import Unknown, noise_variance, unknown
from benchmarks.rollout import make_plants, rollout
from benchmarks.scenarios import SCENARIOS, Scenario, plain
from mptc_gym import Parameters
from mptc_gym.ranges import Ranges

Array = NDArray[np.float64]

SETTLED = 0.05  # of the flow's range: how much a flow that has settled may move within the lag
TAIL = 60  # samples more than the lag that a plan looks beyond the end of a hold
LEVEL = 0.001  # least slope of an error that counts in plans, so that they end at the set point
SMOOTH = 1e-4  # price of a t/h of travel, so that of equal plans the quiet one is taken


@dataclass(frozen=True)
class Limit:
    """The least errors in a scenario if each change of the set point finds the plant settled.

    Attributes
    ----------
    mae
        Mean of |e|, degC.
    mse
        Mean of e^2, degC^2.
    """

    mae: float
    mse: float


def noise_response(parameters: Parameters, samples: int) -> Array:
    """Return the first coefficients of C/A: how the output answers to a unit of xi."""
    impulse = np.zeros(samples)
    impulse[0] = 1.0
    response: Array = signal.lfilter(parameters.c, parameters.a, impulse)
    return response


def minimum_variance(parameters: Parameters) -> float:
    """Return the least variance of the output under any causal controller, degC^2.

    No command that knows y(k) can change what xi(k + 1) to xi(k + d + 1) do to y(k + d + 1):
    the first d + 1 coefficients of C/A. All that came before could be undone (K. J. Astrom,
    "Introduction to Stochastic Control Theory", 1970, chapter 6).
    """
    numbers = Ranges(parameters).given
    f = noise_response(parameters, int(numbers.delay) + 1)
    return numbers.noise_variance * float(f @ f)


def held(setpoint: Array) -> list[tuple[int, int]]:
    """Return the first sample of each stretch of constant set point, and the one after it."""
    changes = np.flatnonzero(np.diff(setpoint)) + 1
    return list(itertools.pairwise([0, *changes.tolist(), len(setpoint)]))


def steady_stretches(setpoint: Array) -> NDArray[np.bool_]:
    """Return which samples lie in the second half of the time that a set point is held."""
    steady = np.zeros(len(setpoint), dtype=bool)
    for start, stop in held(setpoint):
        steady[(start + stop) // 2 : stop] = True
    return steady


def reference(
    course: Course, unknown: Unknown, setpoint: Array, *, price: float = SMOOTH
) -> Plan:
    """Return the best mean flow of a controller that never reckons with another change.

    At each change it takes, from where it is, the flow that is best if the new set point stays.
    If the plant has settled by the next change, each change costs the least that it can
    without preview: see `benchmarks.limits.programme.plan` for why, and for what is loose.

    Parameters
    ----------
    course, unknown
        The plant and what is unknown, for `course.lag + TAIL` samples more than set points.
    setpoint
        y_d(k), degC, shape (samples,).
    price
        Of valve travel, degC times samples for each t/h.

    Raises
    ------
    ValueError
        If the plant has not settled when a change comes.
    """
    holds = held(setpoint)
    settled = SETTLED * (course.high - course.low)
    found: Plan | None = None
    error = np.zeros(len(setpoint))
    for start, stop in holds:
        last = stop == len(setpoint)
        beyond = np.full(0 if last else course.lag + TAIL, setpoint[start])
        ahead = np.concatenate([setpoint[:stop], beyond])
        found = plan(
            course, unknown, ahead, before=found, start=start, price=price, least_slope=LEVEL
        )
        error[start:stop] = found.error[start:stop]
        begun = max(stop - course.lag, start)
        if not last and (
            stop - start < course.lag or np.ptp(found.flow[max(begun - 1, 0) : stop]) > settled
        ):
            raise ValueError(
                "setpoint must be held until the plant has settled, or there is no reference; "
                f"got a hold of {stop - start} samples"
            )
    assert found is not None
    moves = found.travel.sum()
    return Plan(error, found.output, found.flow, float(error.sum() + price * moves))


@cache
def _scenario_limit(name: str) -> Limit:
    return _limit(SCENARIOS[name])


def scenario_limit(scenario: Scenario) -> Limit:
    """Return the reference of a scenario: the least errors if each change finds it settled.

    Raises
    ------
    ValueError
        If the scenario has what the derivations do not: see `benchmarks.scenarios.plain`; or
        if a set point changes before the plant has settled.
    """
    if SCENARIOS.get(scenario.name) == scenario:
        return _scenario_limit(scenario.name)
    return _limit(scenario)


def _limit(scenario: Scenario) -> Limit:
    parameters = plain(scenario.parameters)
    plants = make_plants(1, scenario.samples, **scenario.arguments)
    setpoint = rollout(plants, PIController(0.0, 0.0), scenario.samples, seed=0).setpoint[:, 0]
    numbers = Ranges(parameters).given
    longer = course(parameters, numbers, scenario.samples + int(numbers.delay) + 1 + TAIL)
    mae = reference(longer, unknown(longer), setpoint).error.mean()
    square = noise_variance(longer)[: scenario.samples].sum()
    before = 0.0
    for start, stop in held(setpoint):
        after = float(setpoint[start])
        square += least_square(parameters, before, after, stop - start)
        before = after
    return Limit(float(mae), float(square / len(setpoint)))


def least_square(parameters: Parameters, before: float, after: float, samples: int) -> float:
    """Return the least sum of e^2 over a change of the set point, without noise.

    Parameters
    ----------
    parameters
        The plant's, without drift.
    before, after
        Set points, degC. At the change the plant is in the steady state of the former.
    samples
        How long the new one is held.

    Returns
    -------
    float
        degC^2 times samples.

    Raises
    ------
    ValueError
        If the limits do not let the plant stay at `before`.
    """
    numbers = Ranges(parameters).given
    gain = sum(parameters.b) / sum(parameters.a)
    steady = before / gain
    if not numbers.u_min <= steady <= numbers.u_max:
        raise ValueError(f"before must be within the reach of the flow, got {before!r}")
    # Deviations from the steady state: y = G u, and e = change - y.
    impulse = signal.lfilter(
        [*[0.0] * (int(numbers.delay) + 1), *parameters.b], parameters.a, np.eye(1, samples)[0]
    )
    low, high = numbers.u_min - steady, numbers.u_max - steady
    return _least_square(impulse, after - before, low, high)


def _least_square(impulse: Array, change: float, low: float, high: float) -> float:
    samples = len(impulse)
    visible = np.flatnonzero(impulse)
    if not len(visible):
        return samples * change**2
    first = int(visible[0])
    count = samples - first  # later commands show no more
    G = np.array(
        [np.concatenate([np.zeros(j), impulse[first : samples - j]]) for j in range(count)]
    )
    solved = optimize.lsq_linear(G.T, np.full(count, change), (low, high), method="bvls")
    return first * change**2 + 2.0 * float(solved.cost)
