"""Counts how recommended loops do on the true plants, of which no two are alike."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy import signal

from benchmarks.identify.fit import identify
from benchmarks.identify.log import Log
from benchmarks.identify.margins import Loop
from benchmarks.identify.tuning import MOST_SENSITIVE, recommended
from mptc_gym import Parameters

KINDS = ("fast", "ringing", "integrating", "slow")
SLOWEST = {"fast": (0.0, 0.6), "slow": (0.9, 0.98), "integrating": (0.99, 0.999)}  # poles
ROWS, HELD = 1200, (8, 60)  # of a log; samples between two steps
NOISE = 0.01, 0.1  # deviations, as shares of the response's


def random_plant(number: int, seed: int) -> dict[str, Any]:
    """Return arguments of a plant, of the kinds in turn: A, B and the delay."""
    generator = np.random.default_rng([seed, number])
    kind = KINDS[number % len(KINDS)]
    poles: list[complex]
    if kind == "ringing":
        pole = generator.uniform(0.7, 0.97) * np.exp(1j * generator.uniform(0.1, 1.5))
        poles = [pole, pole.conjugate()]
    else:
        low, high = SLOWEST[kind]
        poles = [generator.uniform(low, high), generator.uniform(-0.5, 0.6)]
    zeros = generator.uniform(-1.5, 1.5, int(generator.integers(0, 3)))
    a, shape = np.real(np.poly(poles)), np.atleast_1d(np.poly(zeros))
    gain = generator.choice([-1.0, 1.0]) * 10.0 ** generator.uniform(-1.0, 1.0)
    b = gain * a.sum() / shape.sum() * shape
    return {"a": a.tolist(), "b": b.tolist(), "delay": int(generator.integers(0, 30)),
            "dead_zone": 0.0}  # fmt: skip


def task(number: int, seed: int) -> dict[str, float | str]:
    """Identify a plant, and return Ms of the recommended loops on it, infinite if unstable.

    Returns
    -------
    dict
        By the name of the controller, of those that are recommended; `refused`, why, if the log
        could not tell.
    """
    plant = random_plant(number, seed)
    generator = np.random.default_rng([seed, number, 1])
    flow: list[float] = []
    while len(flow) < ROWS:
        flow += [float(generator.uniform(-10.0, 10.0))] * int(generator.integers(*HELD))
    u = np.array(flow[:ROWS])
    driven = signal.lfilter([0.0] * (plant["delay"] + 1) + plant["b"], plant["a"], u)
    xi = signal.lfilter([1.0], plant["a"], generator.normal(size=ROWS))
    noise = generator.uniform(*NOISE) * np.std(driven) * xi / np.std(xi)
    try:
        model = identify(Log(u, driven + noise, 1.0))
    except ValueError as error:
        return {"refused": str(error)}
    tuned = recommended(model)
    found: dict[str, float | str] = {"refused": ""}
    for name, each in tuned.items():
        if each:
            on_plant = Loop(each.controller, Parameters(**plant)).margins
            found[name] = on_plant.sensitivity if on_plant.stable else math.inf
    return found


def counted(found: list[dict[str, Any]]) -> str:
    """Return how many loops were recommended, and how they do, in a sentence."""
    peaks = np.array([
        peak for each in found for name, peak in each.items() if name != "refused"
    ])  # fmt: skip
    refused = sum(bool(each["refused"]) for each in found)
    return (
        f"Of {len(found)} random plants ({', '.join(KINDS)}), {refused} are refused, and "
        f"{len(peaks)} loops are recommended. On the true plants, "
        f"{int(np.sum(peaks > MOST_SENSITIVE))} of them have Ms above {MOST_SENSITIVE:g}, and "
        f"{int(np.sum(np.isinf(peaks)))} are unstable."
    )
