"""What no controller can do better: `python -m benchmarks.limits`.

Two things limit every controller of this plant: an input takes d + 1 samples to show, and the
actuator has limits. The bounds here follow from these two alone. Of the dead zone they suppose
that it can be undone, so that they stay true bounds with it; they are attained where no command
within it is needed, as `benchmarks.controllers.mpc` shows.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from dataclasses import dataclass
from functools import cache

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from rich.console import Console
from scipy import optimize, signal, sparse, stats
from tqdm import tqdm

from agents import PIController
from benchmarks.lib import command_line
from benchmarks.lib.tables import on_screen
from benchmarks.rollout import make_plants, rollout
from benchmarks.scenarios import SCENARIOS, Scenario, plain
from mptc_gym import Parameters

Array = NDArray[np.float64]

# Where the tangents touch that stand for the mean of |m + noise|, in standard deviations.
TOUCHES = (0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 2.5, 3.0)


@dataclass(frozen=True)
class Limit:
    """The least errors that are possible in a scenario.

    Attributes
    ----------
    mae
        Least expected mean of |e|, degC.
    mse
        Least expected mean of e^2, degC^2.
    """

    mae: float
    mse: float


def _add_options(parser: argparse.ArgumentParser) -> None:
    pass  # none


@command_line.command(
    "limits", __doc__, _add_options, width=110, interrupted="nothing is kept."
)
def main(_: argparse.Namespace, console: Console) -> str:
    """Print the limits of every scenario."""
    rows = []
    for name, scenario in tqdm(SCENARIOS.items(), unit="scenario"):
        limit = scenario_limit(scenario)
        variance = minimum_variance(scenario.parameters)
        row = (
            name,
            f"{limit.mae:.4f}",
            f"{np.sqrt(limit.mse):.4f}",
            f"{np.sqrt(variance):.4f}",
        )
        rows.append(row)
    columns = ["scenario", "mean |e| (°C)", "rms e (°C)", "rms e, set point held (°C)"]
    console.print("No controller can do better on average:")
    console.print(on_screen(pd.DataFrame(rows, columns=columns)))
    return ""


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
    f = noise_response(parameters, parameters.delay + 1)
    return parameters.noise_variance * float(f @ f)


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


@cache
def _scenario_limit(name: str) -> Limit:
    return _limit(SCENARIOS[name])


def scenario_limit(scenario: Scenario) -> Limit:
    """Return the limits of a scenario: those of its changes, one after the other.

    Every change starts from the steady state of the set point before it, as the controller does
    not know beforehand that it will come; the first starts from rest.

    Raises
    ------
    ValueError
        If the scenario has what the derivations do not: see `benchmarks.scenarios.plain`.
    """
    if SCENARIOS.get(scenario.name) == scenario:
        return _scenario_limit(scenario.name)
    return _limit(scenario)


def _limit(scenario: Scenario) -> Limit:
    parameters = plain(scenario.parameters)
    plants = make_plants(1, scenario.samples, **scenario.arguments)
    setpoint = rollout(plants, PIController(0.0, 0.0), scenario.samples, seed=0).setpoint[:, 0]
    totals = np.zeros(2)
    before = 0.0
    for start, stop in held(setpoint):
        after = float(setpoint[start])
        # With limits of the same size, down is as hard as up, and need not be worked out again.
        up = -1.0 if parameters.u_min == -parameters.u_max and after < before else 1.0
        totals += least_error(
            parameters, up * before, up * after, stop - start, from_rest=start == 0
        )
        before = after
    mae, mse = totals / len(setpoint)
    return Limit(float(mae), float(mse))


@cache
def least_error(
    parameters: Parameters, before: float, after: float, samples: int, *, from_rest: bool
) -> tuple[float, float]:
    """Return the least expected sums of |e| and of e^2 over a change of the set point.

    The error is what is expected of it, m(k), plus what the last d + 1 disturbances do to it,
    which no command can know: normal, of variance s^2(k). By Jensen's inequality the mean of
    |m + noise| over all that may have happened is at least that for the mean of m; and the mean
    of m obeys (28) without noise, driven by the mean of the applied input, which lies within
    the limits. So the least sum is that of a convex programme over these means: for e^2 a
    bounded least-squares problem, to which the sum of s^2 is added; for |e| a linear programme,
    in which tangents from below stand for E|m + noise|, so that it remains a bound.

    Parameters
    ----------
    parameters
        The plant's.
    before, after
        Set points, degC. At the change the plant is in the steady state of the former.
    samples
        How long the new one is held.
    from_rest
        Whether no noise has come before, as when an episode begins.

    Returns
    -------
    tuple of float
        degC and degC^2, each times samples.

    Raises
    ------
    ValueError
        If the limits do not let the plant stay at `before`.
    """
    gain = sum(parameters.b) / sum(parameters.a)
    steady = before / gain
    if not parameters.u_min <= steady <= parameters.u_max:
        raise ValueError(f"before must be within the reach of the flow, got {before!r}")
    low, high = parameters.u_min - steady, parameters.u_max - steady
    change = after - before
    # Deviations from the steady state: y = G u, and e = change - y.
    impulse = signal.lfilter(
        [*[0.0] * (parameters.delay + 1), *parameters.b], parameters.a, np.eye(1, samples)[0]
    )
    spread = np.sqrt(_unknown_variance(parameters, samples, from_rest=from_rest))
    return (
        _least_absolute(impulse, change, low, high, spread, parameters),
        _least_square(impulse, change, low, high) + float(spread @ spread),
    )


def _unknown_variance(parameters: Parameters, samples: int, *, from_rest: bool) -> Array:
    """Variance of what disturbances too late to be answered do to y(k), degC^2."""
    f = noise_response(parameters, parameters.delay + 1)
    grown = parameters.noise_variance * np.concatenate([[0.0], np.cumsum(f * f)])
    known = np.arange(samples) if from_rest else np.full(samples, len(f))
    return grown[np.minimum(known, len(f))]


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


def _least_absolute(
    impulse: Array, change: float, low: float, high: float, spread: Array, p: Parameters
) -> float:
    n = len(impulse)
    nothing = sparse.csr_array((n, n))

    def shifted(coefficients: dict[int, float]) -> sparse.sparray:
        """Return a matrix that multiplies a sequence with a polynomial in z^-1."""
        inside = {lag: c for lag, c in coefficients.items() if lag < n}
        if not inside:
            return nothing
        diagonals = [np.full(n - lag, c) for lag, c in inside.items()]
        return sparse.diags_array(diagonals, offsets=[-lag for lag in inside], shape=(n, n))

    A = shifted(dict(enumerate(p.a)))
    B = shifted({p.delay + i: b for i, b in enumerate(p.b, 1)})
    # Unknowns: y, u and t, the bound on each sample's E|e|. A y = B u; t is above all tangents.
    # The tangents: where they touch, with value and slope there. First |m| itself, which
    # E|m + noise| approaches far away.
    lines = [(np.zeros(n), np.zeros(n), np.full(n, sign)) for sign in (-1.0, 1.0)]
    for sign, touch in itertools.product((-1.0, 1.0), TOUCHES if spread.any() else ()):
        where = sign * touch * spread
        lines.append((where, *_folded_normal(where, spread)))
    eye = sparse.eye_array(n)
    tangents = [
        sparse.hstack([sparse.diags_array(-slope), nothing, -eye]) for *_, slope in lines
    ]
    offsets = [slope * (where - change) - value for where, value, slope in lines]
    solved = optimize.linprog(
        np.concatenate([np.zeros(2 * n), np.ones(n)]),
        A_ub=sparse.vstack(tangents).tocsr(),
        b_ub=np.concatenate(offsets),
        A_eq=sparse.hstack([A, -B, nothing]).tocsr(),
        b_eq=np.zeros(n),
        bounds=np.repeat([[-np.inf, np.inf], [low, high], [0.0, np.inf]], n, axis=0),
        method="highs",
    )
    if not solved.success:
        raise RuntimeError(f"the linear programme was not solved: {solved.message}")
    return float(solved.fun)


def _folded_normal(mean: Array, deviation: Array) -> tuple[Array, Array]:
    """Return E|mean + deviation z|, z standard normal, and its derivative in the mean."""
    safe = np.where(deviation > 0, deviation, 1.0)
    z = mean / safe
    value = safe * 2.0 * stats.norm.pdf(z) + mean * (2.0 * stats.norm.cdf(z) - 1.0)
    slope = 2.0 * stats.norm.cdf(z) - 1.0
    calm = deviation == 0
    return np.where(calm, np.abs(mean), value), np.where(calm, np.sign(mean), slope)


if __name__ == "__main__":
    sys.exit(main(None))
