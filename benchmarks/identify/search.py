"""Search for the plant, valve and loads of a log, and draw what it leaves possible."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from benchmarks.identify.fit import BLOCKS, SHAPES, Array, Plant, Problem, Solution
from benchmarks.identify.valve import (
    VALVES,
    Hypothesis,
    with_change,
    with_hysteresis,
    with_valve,
)

LOAD, MOST_LOADS = 25.0, 4  # deviance that a load must explain, and how many there may be
FAULT = 12.0  # deviance from which a valve or a change is evident
DRAWS, THIN = 200, 3  # plants that are drawn, and steps of the walk between them
SPREAD = 1.4  # draws are that much wider than the likelihood says, as no model is right


@dataclass(frozen=True)
class Fits:
    """The best plant of each shape."""

    problem: Problem
    places: dict[str, Array]
    """Parameters by shape."""
    prices: dict[str, float]
    """Akaike's criterion by shape."""

    @property
    def shape(self) -> str:
        """The best shape."""
        return min(self.prices, key=lambda shape: self.prices[shape])

    @property
    def p(self) -> Array:
        """The best parameters."""
        return self.places[self.shape]

    @cached_property
    def solution(self) -> Solution:
        """The best coefficients."""
        return self.problem.solve(self.shape, self.p)

    @property
    def plant(self) -> Plant:
        """The best plant."""
        return self.problem.plant(self.shape, self.p, self.solution.c)

    def again(self, problem: Problem, p: Array) -> Fits:
        """Return the fits to a problem with weights for the noise that the best one leaves."""
        places = {shape: [place] for shape, place in self.places.items()} | {self.shape: [p]}
        return fits(problem.reweighted(self.shape, p), places)


def fits(problem: Problem, starts: dict[str, list[Array]]) -> Fits:
    """Return the best plant of each shape, from some places each."""
    places, prices = {}, {}
    for shape, given in starts.items():
        tried = [problem.refined(shape, p) for p in given]
        deviance, places[shape] = min(tried, key=lambda each: each[0])
        parameters = SHAPES[shape] + len(problem.units(shape, places[shape]))
        prices[shape] = deviance + 2.0 * parameters
    return Fits(problem, places, prices)


@dataclass(frozen=True)
class Found(Fits):
    """The most likely plant of a log, and its rivals."""

    valve: Hypothesis
    """A sound valve, a dead zone or a limit, which the fits take into account."""
    rivals: list[Hypothesis]
    """All such valves that were tried, the likeliest first."""
    faults: list[Hypothesis]
    """What no controller should be tuned for, the likeliest first: what each explains beyond
    the valve that was found."""

    @property
    def fault(self) -> Hypothesis | None:
        """The likeliest fault, if it is evident."""
        return self.faults[0] if self.faults[0].drop > FAULT else None


def search(problem: Problem, command: Array, *, applied: bool) -> Found:
    """Return what explains the temperatures of a log in single rows best.

    `command` is the flow from the operating point; the valve passes it as it is if `applied`.
    """
    problem, delay, lag = _coarse(problem, command, (0.0,) if applied else (0.0, 0.25, 0.45))
    starts = {"one lag": [np.array([delay, lag])]}
    for shape, third in {"two lags": -1.0, "three lags": -1.2, "a zero": -0.8}.items():
        starts[shape] = [np.array([share * delay, lag, third]) for share in (0.8, 0.3)]
    starts["a pair"] = [np.array([share * delay, lag - 0.7, 0.8]) for share in (0.8, 0.3)]
    found = fits(problem.reweighted("one lag", starts["one lag"][0]), starts)
    for _ in range(2):
        found = found.again(found.problem, found.p)
    for kinds in ({}, {}) if applied else (VALVES, VALVES):
        rivals = with_valve(found.problem, found.shape, found.p, command, kinds)
        # Of those that differ by rounding alone, the first.
        valve = max(rivals, key=lambda each: round(each.drop) - FAULT * (each.name != "none"))
        found = found.again(_with_loads(valve.problem, found.shape, valve.p), valve.p)
    where = found.problem, found.shape, found.p
    faults = with_change(*where) + ([] if applied else with_hysteresis(*where, command))
    faults.sort(key=lambda each: -each.drop)
    return Found(found.problem, found.places, found.prices, valve, rivals, faults)


