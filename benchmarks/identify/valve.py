"""Compare what a valve may make of its commands, and what may change a plant."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.identify.fit import Array, Fit, in_series

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


# A linear controller can be tuned for the plant behind these.
VALVES = {
    "none": Kind(lambda u, _: u, (0.0,)),
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
    fit: Fit


def with_valves(
    fit: Fit, command: Array, kinds: dict[str, Kind], plain: Fit | None = None
) -> list[Hypothesis]:
    """Return kinds of valves, each with its best size and plant, the likeliest first.

    `command` is the flow commanded, from the operating point. What they explain is that beyond
    a plain fit, by default that of the first kind.
    """
    found, largest = [], float(np.abs(command).max())
    for name, kind in kinds.items():
        unit = largest * (fit.h / fit.scale if name == "rate limit" else 1.0)
        places = [fit.at(np.r_[share * fit.p[0], fit.p[1:]]) for share in kind.delays]
        sizes = [unit * share for share in kind.sizes]
        # A size at a place, and the place at that size, in turns. The plant that was found
        # without hysteresis is too slow for one: there each size has its own place.
        for finer in FINER:
            tried = []
            for size in sizes:
                passed = kind.passed(command, size)
                nearest = min(
                    (each.behind(passed) for each in places), key=lambda each: each.deviance
                )
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
