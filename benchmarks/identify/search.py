"""Search for the plant, valve and loads of a log, and draw what it leaves possible."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import accumulate
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from benchmarks.identify.fit import BLOCKS, Array, Fit, Plant, in_series

LOAD, MOST_LOADS = 25.0, 4  # deviance that a load must explain, and how many there may be
FAULT = 12.0  # deviance from which a valve or a change is evident
DRAWS, THIN = 200, 3  # plants that are drawn, and steps of the walk between them
SPREAD = 1.4  # draws are that much wider than the likelihood says, as no model is right
Passed = Callable[[Array, float], Array]
by_deviance, by_price = attrgetter("deviance"), attrgetter("price")


def following(rule: Callable[[float, float, float], float]) -> Passed:
    """Return a valve that moves from its position by `rule(position, command, size)`."""
    return lambda flow, size: np.array(
        [*accumulate(flow.tolist(), lambda position, u: rule(position, u, size))]
    )


@dataclass(frozen=True)
class Kind:
    """What may lie between a command and its effect."""

    passed: Passed  # the flow behind it, of a flow from the operating point and a size
    # Sizes to try, as shares of the largest flow; of a rate, in a delay and a lag.
    sizes: tuple[float, ...] = (0.1, 0.16, 0.24, 0.34, 0.46)
    # Shares of the delay to try: some valves look like a part of it.
    delays: tuple[float, ...] = (1.0,)


# A linear controller can be tuned for the plant behind these.
VALVES = {
    "none": Kind(lambda u, _: u, (0.0,)),
    "dead zone": Kind(lambda u, size: np.where(np.abs(u) < size, 0.0, u)),
    "subtractive dead zone": Kind(lambda u, size: np.sign(u) * (np.abs(u) - size).clip(0.0)),
    "saturation": Kind(lambda u, size: np.clip(u, -size, size), (0.4, 0.55, 0.7, 0.85)),
    "rate limit": Kind(
        following(lambda p, u, size: p + min(max(u - p, -size), size)),
        (10.0, 3.3, 1.6, 1.0, 0.6), (1.0, 0.7, 0.4),
    ),
}  # fmt: skip
# With these a loop cycles.
HYSTERESES = {
    "backlash": Kind(
        following(lambda p, u, size: min(max(p, u - size / 2), u + size / 2)),
        (0.1, 0.2, 0.35, 0.5, 0.7, 0.9, 1.1), (1.0, 0.7),
    ),
    "stiction": Kind(
        following(lambda p, u, size: u if abs(u - p) > size else p),
        (0.1, 0.2, 0.3, 0.4, 0.6), (1.0, 0.7),
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Hypothesis:
    """A valve or a change of the plant, with the best plant for it."""

    name: str
    size: float  # t/h, of a rate t/h a row; of a change its share of the gain
    drop: float  # what it takes from the deviance
    fit: Fit


def with_valves(
    fit: Fit, command: Array, kinds: dict[str, Kind], plain: Fit | None = None
) -> list[Hypothesis]:
    """Return kinds of valves, each with its best size and plant, the likeliest first.

    What they explain is that beyond a plain fit, by default that of the first kind.
    """
    found, largest = [], float(np.abs(command).max())
    for name, kind in kinds.items():
        unit = largest * (fit.h / fit.scale if name == "rate limit" else 1.0)
        places = [fit.at(np.r_[share * fit.p[0], fit.p[1:]]) for share in kind.delays]
        sizes = [unit * share for share in kind.sizes]
        # A size at a place, and the place at that size, in turns. The plant that was found
        # without hysteresis is too slow for one: there each size has its own place.
        for finer in ((0.75, 0.87, 1.0, 1.15, 1.33), (0.93, 1.0, 1.07), ()):
            tried = []
            for size in sizes:
                passed = kind.passed(command, size)
                nearest = min((each.behind(passed) for each in places), key=by_deviance)
                tried.append((size, nearest.refined(8) if name in HYSTERESES else nearest))
            size, best = min(tried, key=lambda each: each[1].deviance)
            if name not in HYSTERESES:
                best = best.refined(12)
            places, sizes = [best], [size * factor for factor in finer]
        if name in HYSTERESES:  # nor is the noise what that plant left
            best = best.reweighted().refined(12)
        plain = plain or best
        found.append(Hypothesis(name, size, plain.deviance - best.deviance, best))
    return sorted(found, key=lambda each: -round(each.drop))


def with_changes(fit: Fit) -> list[Hypothesis]:
    """Return what changes a plant's gain or speed, each as one more input of the plant."""
    flow, plain, found = fit.flow, fit.refined(12).deviance, []
    answer = in_series([fit.units[0].slowest]).simulated(flow, fit.h)
    inputs = {
        "gain by level": flow**2 / np.abs(flow).max(),
        "gain by time": flow * np.linspace(-1.0, 1.0, len(flow)),
        "speed by direction": np.abs(np.gradient(answer, fit.h)) * fit.scale,
    }
    for name, each in inputs.items():
        more = replace(fit, extra=(each,)).refined(16)
        size = float(more.solution.c[len(more.units)]) / more.plant.gain
        found.append(Hypothesis(name, size, plain - more.deviance, more))
    return found


