"""Compare what a valve may make of its commands, and what may change a plant."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.identify.fit import Array, Problem, one_lag

Passed = Callable[[Array, float], Array]


def following(rule: Callable[[float, float, float], float]) -> Passed:
    """Return a valve that moves from its position by `rule(position, command, size)`."""

    def passed(flow: Array, size: float) -> Array:
        position, found = flow[0], []
        for command in flow.tolist():
            position = rule(position, command, size)
            found.append(position)
        return np.array(found)

    return passed


@dataclass(frozen=True)
class Kind:
    """What may lie between a command and its effect."""

    passed: Passed
    """The flow behind it, of a flow from the operating point and a size."""
    sizes: tuple[float, ...] = (0.1, 0.16, 0.24, 0.34, 0.46)
    """Sizes to try, as shares of the largest flow; of a rate, in a delay and a lag."""
    delays: tuple[float, ...] = (1.0,)
    """Shares of the delay to try: some valves look like a part of it."""


SOUND = Kind(lambda u, _: u, (0.0,))
# A linear controller can be tuned for the plant behind these.
VALVES = {
    "dead zone": Kind(lambda u, size: np.where(np.abs(u) < size, 0.0, u)),
    "subtractive dead zone": Kind(
        lambda u, size: np.sign(u) * np.maximum(np.abs(u) - size, 0.0)
    ),
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
FINER = (0.75, 0.87, 1.0, 1.15, 1.33), (0.93, 1.0, 1.07), ()  # sizes around the best one


@dataclass(frozen=True)
class Hypothesis:
    """A valve or a change of the plant, with the best plant for it."""

    name: str
    size: float
    """t/h, of a rate t/h a row; of a change its share of the gain."""
    drop: float
    """What it takes from the deviance."""
    problem: Problem
    p: Array
    gain: float
    """Of the plant behind it."""


def with_valve(
    problem: Problem, shape: str, p: Array, command: Array, kinds: dict[str, Kind]
) -> list[Hypothesis]:
    """Return a sound valve and other kinds, each with its best size, the likeliest first.

    `command` is the flow commanded, from the operating point.
    """
    found, largest, plain = list[Hypothesis](), float(np.abs(command).max()), 0.0
    for name, kind in {"none": SOUND, **kinds}.items():
        unit = largest * (problem.h / problem.scale if name == "rate limit" else 1.0)
        places = [np.r_[share * p[0], p[1:]] for share in kind.delays]
        sizes = [unit * share for share in kind.sizes]
        # A size at a place, and the place at that size, in turns.
        for finer in FINER:
            passed = [(problem.behind(kind.passed(command, size)), size) for size in sizes]
            tried = [(*each, q) for each in passed for q in places]
            behind, size, q = min(tried, key=lambda x: x[0].solve(shape, x[2]).deviance)
            deviance, q = behind.refined(shape, q, 12)
            sizes, places = [size * factor for factor in finer], [q]
        plain = plain if found else deviance
        gain = behind.plant(shape, q, behind.solve(shape, q).c).gain
        drop = plain - deviance
        found.append(Hypothesis(name, size, drop, behind, q, gain))
    return sorted(found, key=lambda each: -round(each.drop))


def with_hysteresis(problem: Problem, shape: str, p: Array, command: Array) -> list[Hypothesis]:
    """Return backlash and stiction, each with its best size, plant and noise."""
    own, found = problem.reweighted(shape, p), []
    plain = own.refined(shape, p, 12)[0]
    for name, kind in HYSTERESES.items():
        places = [np.r_[share * p[0], p[1:]] for share in kind.delays]
        sizes = [float(np.abs(command).max()) * share for share in kind.sizes]
        # The plant that was found without hysteresis is too slow: each size has its own.
        for finer in FINER:
            tried = []
            for size in sizes:
                behind = problem.behind(kind.passed(command, size))
                prices = [behind.solve(shape, q).deviance for q in places]
                nearest = places[int(np.argmin(prices))]
                tried.append((*behind.refined(shape, nearest, 8), size, behind))
            _, q, size, behind = min(tried, key=lambda each: each[0])
            sizes, places = [size * factor for factor in finer], [q]
        # Nor is the noise what that plant left.
        behind = behind.reweighted(shape, q)
        deviance, q = behind.refined(shape, q, 12)
        gain = behind.plant(shape, q, behind.solve(shape, q).c).gain
        found.append(Hypothesis(name, size, plain - deviance, behind, q, gain))
    return found


def with_change(problem: Problem, shape: str, p: Array) -> list[Hypothesis]:
    """Return what changes a plant's gain or speed, each as one more input of the plant."""
    flow, plain = problem.flow, problem.refined(shape, p, 12)[0]
    answer = one_lag(problem.units(shape, p)[0].slowest).simulated(flow, problem.h)
    inputs = {
        "gain by level": flow**2 / np.abs(flow).max(),
        "gain by time": flow * np.linspace(-1.0, 1.0, len(flow)),
        "speed by direction": np.abs(np.gradient(answer, problem.h)) * problem.scale,
    }
    found = []
    for name, each in inputs.items():
        more = replace(problem, extra=(each,))
        deviance, q = more.refined(shape, p, 16)
        c, units = more.solve(shape, q).c, len(more.units(shape, q))
        gain = float(c[:units].sum())
        found.append(Hypothesis(name, float(c[units]) / gain, plain - deviance, more, q, gain))
    return found
