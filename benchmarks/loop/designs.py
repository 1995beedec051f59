"""Plants that are not the paper's: a grid over delay and gain, or a random design."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

Arguments = dict[str, Any]  # of the environment

# What drawn plants differ in, to sweep over or to train on. A gain below 0.74 puts 5 degC
# beyond the limits.
SPANS = {
    "delay": (6, 36),
    "dead_zone": (0.0, 8.0),
    "noise_variance": (0.0, 1.0),
    "gain_factor": (0.75, 1.6),
    "time_constant_factor": (0.5, 2.0),
}
# Nineteen of twenty such plants lie beyond `SPANS`, which are those of the self-tuning bank.
WIDE = {
    "delay": (0, 60),
    "dead_zone": (0.0, 10.0),
    "noise_variance": (0.0, 1.0),
    "gain_factor": (0.5, 3.0),
    "time_constant_factor": (0.25, 4.0),
}
GRID = {"delay": range(2, 42, 2), "gain_factor": np.linspace(0.75, 1.65, 10)}


def grid() -> list[Arguments]:
    """Return the paper's plant with other delays and other gains, without noise."""
    return [
        {"delay": delay, "gain_factor": round(float(gain), 6)}
        for gain in GRID["gain_factor"]
        for delay in GRID["delay"]
    ]


def random_design(
    count: int, seed: int, samples: int, spans: Mapping[str, tuple[float, float]] = SPANS
) -> list[Arguments]:
    """Return plants that differ in everything, spread evenly over spans.

    The second half of them drift: in the course of `samples` samples, gain and time constant
    go to another place in their spans. The design is a Latin hypercube.
    """
    from scipy.stats import qmc  # here: it takes long to import

    drawn = qmc.LatinHypercube(len(spans) + 2, rng=np.random.default_rng(seed)).random(count)
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
