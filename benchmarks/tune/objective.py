"""Compute the objective of a search for gains, on scenarios that no comparison uses."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from benchmarks.controllers.records import Factory
from benchmarks.loop.metrics import mean_error, settled, split
from benchmarks.loop.scenarios import Scenario


def _square(
    name: str, more: str, samples: int, amplitude: float, period: int, **plant: float
) -> Scenario:
    arguments = {"setpoint_amplitude": amplitude, "setpoint_period": period, **plant}
    return Scenario(name, f"square wave{more}", samples, arguments)


# Neighbours of the paper's cases, each with the first sample that counts: three that count from
# an untrained controller on, and two that count only what follows learning.
SCENARIOS: tuple[tuple[Scenario, int], ...] = (
    (Scenario("constant", "constant set point", 600, {"setpoint": 4.8}), 0),
    (_square("dead zone", ", dead zone 6.5 t/h", 1280, 5.1, 640, dead_zone=6.5), 0),
    (_square("noise", ", R = 0.4 °C²", 1040, 4.9, 520, noise_variance=0.4), 0),
    (_square("learnt", "", 2240, 5.2, 560), 1120),
    (_square("learnt, slow", "", 1920, 5.4, 640), 1280),
)


def score(
    factory: Factory, plant: Mapping[str, Any], runs: int, first_run: int, penalty: float
) -> dict[str, float]:
    """Judge a controller on the tuning scenarios, with `runs` runs of each.

    `plant` holds arguments of the environment that differ from the paper's. `first_run` is the
    seed of the first run; every scenario has seeds of its own. The penalty, degC, is for
    failing to settle.

    Returns
    -------
    dict
        For each scenario the median over runs of the mean |e|, degC; `not converged`, the
        share of runs at the constant set point that fail to settle; and `objective`, the mean
        of the medians plus the penalty times that share.
    """
    medians: dict[str, float] = {}
    for i, (scenario, first_sample) in enumerate(SCENARIOS):
        seed = first_run + i * 100_000
        arguments = {**plant, **scenario.arguments}
        trajectory = factory.run(arguments, scenario.samples, runs, seed)
        _, counted = split(trajectory, first_sample)
        medians[scenario.name] = float(np.median(mean_error(counted)))
        if scenario.name == "constant":
            failed = 1.0 - float(settled(trajectory).mean())
    objective = float(np.mean(list(medians.values()))) + penalty * failed
    return {**medians, "not converged": failed, "objective": objective}