def _coarse(
    problem: Problem, command: Array, zones: tuple[float, ...]
) -> tuple[Problem, float, float]:
    """Return the problem in blocks for its plant, and parameters of one lag, roughly."""
    h, end, largest = problem.h, len(command) * problem.h, np.abs(command).max()
    rough = replace(problem.in_blocks(max(1, len(command) // 800)), scale=end / 50)
    delays = np.unique(np.r_[0.0, np.geomspace(h, end / 6, 20)]) / rough.scale
    lags = np.geomspace(max(h, end / 2000), end / 8, 8)
    passed = [VALVES["dead zone"].passed(command, share * largest) for share in zones]
    grid = [
        (rough.behind(flow), np.array([delay, np.log(lag)]))
        for flow in passed for lag in lags for delay in delays
    ]  # fmt: skip
    order = np.argsort([each.solve("one lag", p).deviance for each, p in grid])
    nearest = [(grid[i][0], *grid[i][0].refined("one lag", grid[i][1])) for i in order[[0, 5]]]
    best, _, p = min(nearest, key=lambda each: each[1])
    (plant,) = best.units("one lag", p)
    scale = plant.delay + plant.slowest
    problem = replace(problem, flow=best.flow, scale=scale)
    rows = max(1, int(scale / BLOCKS / h))
    return problem.in_blocks(rows), plant.delay / scale, float(np.log(plant.slowest))


def _with_loads(problem: Problem, shape: str, p: Array) -> Problem:
    """Return the problem with the steps of loads that its temperatures ask for most."""
    end = len(problem.flow) * problem.h
    spacing = max(problem.scale / 4.0, end / 300.0)
    for _ in range(MOST_LOADS - len(problem.loads)):
        times = np.arange(spacing, end, spacing).tolist()
        more = [replace(problem, loads=(*problem.loads, at)) for at in times]
        deviances = [each.solve(shape, p).deviance for each in more]
        if min(deviances) > problem.solve(shape, p).deviance - LOAD:
            break
        problem = more[int(np.argmin(deviances))]
    return problem


class Zones(NamedTuple):
    """Dead zones that a log leaves possible: ranges that it cannot divide."""

    low: Array
    high: Array
    weight: Array
    problems: list[Problem]


def possible_zones(found: Found, command: Array) -> Zones:
    """Return the ranges between distinct commands in which the dead zone may end."""
    problem, name = found.problem, found.valve.name
    if name not in ("none", "dead zone", "subtractive dead zone") or len(found.rivals) == 1:
        return Zones(np.zeros(1), np.zeros(1), np.ones(1), [problem])
    kind = VALVES["dead zone" if name == "none" else name]
    edges = np.unique(np.r_[0.0, np.abs(command)])
    if name == "subtractive dead zone":
        edges = found.valve.size * np.linspace(0.4, 1.6, 61)
    edges = edges[edges <= np.abs(command).max()]
    while True:
        # A flow that is never the same has thousands: few, then those near the likely ones.
        at = np.unique(np.linspace(0, len(edges) - 1, 40).astype(int))
        behind = [problem.behind(kind.passed(command, edges[i])) for i in at]
        prices = np.array([each.solve(found.shape, found.p).deviance for each in behind])
        likely = np.flatnonzero(prices < prices.min() + 20.0 * SPREAD**2)
        first, last = max(likely[0] - 1, 0), min(likely[-1] + 1, len(at) - 1)
        if len(at) == len(edges) or last - first == len(at) - 1:
            break
        edges = edges[at[first] : at[last] + 1]
    high = edges[at]
    low = np.r_[high[0], high[:-1]]
    weight = np.exp((prices.min() - prices) / 2.0 / SPREAD**2)
    if len(high) > 1:  # the first range is 0 alone, or unlikely
        weight *= high - low
    keep = np.flatnonzero(weight > 1e-6 * weight.max())
    weight = weight[keep] / weight[keep].sum()
    return Zones(low[keep], high[keep], weight, [behind[i] for i in keep])


def draws(
    found: Found, zones: Zones, generator: np.random.Generator
) -> list[tuple[Plant, int]]:
    """Return plants with ranges of dead zones from the posterior over all that is not known."""
    least, drawn = min(found.prices.values()), []
    # A better shape by chance is common: the weights are milder than Akaike's.
    weights = {shape: np.exp((least - price) / 4.0) for shape, price in found.prices.items()}
    for shape, weight in weights.items():
        count = round(DRAWS * weight / sum(weights.values()))
        if count >= 4:
            drawn += _walk(shape, found.places[shape], zones, count, generator)
    return drawn


def _walk(
    shape: str, p: Array, zones: Zones, count: int, generator: np.random.Generator
) -> list[tuple[Plant, int]]:
    """Return plants of a shape by Metropolis' walk over parameters and dead zones."""
    at = int(np.argmax(zones.weight))
    problem, steps = zones.problems[at], 0.01 * np.eye(len(p))
    ends = [
        problem.solve(shape, p + d).errors - problem.solve(shape, p - d).errors for d in steps
    ]
    slopes, solved = np.column_stack(ends) / 0.02, problem.solve(shape, p)
    information = slopes.T @ slopes / np.mean(solved.errors**2) + np.eye(len(p))
    root = 1.5 * SPREAD / np.sqrt(len(p)) * np.linalg.cholesky(np.linalg.inv(information))
    longest = max(len(problem.flow) * problem.h / 5.0, problem.units(shape, p)[0].slowest)
    density = np.log(zones.weight / np.maximum(zones.high - zones.low, 1e-12))
    drawn = []

    def accepted(tried: Solution, more: float = 0.0) -> bool:
        gained = (solved.deviance - tried.deviance) / 2.0 / SPREAD**2 + more
        return bool(np.log(generator.uniform()) < gained)

    for step in range(1, THIN * count + 1):
        q = p + root @ generator.standard_normal(len(p))
        if q[0] >= 0.0 and problem.units(shape, q)[0].slowest <= longest:
            tried = problem.solve(shape, q)
            if accepted(tried):
                p, solved = q, tried
        if step % THIN == 0:
            other = int(generator.choice(len(zones.weight), p=zones.weight))
            tried = zones.problems[other].solve(shape, p)
            if other != at and accepted(tried, density[at] - density[other]):
                at, problem, solved = other, zones.problems[other], tried
            square = np.linalg.pinv(solved.weighted.T @ solved.weighted, 1e-10, hermitian=True)
            spread = SPREAD**2 * np.mean(solved.errors**2) * square
            c = generator.multivariate_normal(solved.c, spread, method="eigh")
            drawn.append((problem.plant(shape, p, c), at))
    return drawn
