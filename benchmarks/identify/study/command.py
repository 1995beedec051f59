"""Count how often plants are identified correctly, and try recommended loops on true plants.

Logs of several kinds are recorded in the environment, with plants of the random sweep that do
not drift and with second-order plants. SysIdentPy and a regularised impulse response get the
same logs. The recommended loops are tried on random plants, no two of them alike.
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
from benchmarks.identify.margins import Loop
from benchmarks.identify.model import CannotTellError
from benchmarks.identify.options import Knowledge
from benchmarks.identify.simulation import explained, of_impulse_response
from benchmarks.identify.study.options import Options
from benchmarks.identify.tuning import MOST_SENSITIVE, recommended
from benchmarks.lib.command_line import out_folder
from benchmarks.lib.fingerprint import fingerprint
from benchmarks.lib.statistics import share
from benchmarks.lib.storage import write_text
from benchmarks.lib.tables import groups, on_screen, write_csv
from benchmarks.loop.designs import Arguments, random_design
from benchmarks.loop.linear import nominal
from mptc_gym import Parameters

NOISE = 0.02, 0.5  # range of R in the logs, degC^2
HELD = 30, 120  # samples between two steps of the flow
LEVELS = -10.0, 10.0  # range of the flow, t/h
LONG, SHORT = (15.0, 40.0), (5.0, 15.0)  # time constants of second-order plants, samples
DATA_SHEET = Knowledge(operating_flow=0.0, u_min=LEVELS[0], u_max=LEVELS[1])  # of the actuator
METER = 0.1  # standard deviation of a flow meter's noise, t/h
DRIFT = 0.05  # standard deviation of a step of the base line's random walk, degC
KINDS = ("steps", "loop", "meter", "drift", "second order")  # of logs
RIVALS = ("this one", "SysIdentPy", "impulse response")
TELLING = 2.0  # smallest dead zone that is counted, t/h
PARTS = ("true", "found", "low", "high")  # of each estimate
# Random plants for the loops: magnitude of the slowest pole, by kind.
POLES = {
    "fast": (0.0, 0.6),
    "ringing": (0.7, 0.97),
    "integrating": (0.99, 0.999),
    "slow": (0.9, 0.98),
}
OF_LOOPS, HELD_FOR_LOOPS = 1200, (8, 60)  # rows of a log; samples between two steps
SHARES = 0.01, 0.1  # standard deviation of the noise, as a share of the response's
# The estimate and how far off it may be; None asks whether its interval covers the truth.
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
    """Return plants of the random sweep that do not drift, with noise in the range `NOISE`.

    Plants of the kind "second order" have two time constants, within `LONG` and `SHORT`.
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
        c = [1.0, -float(np.exp(-1.0 / fast))]  # first-order noise with the slow pole
        plant |= {"a": a.tolist(), "b": b[0, 1:].tolist(), "c": c}
    return plants