@dataclass(frozen=True)
class Found:
    """The most likely plant of a log, and its rivals."""

    best: Fit
    fits: list[Fit]  # the best one of each shape
    valve: Hypothesis  # a sound one, a dead zone or a limit, which the fits take into account
    rivals: list[Hypothesis]  # all such valves that were tried
    # What no controller should be tuned for, the likeliest first, and what each explains beyond
    # the valve that was found.
    faults: list[Hypothesis]


def search(fit: Fit, command: Array, *, applied: bool) -> Found:
    """Return what explains the temperatures of a log in single rows best.

    `command` is the flow from the operating point; the valve passes it as it is if `applied`.
    """
    start = _coarse(fit, command, (0.0,) if applied else (0.0, 0.25, 0.45))
    delay, lag = start.p
    fits = _refined(start, [start, *(
        replace(start, shape=shape, p=np.array([share * delay, lag + longer, third]))
        # What is added to the logarithm of the lag, and the third parameter.
        for shape, longer, third in (("two lags", 0.0, -1.0), ("three lags", 0.0, -1.2),
                                     ("a zero", 0.0, -0.8), ("a pair", -0.7, 0.8))
        for share in (0.8, 0.3)
    )])  # fmt: skip
    for _ in range(2):
        fits = _refined(min(fits, key=by_price), fits)
    kinds = {"none": VALVES["none"]} if applied else VALVES
    for _ in range(2):
        rivals = with_valves(min(fits, key=by_price), command, kinds)
        # Of those that differ by rounding alone, the first.
        valve = max(rivals, key=lambda each: round(each.drop) - FAULT * (each.name != "none"))
        fits = _refined(_with_loads(valve.fit), fits)
    best = min(fits, key=by_price)
    faults = with_changes(best)
    if not applied:
        faults += with_valves(best, command, HYSTERESES, best.reweighted().refined(12))
    return Found(best, fits, valve, rivals, sorted(faults, key=lambda each: -each.drop))


