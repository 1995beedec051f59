"""Generate plants that differ from the paper's: a grid over delay and gain, a random design."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import scipy  # loads its modules on first use

from benchmarks.loop.linear import nominal
from mptc_gym import Parameters

Arguments = dict[str, Any]  # arguments of the environment

# Ranges of the plants drawn for sweeps and for training. With a gain factor below 0.74, 5 degC
# is beyond the limits.
SPANS = {
    "delay": (6, 36),
    "dead_zone": (0.0, 8.0),
    "noise_variance": (0.0, 1.0),
    "gain_factor": (0.75, 1.6),
    "time_constant_factor": (0.5, 2.0),
}
GRID = {"delay": range(2, 42, 2), "gain_factor": np.linspace(0.75, 1.65, 10)}


def grid() -> list[Arguments]:
    """Return the paper's plant with other delays and gains, without noise."""
    return [
        {"delay": delay, "gain_factor": round(float(gain), 6)}
        for gain in GRID["gain_factor"]
        for delay in GRID["delay"]
    ]


def random_design(
    count: int, seed: int, samples: int, spans: Mapping[str, tuple[float, float]] = SPANS
) -> list[Arguments]:
    """Return `count` plants from a Latin hypercube over `spans`.

    The second half of them drift: over `samples` samples, their gain and time constant move to
    other values within the spans.
    """
    drawn = scipy.stats.qmc.LatinHypercube(
        len(spans) + 2, rng=np.random.default_rng(seed)
    ).random(count)
    drifting = ("gain_factor", "time_constant_factor")
    ends = np.array([*spans.values(), *(spans[name] for name in drifting)])
    rows = ends[:, 0] + drawn * (ends[:, 1] - ends[:, 0])
    plants = []
    for i, row in enumerate(rows.round(4).tolist()):
        plant = dict(zip(spans, row, strict=False)) | {"delay": round(row[0])}
        if i >= count // 2:
            gain, time_constant = row[len(spans) :]
            plant |= {
                "gain_drift": gain / plant["gain_factor"],
                "time_constant_drift": time_constant / plant["time_constant_factor"],
                "drift_samples": samples,
            }
        plants.append(plant)
    return plants


def around(plant: Arguments, design: Sequence[Arguments]) -> list[Arguments]:
    """Return the plants of a design, which are around the paper's, around another plant.

    They differ from it by the same factors: the delay, the dead zone and the factors on gain
    and time constant, and the noise variance as a share of the square of what the flow reaches.
    """
    ratios = np.array(_scales(Parameters(**plant))) / np.array(_scales(Parameters()))
    by_name = dict(zip(SPANS, ratios.tolist(), strict=True))

    def moved(name: str, value: float) -> float:
        there: float = by_name.get(name, 1.0) * value
        return round(there) if name in ("delay", "drift_samples") else there

    return [{name: moved(name, each[name]) for name in each} for each in design]


def _scales(plant: Parameters) -> list[float]:
    """Return a plant's delay, dead zone, variance of the reach, and factors, as in `SPANS`."""
    delay, zone, gain, time_constant, low, high = (
        sum(plant.range_of(name)) / 2.0
        for name in (
            "delay", "dead_zone", "gain_factor", "time_constant_factor", "u_min", "u_max"
        )
    )  # fmt: skip
    reach = nominal(plant).gain * (high - low) / 2.0
    return [delay, zone, reach**2, gain, time_constant]
