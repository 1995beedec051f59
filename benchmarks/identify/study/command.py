"""Counts how often plants are identified right: logs of known plants, of several kinds.

`python -m benchmarks.identify.study --help`. The plants are those of the random sweep that do
not drift, and plants of second order. Each is run in the environment itself. SysIdentPy and a
regularised impulse response get the same logs.
"""

from __future__ import annotations

import math
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
from benchmarks.identify.fit import identify
from benchmarks.identify.log import Log
from benchmarks.identify.model import CannotTellError
from benchmarks.identify.options import Knowledge
from benchmarks.identify.simulation import explained, of_impulse_response
from benchmarks.identify.study import loops, options
from benchmarks.lib.command_line import out_folder
from benchmarks.lib.fingerprint import fingerprint
from benchmarks.lib.statistics import share
from benchmarks.lib.storage import write_text
from benchmarks.lib.tables import on_screen, write_csv
from benchmarks.loop.designs import Arguments, random_design
from benchmarks.loop.linear import nominal
from mptc_gym import Parameters

NOISE = 0.02, 0.5  # R of the logs, degC^2
HELD = 30, 120  # samples between two steps of the flow
LEVELS = -10.0, 10.0  # of the flow, t/h
LONG, SHORT = (15.0, 40.0), (5.0, 15.0)  # samples, time constants of second order
DATA_SHEET = Knowledge(operating_flow=0.0, u_min=LEVELS[0], u_max=LEVELS[1])  # of the actuator
METER = 0.1  # t/h, of the noise of a flow meter
DRIFT = 0.05  # degC, of each step of a random walk of the base line
KINDS = {
    "steps": "steps of the flow",
    "loop": "a PI loop whose set point moves",
    "meter": f"steps, and a flow meter with noise of {METER:g} t/h",
    "drift": f"steps, and a base line that wanders by {DRIFT:g} °C a sample",
    "second order": "steps, and plants of second order with a long lag",
}
RIVALS = ("this one", "SysIdentPy", "impulse response")
TELLING = 2.0  # t/h, dead zones that are counted


def synthetic_plants(
    count: int, seed: int, samples: int, kind: str = "steps"
) -> list[Arguments]:
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


def synthetic_log(plant: Arguments, samples: int, seed: int, kind: str = "steps") -> Log:
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


def task(plant: Arguments, samples: int, seed: int, kind: str = "steps") -> dict[str, Any]:
    """Identify a plant from a log of it.

    Returns
    -------
    dict
        `seconds` of processor time, and of each estimate its truth, its value and the ends of
        its interval; `refused`, why, if the log could not tell. `explained`, `delays` and
        `gains` are those of `RIVALS`.
    """
    true = nominal(Parameters(**plant))
    truths = {
        "delay": float(plant["delay"]),
        "dead_zone": float(plant["dead_zone"]),
        "gain": true.gain,
        "time_constant": -true.sampling_interval / float(np.log(np.max(true.poles.real))),
        "noise_variance": float(plant["noise_variance"]),
    }
    log = synthetic_log(plant, samples, seed, kind)
    began = time.process_time()
    try:
        model = identify(log, DATA_SHEET)
    except CannotTellError as error:
        return {"seconds": time.process_time() - began, "refused": str(error)}
    result: dict[str, Any] = {"seconds": time.process_time() - began, "refused": ""}
    for name, truth in truths.items():
        found = model.estimates[name]
        result[name] = [truth, found.value, found.low, found.high]
    delay, gain, share = narmax(log)
    last = np.arange(samples) >= samples * 2 // 3
    _, of_response = of_impulse_response([log.flow], log.temperature, ~last)
    result["explained"] = [model.held_out.model, share, model.held_out.impulse_response]
    result["delays"] = [model.estimates["delay"].value, delay, math.nan]
    result["gains"] = [model.estimates["gain"].value, gain, of_response]
    return result


