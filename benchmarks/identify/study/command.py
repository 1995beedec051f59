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
from benchmarks.lib.tables import groups, on_screen, write_csv
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
PARTS = ("true", "found", "low", "high")  # of each estimate
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
    moving: dict[str, Any] = {"setpoint": "random", "setpoint_amplitude": 5.0}
    arguments = plant | moving if kind == "loop" else plant
    env = gymnasium.make("MiddlePoint-v0", max_episode_steps=samples, **arguments)
    observation, info = env.reset(seed=int(generator.integers(2**31)))
    controller = simc_pi(Parameters(**plant))
    flow, temperature = np.empty(samples), np.empty(samples)
    for k, level in enumerate(levels[:samples]):
        temperature[k] = info["output"]
        action = controller.act(observation) if kind == "loop" else [level / 10.0]
        observation, *_, info = env.step(np.array(action, np.float32))
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
        `seconds` of processor time, and `refused`, why the log could not tell. If it could, of
        each estimate its truth, its value and the ends of its interval, by `PARTS`; and of each
        of `RIVALS` the share that it explains, its delay and its gain.
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
        model, refused = identify(log, DATA_SHEET), ""
    except CannotTellError as error:
        model, refused = None, str(error)
    result: dict[str, Any] = {"seconds": time.process_time() - began, "refused": refused}
    if model is None:
        return result
    for name, truth in truths.items():
        for part, value in zip(PARTS, (truth, *model.estimates[name]), strict=True):
            result[f"{name}_{part}"] = value
    last = np.arange(samples) >= samples * 2 // 3
    _, gain = of_impulse_response([log.flow], log.temperature, ~last)
    found = model.estimates
    answers = (
        (model.held_out.model, found["delay"].value, found["gain"].value),
        narmax(log),
        (model.held_out.impulse_response, math.nan, gain),
    )
    for rival, answer in zip(RIVALS, answers, strict=True):
        for what, value in zip(("explained", "delay", "gain"), answer, strict=True):
            result[f"{what}, {rival}"] = value
    return result


def narmax(log: Log) -> tuple[float, float, float]:
    """Return the share explained of the last third, delay and gain, by SysIdentPy.

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
        return share_of_last, math.nan, 0.0
    past = float(values[(codes > 1000) & (codes < 2000)].sum())
    gain = float(values[flows].sum()) / (1.0 - past)
    return share_of_last, float(codes[flows].min() - 2001), gain


def execute(options: options.Options, console: Console) -> str:
    """Run the study and print its tables."""
    out = out_folder(options.out)
    plants = {
        f"{kind} {i}": (kind, options.seed * 1_000_000 + i, plant)
        for kind in KINDS
        for i, plant in enumerate(
            synthetic_plants(options.logs, options.seed, options.samples, kind)
        )
    }
    tasks: dict[str, Callable[[], Any]] = {
        name: partial(task, plant, options.samples, seed, kind)
        for name, (kind, seed, plant) in plants.items()
    }
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
    found = pd.DataFrame(
        {"kind": kind, **plant, **results.pop(name)}
        for name, (kind, _, plant) in plants.items()
    )
    write_csv(out / "identify_study.csv", _rounded(found))
    closing = (
        f"{options.logs} logs a kind of {options.samples} samples, seed {options.seed}. Those "
        "that are refused are wrong estimates. Processor time of a log: median "
        f"{found['seconds'].median():.1f} s, longest {found['seconds'].max():.1f} s."
    )
    if results:
        closing = f"{loops.counted(list(results.values()))}\n\n{closing}"
    tables = [table(found), beside_rivals(found)]
    text = [each.to_markdown(index=False, disable_numparse=True) for each in tables]
    write_text(out / "identify_study.md", "\n\n".join([*text, f"{closing}\n"]))
    for each in tables:
        console.print(on_screen(each))
    return f"{closing} The tables are in {out}/"


def _rounded(found: pd.DataFrame) -> pd.DataFrame:
    """Return what is kept of each log, with no more digits than tell something."""
    kept = found.drop(columns=found.filter(regex="^([abc]|(delay|gain), .*)$").columns)
    for digits, names in ((6, f"_({'|'.join(PARTS)})$"), (4, "^explained, ")):
        for name, values in kept.filter(regex=names).items():
            kept[name] = [float(f"{value:.{digits}g}") for value in values]
    return kept


def table(found: pd.DataFrame) -> pd.DataFrame:
    """Return how often estimates are right and intervals cover, by the kind of log.

    Dead zones are counted from `TELLING` on. A log that is refused is a wrong estimate, and
    has no interval.
    """
    shown = {
        kind: [
            *(_share(*question, logs) for question in QUESTIONS.values()),
            str((logs["refused"] != "").sum()),
        ]
        for kind, logs in groups(found, "kind")
    }
    return pd.DataFrame({"how often": [*QUESTIONS, "refused"], **shown})


def _share(name: str, limit: float | None, found: pd.DataFrame) -> str:
    """Return how often an estimate is right, with the interval of this share."""
    truth, value, low, high = (found[f"{name}_{part}"] for part in PARTS)
    counted = truth.notna() & ((name != "dead_zone") | (truth >= TELLING))
    if limit is None:
        slack = 1e-9 * truth.abs()
        right = (low - slack <= truth) & (truth <= high + slack)
    else:
        counted |= truth.isna()  # it is refused
        absolute = name in ("delay", "dead_zone")
        right = (value - truth if absolute else value / truth - 1.0).abs() <= limit
    if not counted.any():
        return ""
    ends = share(right[counted].to_numpy(np.bool_))
    return f"{100 * ends.value:.0f} % [{100 * ends.low:.0f}, {100 * ends.high:.0f}]"


def beside_rivals(found: pd.DataFrame) -> pd.DataFrame:
    """Return the same of the rivals: gain within 10 %, and the median share explained."""
    rows = []
    for kind, logs in groups(found[found["refused"] == ""], "kind"):
        for rival in RIVALS:
            near = (logs[f"gain, {rival}"] / logs["gain_true"] - 1.0).abs() <= 0.1
            delays = logs[f"delay, {rival}"] - logs["delay_true"]
            within = f"{100 * (delays.abs() <= 1.0).mean():.0f} %"
            rows.append({
                "log": kind,
                "method": rival,
                "explained, median": f"{100 * np.median(logs[f'explained, {rival}']):.1f} %",
                "gain within 10 %": f"{100 * near.mean():.0f} %",
                "delay within one sample": "" if rival == "impulse response" else within,
            })  # fmt: skip
    return pd.DataFrame(rows)
