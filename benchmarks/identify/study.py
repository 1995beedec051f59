"""How well plants are identified: 100 logs of known plants, and what is found in them.

`python -m benchmarks.identify.study --help`. The plants are those of the random sweep that do
not drift. Each is run in the environment itself, by steps of the flow.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pandas as pd
from rich.console import Console
from scipy import signal

from benchmarks.controllers.engineered import simc_pi
from benchmarks.designs import Plant, random_design
from benchmarks.identify.fit import identify
from benchmarks.identify.log import Log
from benchmarks.identify.model import CannotTellError, Interval
from benchmarks.lib import command_line
from benchmarks.lib.fingerprint import fingerprint
from benchmarks.lib.statistics import share
from benchmarks.lib.storage import write_text
from benchmarks.lib.tables import on_screen, write_csv
from benchmarks.linear import nominal
from mptc_gym import Parameters

NOISE = 0.02, 0.5  # R of the logs, degC^2
HELD = 30, 120  # samples between two steps of the flow
LEVELS = -10.0, 10.0  # of the flow, t/h
LONG, SHORT = (15.0, 40.0), (5.0, 15.0)  # samples, time constants of second order
METER = 0.1  # t/h, of the noise of a flow meter
DRIFT = 0.05  # degC, of each step of a random walk of the base line
KINDS = {
    "steps": "steps of the flow",
    "loop": "a PI loop whose set point moves",
    "meter": f"steps, and a flow meter with noise of {METER:g} t/h",
    "drift": f"steps, and a base line that wanders by {DRIFT:g} °C a sample",
    "second order": "steps, and plants of second order with a long lag",
}
TELLING = 2.0  # t/h, dead zones that are counted


def synthetic_plants(count: int, seed: int, samples: int, kind: str = "steps") -> list[Plant]:
    """Return plants of the random sweep that do not drift, with noise of `NOISE`.

    Those of the kind "second order" have two time constants, of `LONG` and `SHORT` samples.
    """
    low, high = NOISE
    plants = [
        {**plant, "noise_variance": round(low + (high - low) * plant["noise_variance"], 6)}
        for plant in random_design(2 * count, seed, samples)[:count]
    ]
    if kind != "second order":
        return plants
    generator = np.random.default_rng(seed)
    for plant in plants:
        slow, fast = generator.uniform(*LONG), generator.uniform(*SHORT)
        gain = -0.6825 * plant.pop("gain_factor", 1.0)
        plant.pop("time_constant_factor", None)
        continuous = signal.zpk2ss([], [-1.0 / slow, -1.0 / fast], gain / (slow * fast))
        sampled = signal.cont2discrete(continuous, 1.0)
        b, a = signal.ss2tf(*sampled[:4])
        c = [1.0, -float(np.exp(-1.0 / fast))]  # noise of first order, that of the slow pole
        plant |= {"a": a.tolist(), "b": b[0, 1:].tolist(), "c": c}
    return plants


def synthetic_log(plant: Plant, samples: int, seed: int, kind: str = "steps") -> Log:
    """Return a log of a plant in the environment.

    Parameters
    ----------
    plant
        Arguments of the environment.
    samples
        Number of rows.
    seed
        Of the steps and of the noise.
    kind
        One of `KINDS`.
    """
    generator = np.random.default_rng(seed)
    levels: list[float] = []
    while len(levels) < samples:
        held = int(generator.integers(HELD[0], HELD[1], endpoint=True))
        levels += [float(generator.uniform(*LEVELS))] * held
    setpoint: dict[str, Any] = {}
    if kind == "loop":
        setpoint = {"setpoint": "random", "setpoint_amplitude": 5.0}
    env = gymnasium.make("MiddlePoint-v0", max_episode_steps=samples, **plant, **setpoint)
    observation, info = env.reset(seed=int(generator.integers(2**31)))
    controller = simc_pi(Parameters(**plant))
    flow, temperature = np.empty(samples), np.empty(samples)
    for k in range(samples):
        temperature[k] = info["output"]
        action = np.array([levels[k] / 10.0], np.float32)
        if kind == "loop":
            action = np.asarray(controller.act(observation), np.float32)
        observation, *_, info = env.step(action)
        flow[k] = info["command"]
    if kind == "meter":
        flow += generator.normal(0.0, METER, samples)
    if kind == "drift":
        temperature += np.cumsum(generator.normal(0.0, DRIFT, samples))
    return Log(flow, temperature, Parameters(**plant).sampling_interval)


def cell(plant: Plant, samples: int, seed: int, kind: str = "steps") -> dict[str, Any]:
    """Identify a plant from a log of it.

    Returns
    -------
    dict
        `seconds` of processor time, and of each estimate its truth, its value and the ends of
        its interval; `refused`, why, if the log could not tell.
    """
    parameters = Parameters(**plant)
    true = nominal(parameters)
    pole = float(np.max(true.poles.real))
    truths = {
        "delay": float(plant["delay"]),
        "dead_zone": float(plant["dead_zone"]),
        "gain": true.gain,
        "time_constant": -true.sampling_interval / float(np.log(pole)),
        "noise_variance": float(plant["noise_variance"]),
    }
    log = synthetic_log(plant, samples, seed, kind)
    began = time.process_time()
    try:
        model = identify(log)
    except CannotTellError as error:
        return {"seconds": time.process_time() - began, "refused": str(error)}
    result: dict[str, Any] = {"seconds": time.process_time() - began, "refused": ""}
    for name, truth in truths.items():
        found = model.estimates[name]
        result[name] = [truth, found.value, found.low, found.high]
    return result


def _add_options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    count = command_line.number
    add("--logs", type=count, default=100, metavar="N", help="logs, each of another plant")
    add("--samples", type=count, default=1200, metavar="N", help="rows of a log")
    add(
        "--seed",
        type=command_line.seed,
        default=1,
        metavar="N",
        help="seed that plants, steps of the flow and noise are drawn with",
    )
    command_line.add_fan_out(parser, "identifications")
    command_line.add_out(parser, "results/identify-study")


@command_line.command(
    "identify.study",
    "Identify known plants from synthetic logs, and count how often that is right.",
    _add_options,
    interrupted="what has finished is kept, and the next call goes on.",
)
def main(options: argparse.Namespace, console: Console) -> str:
    """Run the study and print its table."""
    out = command_line.out_folder(options.out)
    plants = synthetic_plants(options.logs, options.seed, options.samples)
    cells: dict[str, Callable[[], Any]] = {
        f"log {i}": partial(cell, plant, options.samples, options.seed * 1_000_000 + i)
        for i, plant in enumerate(plants)
    }
    key = fingerprint("benchmarks.identify.study", samples=options.samples, seed=options.seed,
                      logs=options.logs)  # fmt: skip
    results = command_line.fan_out(options).run(cells, out / "cells" / key, title="logs")
    found = list(results.values())
    rows = pd.DataFrame([_row(plant, each) for plant, each in zip(plants, found, strict=True)])
    write_csv(out / "identify_study.csv", rows)
    summary = table(found)
    seconds = np.array([each["seconds"] for each in found])
    closing = (
        f"{len(found)} logs of {options.samples} samples, seed {options.seed}; "
        f"{sum(bool(each['refused']) for each in found)} refused, which count as wrong. "
        f"Processor time of a log: median {np.median(seconds):.1f} s, longest "
        f"{seconds.max():.1f} s."
    )
    text = summary.to_markdown(index=False, disable_numparse=True)
    write_text(out / "identify_study.md", f"{text}\n\n{closing}\n")
    console.print(on_screen(summary))
    return f"{closing} The table is in {out}/"


def table(found: list[dict[str, Any]]) -> pd.DataFrame:
    """Return how often estimates are right and intervals cover, with 95 % intervals."""

    def relative(limit: float) -> Callable[[float, Interval], bool]:
        return lambda truth, each: abs(each.value / truth - 1.0) <= limit

    def absolute(limit: float) -> Callable[[float, Interval], bool]:
        return lambda truth, each: abs(each.value - truth) <= limit

    def covers(truth: float, each: Interval) -> bool:
        slack = 1e-9 * abs(truth)
        return each.low - slack <= truth <= each.high + slack

    questions: list[tuple[str, str, Callable[[float, Interval], bool], str]] = [
        ("delay within one sample", "delay", absolute(1.0), "95 %"),
        ("steady-state gain within 10 %", "gain", relative(0.1), "90 %"),
        ("time constant within 20 %", "time_constant", relative(0.2), "90 %"),
        ("dead zone within 1 t/h, of 2 and more", "dead_zone", absolute(1.0), "85 %"),
        ("interval of the delay covers", "delay", covers, "90 to 99 %"),
        ("interval of the gain covers", "gain", covers, "90 to 99 %"),
        ("interval of the time constant covers", "time_constant", covers, ""),
        ("interval of the dead zone covers, of 2 and more", "dead_zone", covers, "90 %"),
        ("interval of R covers", "noise_variance", covers, ""),
    ]
    rows: list[tuple[str, ...]] = []
    for question, name, right, aim in questions:
        flags = []
        for each in found:
            if each["refused"]:
                flags.append(False)
                continue
            truth, value, low, high = each[name]
            if name == "dead_zone" and truth < TELLING:
                continue
            flags.append(right(truth, Interval(value, low, high)))
        counted = share(np.array(flags, dtype=np.bool_))
        rows.append(
            (
                question,
                f"{100 * counted.value:.0f} % of {counted.runs}",
                f"[{100 * counted.low:.0f}, {100 * counted.high:.0f}]",
                aim,
            )
        )
    columns = ["what", "how often", "95 % (%)", "aim"]
    shown: pd.DataFrame = pd.DataFrame(rows, columns=columns)
    return shown


def _row(plant: Plant, found: dict[str, Any]) -> dict[str, Any]:
    row: dict[str, Any] = {**plant, "seconds": found["seconds"], "refused": found["refused"]}
    for name in ("delay", "dead_zone", "gain", "time_constant", "noise_variance"):
        if name in found and not found["refused"]:
            values = found[name]
            for part, value in zip(("true", "found", "low", "high"), values, strict=True):
                row[f"{name}_{part}"] = float(f"{value:.6g}")
    return row


if __name__ == "__main__":
    sys.exit(main(None))