def narmax(log: Log) -> tuple[float, float, float]:
    """Return delay, gain and the share explained of the last third, by SysIdentPy.

    Its linear NARX model has three past outputs and 61 past flows to choose from, by orthogonal
    least squares and the Bayesian information criterion (W. R. Lacerda Junior et al., Journal
    of Open Source Software 5, 2020, 2384). All are NaN where the package is not installed.
    """
    try:
        from sysidentpy.basis_function import Polynomial
        from sysidentpy.model_structure_selection import FROLS
        from sysidentpy.parameter_estimation import LeastSquares
    except ModuleNotFoundError:
        return math.nan, math.nan, math.nan
    cut, lags = len(log.flow) * 2 // 3, 61
    x, y = log.flow[:, np.newaxis], log.temperature[:, np.newaxis]
    narx = FROLS(
        order_selection=True, n_info_values=10, ylag=3, xlag=lags, info_criteria="bic",
        estimator=LeastSquares(), basis_function=Polynomial(degree=1),
    )  # fmt: skip
    narx.fit(X=x[:cut], y=y[:cut])
    simulated = np.full(len(y), np.nan)
    simulated[cut - lags :] = narx.predict(X=x[cut - lags :], y=y[cut - lags :])[:, 0]
    share_of_last = explained(log.temperature, simulated, np.arange(len(y)) >= cut)
    # Regressors are 1000 + lag of the output and 2000 + lag of the flow.
    codes, values = narx.final_model[:, 0], narx.theta[:, 0]
    flows = codes > 2000
    if not flows.any():
        return math.nan, 0.0, share_of_last
    past = float(values[(codes > 1000) & (codes < 2000)].sum())
    gain = float(values[flows].sum()) / (1.0 - past)
    return float(codes[flows].min() - 2001), gain, share_of_last


def execute(options: options.Options, console: Console) -> str:
    """Run the study and print its tables."""
    out = out_folder(options.out)
    tasks: dict[str, Callable[[], Any]] = {}
    plants: list[tuple[str, Arguments]] = []
    for kind in KINDS:
        for i, plant in enumerate(
            synthetic_plants(options.logs, options.seed, options.samples, kind)
        ):
            seed = options.seed * 1_000_000 + i
            tasks[f"{kind} {i}"] = partial(task, plant, options.samples, seed, kind)
            plants.append((kind, plant))
    for i in range(options.plants or 0):
        tasks[f"plant {i}"] = partial(loops.task, i, options.seed)
    key = fingerprint(
        "benchmarks.identify.study.command",
        "benchmarks.identify.study.loops",
        samples=options.samples,
        seed=options.seed,
        logs=options.logs,
    )
    results = options.fan_out.open().run(tasks, out / "tasks" / key, title="logs")
    found = list(results.values())
    found, of_loops = found[: len(plants)], found[len(plants) :]
    by_kind = {
        kind: [each for (own, _), each in zip(plants, found, strict=True) if own == kind]
        for kind in KINDS
    }
    rows = [_row(*plant, each) for plant, each in zip(plants, found, strict=True)]
    write_csv(out / "identify_study.csv", pd.DataFrame(rows))
    seconds = np.array([each["seconds"] for each in found])
    closing = (
        f"{options.logs} logs a kind of {options.samples} samples, seed {options.seed}. Those "
        "that are refused are wrong estimates. Processor time of a log: median "
        f"{np.median(seconds):.1f} s, longest {seconds.max():.1f} s."
    )
    tables = [table(by_kind), beside_rivals(by_kind)]
    text = [each.to_markdown(index=False, disable_numparse=True) for each in tables]
    if of_loops:
        closing = f"{loops.counted(of_loops)}\n\n{closing}"
    write_text(out / "identify_study.md", "\n\n".join([*text, f"{closing}\n"]))
    for each in tables:
        console.print(on_screen(each))
    return f"{closing} The tables are in {out}/"