def synthetic_log(plant: Arguments, samples: int, seed: int, kind: str = "steps") -> Log:
    """Return a log of a plant in the environment; steps and noise are drawn with the seed.

    In the kind "loop", a PI controller follows a moving set point; in all others the flow moves
    in steps. "meter" adds noise to the flow, and "drift" a random walk to the temperature.
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
    """Identify a plant from a synthetic log.

    Returns
    -------
    dict
        `kind`, the plant, `seconds` of processor time, and `refused`, the reason if the log is
        refused. If it is not, also the true value, estimate and interval of each quantity, by
        `PARTS`, and the share explained, the delay and the gain of each of `RIVALS`.
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
    result = {"kind": kind, **plant, "seconds": time.process_time() - began, "refused": refused}
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
    """Return the share of the last third that SysIdentPy explains, its delay and its gain.

    Its linear NARX model selects among three past outputs and 61 past flows by orthogonal least
    squares and the Bayesian information criterion (W. R. Lacerda Junior et al., Journal of Open
    Source Software 5, 2020, 2384). All are NaN if the package is not installed.
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
    # Regressors are coded as 1000 + lag of the output and 2000 + lag of the flow.
    codes, values = narx.final_model[:, 0], narx.theta[:, 0]
    flows = codes > 2000
    if not flows.any():
        return share_of_last, math.nan, 0.0
    past = float(values[(codes > 1000) & (codes < 2000)].sum())
    gain = float(values[flows].sum()) / (1.0 - past)
    return share_of_last, float(codes[flows].min() - 2001), gain


def random_plant(number: int, seed: int) -> dict[str, Any]:
    """Return the arguments of a random plant, with the kinds of `POLES` taking turns."""
    generator = np.random.default_rng([seed, number])
    kind = list(POLES)[number % len(POLES)]
    poles: list[complex] = [generator.uniform(*POLES[kind])]
    if kind == "ringing":
        poles[0] *= np.exp(1j * generator.uniform(0.1, 1.5))
        poles.append(poles[0].conjugate())
    else:
        poles.append(generator.uniform(-0.5, 0.6))
    zeros = generator.uniform(-1.5, 1.5, int(generator.integers(0, 3)))
    a, shape = np.real(np.poly(poles)), np.atleast_1d(np.poly(zeros))
    gain = generator.choice([-1.0, 1.0]) * 10.0 ** generator.uniform(-1.0, 1.0)
    b = gain * a.sum() / shape.sum() * shape
    delay = int(generator.integers(0, 30))
    return {"a": a.tolist(), "b": b.tolist(), "delay": delay, "dead_zone": 0.0}


def task_of_loops(number: int, seed: int) -> dict[str, Any]:
    """Identify a random plant, and return Ms of the recommended loops on it.

    Returns
    -------
    dict
        `refused`, the reason if the log is refused, and `peaks`, each Ms, infinite for a loop
        that is not stable.
    """
    plant = random_plant(number, seed)
    generator = np.random.default_rng([seed, number, 1])
    flow: list[float] = []
    while len(flow) < OF_LOOPS:
        level = float(generator.uniform(*LEVELS))
        flow += [level] * int(generator.integers(*HELD_FOR_LOOPS))
    u = np.array(flow[:OF_LOOPS])
    driven = signal.lfilter([0.0] * (plant["delay"] + 1) + plant["b"], plant["a"], u)
    xi = signal.lfilter([1.0], plant["a"], generator.normal(size=OF_LOOPS))
    noise = generator.uniform(*SHARES) * np.std(driven) * xi / np.std(xi)
    try:
        model = identify(Log(u, driven + noise, 1.0))
    except ValueError as error:
        return {"refused": str(error), "peaks": []}
    margins = [
        Loop(each.controller, Parameters(**plant)).margins
        for each in recommended(model).values() if each
    ]  # fmt: skip
    return {"refused": "", "peaks": [m.sensitivity if m.stable else math.inf for m in margins]}


def counted(found: list[dict[str, Any]]) -> str:
    """Return in words how many loops were recommended and how well they do."""
    peaks = np.concatenate([each["peaks"] for each in found])
    refused = sum(bool(each["refused"]) for each in found)
    return (
        f"Of {len(found)} random plants ({', '.join(POLES)}), {refused} are refused, and "
        f"{len(peaks)} loops are recommended. On the true plants, "
        f"{np.sum(peaks > MOST_SENSITIVE)} of them have Ms above {MOST_SENSITIVE:g}, and "
        f"{np.sum(np.isinf(peaks))} are unstable."
    )


def execute(options: Options, console: Console) -> str:
    """Run the study and print its tables."""
    out = out_folder(options.out)
    tasks: dict[str, Callable[[], Any]] = {
        f"{kind} {i}": partial(task, plant, options.samples, options.seed * 1_000_000 + i, kind)
        for kind in KINDS
        for i, plant in enumerate(
            synthetic_plants(options.logs, options.seed, options.samples, kind)
        )
    }
    logs = list(tasks)
    for i in range(options.plants or 0):
        tasks[f"plant {i}"] = partial(task_of_loops, i, options.seed)
    shaped_by = {name: getattr(options, name) for name in ("samples", "seed", "logs")}
    key = fingerprint("benchmarks.identify.study.command", **shaped_by)
    results = options.fan_out.open().run(tasks, out / "tasks" / key, title="logs")
    found = pd.DataFrame([results.pop(name) for name in logs])
    write_csv(out / "identify_study.csv", _rounded(found))
    closing = (
        f"{options.logs} logs a kind of {options.samples} samples, seed {options.seed}. Those "
        "that are refused are wrong estimates. Processor time of a log: median "
        f"{found['seconds'].median():.1f} s, longest {found['seconds'].max():.1f} s."
    )
    if results:
        closing = f"{counted(list(results.values()))}\n\n{closing}"
    tables = [table(found), beside_rivals(found)]
    text = [each.to_markdown(index=False, disable_numparse=True) for each in tables]
    write_text(out / "identify_study.md", "\n\n".join([*text, f"{closing}\n"]))
    for each in tables:
        console.print(on_screen(each))
    return f"{closing} The tables are in {out}/"


def _rounded(found: pd.DataFrame) -> pd.DataFrame:
    """Return the columns that are kept, rounded to meaningful digits."""
    kept = found.drop(columns=found.filter(regex="^([abc]|(delay|gain), .*)$").columns)
    for digits, names in ((6, f"_({'|'.join(PARTS)})$"), (4, "^explained, ")):
        for name, values in kept.filter(regex=names).items():
            kept[name] = [float(f"{value:.{digits}g}") for value in values]
    return kept


def table(found: pd.DataFrame) -> pd.DataFrame:
    """Return how often estimates are right and intervals cover the truth, by kind of log.

    Dead zones below `TELLING` are not counted. A refused log counts as a wrong estimate, and
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
    """Return how often an estimate is right, with a confidence interval."""
    truth, value, low, high = (found[f"{name}_{part}"] for part in PARTS)
    counted = truth.notna() & ((name != "dead_zone") | (truth >= TELLING))
    if limit is None:
        slack = 1e-9 * truth.abs()
        right = (low - slack <= truth) & (truth <= high + slack)
    else:
        counted |= truth.isna()  # refused logs
        absolute = name in ("delay", "dead_zone")
        right = (value - truth if absolute else value / truth - 1.0).abs() <= limit
    if not counted.any():
        return ""
    ends = share(right[counted].to_numpy(np.bool_))
    return f"{100 * ends.value:.0f} % [{100 * ends.low:.0f}, {100 * ends.high:.0f}]"


def beside_rivals(found: pd.DataFrame) -> pd.DataFrame:
    """Compare with rivals: median share explained, and how often gain and delay are right."""
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