def _coarse(fit: Fit, command: Array, zones: tuple[float, ...]) -> Fit:
    """Return one lag, roughly, and the log in blocks for it."""
    h, end, largest = fit.h, len(command) * fit.h, np.abs(command).max()
    rough = replace(fit.in_blocks(max(1, len(command) // 800)), scale=end / 50)
    delays = np.unique(np.r_[0.0, np.geomspace(h, end / 6, 20)]) / rough.scale
    lags = np.log(np.geomspace(max(h, end / 2000), end / 8, 8))
    passed = [VALVES["dead zone"].passed(command, share * largest) for share in zones]
    grid = [
        rough.behind(flow).at(np.array([delay, lag]))
        for flow in passed for lag in lags for delay in delays
    ]  # fmt: skip
    grid.sort(key=by_deviance)
    best = min((grid[i].refined() for i in (0, 5)), key=by_deviance)
    (plant,) = best.units
    scale = plant.delay + plant.slowest
    p = np.array([plant.delay / scale, np.log(plant.slowest)])
    rows = max(1, int(scale / BLOCKS / h))
    return replace(fit, flow=best.flow, scale=scale, p=p).in_blocks(rows)


def _refined(near: Fit, starts: list[Fit]) -> list[Fit]:
    """Return the best fit of each shape to the log, noise and loads of one fit.

    Its own shape starts from its own place, and the others from theirs.
    """
    white, found = near.reweighted(), dict[str, list[Fit]]()
    for each in starts:
        p = near.p if each.shape == near.shape else each.p
        fit = replace(white, shape=each.shape, p=p).refined()
        found.setdefault(each.shape, []).append(fit)
    return [min(alike, key=by_deviance) for alike in found.values()]


def _with_loads(fit: Fit) -> Fit:
    """Return the fit with the steps of loads that its temperatures ask for most."""
    end = len(fit.flow) * fit.h
    spacing = max(fit.scale / 4.0, end / 300.0)
    for _ in range(MOST_LOADS - len(fit.loads)):
        more = (replace(fit, loads=(*fit.loads, at)) for at in np.arange(spacing, end, spacing))
        likeliest = min(more, key=by_deviance)
        if likeliest.deviance > fit.deviance - LOAD:
            break
        fit = likeliest
    return fit


class Zones(NamedTuple):
    """Dead zones that a log leaves possible: ranges that it cannot divide."""

    low: Array
    high: Array
    weight: Array
    fits: list[Fit]  # the best plant behind each


def _possible_zones(found: Found, command: Array) -> Zones:
    """Return the ranges between distinct commands in which the dead zone may end."""
    best, name = found.best, found.valve.name
    if name not in ("none", "dead zone", "subtractive dead zone") or len(found.rivals) == 1:
        return Zones(np.zeros(1), np.zeros(1), np.ones(1), [best])
    kind = VALVES["dead zone" if name == "none" else name]
    edges = np.unique(np.r_[0.0, np.abs(command)])
    if name == "subtractive dead zone":
        edges = found.valve.size * np.linspace(0.4, 1.6, 61)
    edges = edges[edges <= np.abs(command).max()]
    while True:
        # A flow that is never the same has thousands: few, then those near the likely ones.
        at = np.unique(np.linspace(0, len(edges) - 1, 40).astype(int))
        behind = [best.behind(kind.passed(command, edge)) for edge in edges[at]]
        prices = np.array([each.deviance for each in behind])
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


def draws(found: Found, command: Array) -> tuple[list[Plant], list[float]]:
    """Return plants from the posterior over all that is not known, and ends of dead zones."""
    zones, generator = _possible_zones(found, command), np.random.default_rng(0)
    # A better shape by chance is common: the weights are milder than Akaike's.
    weights = [np.exp((found.best.price - each.price) / 4.0) for each in found.fits]
    drawn = []
    for fit, weight in zip(found.fits, weights, strict=True):
        count = round(DRAWS * weight / sum(weights))
        if count >= 4:
            drawn += _walk(fit, zones, count, generator)
    plants, at = [each for each, _ in drawn], [i for _, i in drawn]
    return plants, [*zones.low[at], *zones.high[at]]


def _walk(
    fit: Fit, zones: Zones, count: int, generator: np.random.Generator
) -> list[tuple[Plant, int]]:
    """Return plants of a shape by Metropolis' walk over parameters and dead zones."""
    at, size, drawn = int(np.argmax(zones.weight)), len(fit.p), []
    now = replace(fit, flow=zones.fits[at].flow)
    slopes = np.column_stack(
        [
            (now.at(fit.p + d).solution.errors - now.at(fit.p - d).solution.errors) / 0.02
            for d in 0.01 * np.eye(size)
        ]
    )
    information = slopes.T @ slopes / np.mean(now.solution.errors**2) + np.eye(size)
    root = 1.5 * SPREAD / np.sqrt(size) * np.linalg.cholesky(np.linalg.inv(information))
    longest = max(len(fit.flow) * fit.h / 5.0, fit.units[0].slowest)
    density = np.log(zones.weight / np.maximum(zones.high - zones.low, 1e-12))

    def accepted(tried: Fit, more: float = 0.0) -> bool:
        gained = (now.deviance - tried.deviance) / 2.0 / SPREAD**2 + more
        return bool(np.log(generator.uniform()) < gained)

    for step in range(1, THIN * count + 1):
        tried = now.at(now.p + root @ generator.standard_normal(size))
        if tried.p[0] >= 0.0 and tried.units[0].slowest <= longest and accepted(tried):
            now = tried
        if step % THIN == 0:
            other = int(generator.choice(len(zones.weight), p=zones.weight))
            tried = replace(now, flow=zones.fits[other].flow)
            if other != at and accepted(tried, density[at] - density[other]):
                at, now = other, tried
            solved = now.solution
            square = np.linalg.pinv(solved.weighted.T @ solved.weighted, 1e-10, hermitian=True)
            spread = SPREAD**2 * np.mean(solved.errors**2) * square
            c = generator.multivariate_normal(solved.c, spread, method="eigh")
            drawn.append((now.plant_of(c), at))
    return drawn