# Of which estimate, and how far it may be off; None asks whether its interval covers the truth.
QUESTIONS: dict[str, tuple[str, float | None]] = {
    "delay within one sample": ("delay", 1.0),
    "gain within 10 %": ("gain", 0.1),
    "time constant within 20 %": ("time_constant", 0.2),
    "dead zone within 1 t/h": ("dead_zone", 1.0),
    "interval of the delay covers": ("delay", None),
    "interval of the gain covers": ("gain", None),
    "interval of the time constant covers": ("time_constant", None),
    "interval of the dead zone covers": ("dead_zone", None),
}


def _is_right(name: str, limit: float | None, found: dict[str, Any]) -> bool:
    truth, value, low, high = found[name]
    if limit is None:
        slack = 1e-9 * abs(truth)
        return bool(low - slack <= truth <= high + slack)
    absolute = name in ("delay", "dead_zone")
    return bool((abs(value - truth) if absolute else abs(value / truth - 1.0)) <= limit)


def table(by_kind: dict[str, list[dict[str, Any]]]) -> pd.DataFrame:
    """Return how often estimates are right and intervals cover, by the kind of log.

    Dead zones are counted from `TELLING` on. A log that is refused is a wrong estimate, and
    has no interval.
    """
    rows = []
    for question, (name, limit) in QUESTIONS.items():
        row = {"how often": question}
        for kind, found in by_kind.items():
            flags = [
                not each["refused"] and _is_right(name, limit, each)
                for each in found
                if (each["refused"] and limit is not None)
                or (not each["refused"] and (name != "dead_zone" or each[name][0] >= TELLING))
            ]
            row[kind] = ""
            if flags:
                counted = share(np.array(flags, dtype=np.bool_))
                low, high = 100 * counted.low, 100 * counted.high
                row[kind] = f"{100 * counted.value:.0f} % [{low:.0f}, {high:.0f}]"
        rows.append(row)
    refused = {kind: str(sum(bool(each["refused"]) for each in found))
               for kind, found in by_kind.items()}  # fmt: skip
    shown: pd.DataFrame = pd.DataFrame([*rows, {"how often": "refused", **refused}])
    return shown


def beside_rivals(by_kind: dict[str, list[dict[str, Any]]]) -> pd.DataFrame:
    """Return the same of the rivals: gain within 10 %, and the median share explained."""
    rows = []
    for kind, found in by_kind.items():
        answers = [each for each in found if not each["refused"]]
        for i, rival in enumerate(RIVALS):
            near = [abs(each["gains"][i] / each["gain"][0] - 1.0) <= 0.1 for each in answers]
            delays = [abs(each["delays"][i] - each["delay"][0]) <= 1.0 for each in answers]
            shares = [each["explained"][i] for each in answers]
            rows.append({
                "log": kind,
                "method": rival,
                "explained, median": f"{100 * np.median(shares):.1f} %",
                "gain within 10 %": f"{100 * np.mean(near):.0f} %",
                "delay within one sample": f"{100 * np.mean(delays):.0f} %" if i < 2 else "",
            })  # fmt: skip
    shown: pd.DataFrame = pd.DataFrame(rows)
    return shown


def _row(kind: str, plant: Arguments, found: dict[str, Any]) -> dict[str, Any]:
    numbers = {name: value for name, value in plant.items() if not isinstance(value, list)}
    row = {"kind": kind, **numbers, "seconds": found["seconds"], "refused": found["refused"]}
    if found["refused"]:
        return row
    for name in ("delay", "dead_zone", "gain", "time_constant", "noise_variance"):
        for part, value in zip(("true", "found", "low", "high"), found[name], strict=True):
            row[f"{name}_{part}"] = float(f"{value:.6g}")
    for rival, value in zip(RIVALS, found["explained"], strict=True):
        row[f"explained, {rival}"] = float(f"{value:.4g}")
    return row
