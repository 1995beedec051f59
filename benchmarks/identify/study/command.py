"""Count how often plants are identified correctly, and try recommended loops on true plants.

Logs of several kinds are recorded in the environment, with plants of the random sweep that do
not drift and with second-order plants. The recommended loops are tried on random plants, no two
of them alike, and on the plants with faulty valves of `faults`.
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

from benchmarks.controllers.roster import simc_pi
from benchmarks.identify.__main__ import Knowledge
from benchmarks.identify.fit import identify
from benchmarks.identify.log import Log
from benchmarks.identify.model import CannotTellError
from benchmarks.identify.study.__main__ import Options
from benchmarks.identify.study.faults import FAULTS, HARMFUL, faulty
from benchmarks.identify.tuning import MOST_SENSITIVE, recommended
from benchmarks.lib.command import out_folder
from benchmarks.lib.statistics import share
from benchmarks.lib.storage import Kept, write_text
from benchmarks.lib.tables import ScreenTable, groups, write_csv
from benchmarks.loop.designs import Arguments, random_design
from benchmarks.loop.linear import LinearModel, nominal
from benchmarks.loop.margins import Loop
from mptc_gym import Parameters

LEVELS = -10.0, 10.0  # range of the flow, t/h
KINDS = ("steps", "loop", "meter", "drift", "second order")  # of logs
EXPLAINED = "explained by the model, median", "explained by an impulse response, median"
RANDOM = "random plant"  # kind of the plants on which only loops are tried
PARTS = ("true", "found", "low", "high")  # of each estimate
# Random plants for the loops: magnitude of the slowest pole, by kind.
POLES = {
    "fast": (0.0, 0.6),
    "ringing": (0.7, 0.97),
    "integrating": (0.99, 0.999),
    "slow": (0.9, 0.98),
}
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
    """Return plants of the random sweep that do not drift, with noise of 0.02 to 0.5 degC^2.

    Plants of the kind "second order" have two time constants, of 15 to 40 and 5 to 15 samples.
    """
    plants = [
        {**plant, "noise_variance": round(0.02 + 0.48 * plant["noise_variance"], 6)}
        for plant in random_design(2 * count, seed, samples)[:count]
    ]
    if kind != "second order":
        return plants
    generator = np.random.default_rng(seed)
    for plant in plants:
        slow, fast = generator.uniform(15.0, 40.0), generator.uniform(5.0, 15.0)
        gain = -0.6825 * plant.pop("gain_factor", 1.0)
        plant.pop("time_constant_factor", None)
        continuous = signal.zpk2ss([], [-1.0 / slow, -1.0 / fast], gain / (slow * fast))
        b, a = signal.ss2tf(*signal.cont2discrete(continuous, 1.0)[:4])
        c = [1.0, -float(np.exp(-1.0 / fast))]  # first-order noise with the slow pole
        plant |= {"a": a.tolist(), "b": b[0, 1:].tolist(), "c": c}
    return plants


def steps(
    generator: np.random.Generator, samples: int, shortest: int, longest: int
) -> list[float]:
    """Return a flow that moves in steps, and is held between them."""
    levels: list[float] = []
    while len(levels) < samples:
        held = int(generator.integers(shortest, longest, endpoint=True))
        levels += [float(generator.uniform(*LEVELS))] * held
    return levels[:samples]


def synthetic_log(plant: Arguments, samples: int, seed: int, kind: str = "steps") -> Log:
    """Return a log of a plant in the environment; steps and noise are drawn with the seed.

    In the kind "loop", a PI controller follows a moving set point; in all others the flow moves
    in steps. "meter" adds noise to the flow, and "drift" a random walk to the temperature.
    """
    generator = np.random.default_rng(seed)
    levels = steps(generator, samples, 30, 120)
    moving: dict[str, Any] = {"setpoint": "random", "setpoint_amplitude": 5.0}
    arguments = plant | moving if kind == "loop" else plant
    env = gymnasium.make("MiddlePoint-v0", max_episode_steps=samples, **arguments)
    observation, info = env.reset(seed=int(generator.integers(2**31)))
    controller = simc_pi(Parameters(**plant))
    flow, temperature = np.empty(samples), np.empty(samples)
    for k, level in enumerate(levels):
        temperature[k] = info["output"]
        action = controller.act(observation) if kind == "loop" else [level / LEVELS[1]]
        observation, *_, info = env.step(np.array(action, np.float32))
        flow[k] = info["command"]
    if kind == "meter":
        flow += generator.normal(0.0, 0.1, samples)
    if kind == "drift":
        temperature += np.cumsum(generator.normal(0.0, 0.05, samples))
    return Log(flow, temperature, Parameters(**plant).sampling_interval)


def task(plant: Arguments, samples: int, seed: int, kind: str = "steps") -> dict[str, Any]:
    """Identify a plant from a synthetic log.

    Returns
    -------
    dict
        `kind`, the plant, `seconds` of processor time, and `refused`, the reason if the log is
        refused. If it is not, also its `warnings`, the true value, estimate and interval of
        each quantity, by `PARTS`, and the shares explained.
    """
    true = nominal(Parameters(**plant))
    truths = {
        "delay": float(plant["delay"]),
        "dead_zone": float(plant["dead_zone"]),
        "gain": true.gain,
        "time_constant": -true.sampling_interval / float(np.log(np.max(true.poles.real))),
    }
    log = synthetic_log(plant, samples, seed, kind)
    actuator = Knowledge(operating_flow=0.0, u_min=LEVELS[0], u_max=LEVELS[1])
    began = time.process_time()
    try:
        model, refused = identify(log, actuator), ""
    except CannotTellError as error:
        model, refused = None, str(error)
    of_plant = {name: plant[name] for name in sorted(plant) if name not in "abc"}
    result = {"kind": kind, **of_plant, "seconds": time.process_time() - began}
    if model is None:
        return result | {"refused": refused}
    for name, truth in truths.items():
        for part, value in zip(PARTS, (truth, *model.estimates[name]), strict=True):
            result[f"{name}_{part}"] = value
    shares = dict(zip(EXPLAINED, model.held_out, strict=True))
    return {**result, **shares, "refused": "", "warnings": " ".join(model.warnings)}


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


def task_of_loops(number: int, seed: int, samples: int) -> dict[str, Any]:
    """Try the loops that are recommended from a log of a random plant; see `tried`."""
    plant = random_plant(number, seed)
    generator = np.random.default_rng([seed, number, 1])
    u = np.array(steps(generator, samples, 8, 60))
    driven = signal.lfilter([0.0] * (plant["delay"] + 1) + plant["b"], plant["a"], u)
    xi = signal.lfilter([1.0], plant["a"], generator.normal(size=samples))
    noise = generator.uniform(0.01, 0.1) * np.std(driven) * xi / np.std(xi)
    log = Log(u, driven + noise, 1.0)
    return {"kind": RANDOM, **tried(log, nominal(Parameters(**plant)), fault=False)}


def task_of_faults(kind: str, number: int, seed: int) -> dict[str, Any]:
    """Try the loops that are recommended from a log of a faulty valve; see `tried`."""
    log, size, plant = faulty(kind, number, seed)
    of_size = {"fault": size > 0.0, "harmful": size >= HARMFUL[kind]}
    return {"kind": kind, **tried(log, plant, **of_size)}


def tried(
    log: Log, plant: LinearModel, *, fault: bool, harmful: bool = False
) -> dict[str, Any]:
    """Try the loops that are recommended from a log on the true plant.

    Returns
    -------
    dict
        Whether there is a `fault`, and a `harmful` one; `refused`, the reason if no loop is
        recommended, and `peaks`, Ms of each loop, infinite for one that is not stable.
    """
    try:
        model = identify(log)
        found = recommended(model)
        reason = " ".join(model.warnings) or "none is robust"
    except ValueError as error:
        found, reason = [], str(error)
    margins = [Loop(each.controller, plant).margins for each in found]
    return {
        "fault": fault,
        "harmful": harmful,
        "refused": "" if found else reason,
        "peaks": [m.sensitivity if m.stable else math.inf for m in margins],
    }


def table_of_loops(found: list[dict[str, Any]]) -> pd.DataFrame:
    """Return how many logs of each kind are refused, and the Ms of the recommended loops."""
    logs = pd.DataFrame(found)
    kinds = {**dict(groups(logs, "kind")), "all of these": logs}
    rows = []
    for kind, each in kinds.items():
        refused, peaks = each["refused"] != "", np.concatenate(each["peaks"].to_list())
        rows.append({
            "plant or valve": kind,
            "logs": str(len(each)),
            "harmful fault": str(each["harmful"].sum()),
            "of these refused": str((refused & each["harmful"]).sum()),
            "no fault": str((~each["fault"]).sum()),
            "of these refused ": str((refused & ~each["fault"]).sum()),
            "loops": str(len(peaks)),
            "Ms above 2": str(np.sum(peaks > MOST_SENSITIVE)),
            "largest Ms": f"{peaks.max():.2f}" if len(peaks) else "",
        })  # fmt: skip
    return pd.DataFrame(rows)


def execute(options: Options, console: Console) -> str:
    """Run the study and print its tables."""
    out, seed = out_folder(options.out), options.seed
    tasks: dict[str, Callable[[], Any]] = {
        f"{kind} {i}": partial(task, plant, options.samples, seed * 1_000_000 + i, kind)
        for kind in KINDS
        for i, plant in enumerate(synthetic_plants(options.logs, seed, options.samples, kind))
    }
    logs = list(tasks)
    tasks |= {
        f"plant {i}": partial(task_of_loops, i, seed, options.samples)
        for i in range(options.plants or 0)
    }
    tasks |= {
        f"{kind} valve {i}": partial(task_of_faults, kind, i, seed)
        for kind in FAULTS
        for i in range(options.faults or 0)
    }
    results = options.fan_out.run(tasks, "logs", Kept(out / "tasks"))
    found = pd.DataFrame([results.pop(name) for name in logs])
    write_csv(out / "identify_study.csv", found.map(_rounded))
    tables = [table(found)]
    for random in (True, False):
        some = [each for each in results.values() if (each["kind"] == RANDOM) == random]
        tables += [table_of_loops(some)] if some else []
    closing = (
        f"{options.logs} logs a kind of {options.samples} samples, seed {seed}. Those that are "
        "refused are wrong estimates. Processor time of a log: median "
        f"{found['seconds'].median():.1f} s, longest {found['seconds'].max():.1f} s."
    )
    text = [each.to_markdown(index=False, disable_numparse=True) for each in tables]
    write_text(out / "identify_study.md", "\n\n".join([*text, f"{closing}\n"]))
    for each in tables:
        console.print(ScreenTable(each))
    return f"{closing} The tables are in {out}/"


def _rounded(value: Any) -> Any:
    """Return a number rounded to meaningful digits."""
    return float(f"{value:.6g}") if isinstance(value, float) else value


def table(found: pd.DataFrame) -> pd.DataFrame:
    """Return how often estimates are right and intervals cover the truth, by kind of log.

    Dead zones below 2 t/h are not counted. A refused log counts as a wrong estimate, and has
    no interval.
    """
    shown = {
        kind: [
            *(_share(*question, logs) for question in QUESTIONS.values()),
            *(f"{100 * logs[each].median():.0f} %" for each in EXPLAINED),
            str((logs["refused"] != "").sum()),
            str((logs["warnings"].fillna("") != "").sum()),
        ]
        for kind, logs in groups(found, "kind")
    }
    rows = [*QUESTIONS, *EXPLAINED, "refused", "nothing recommended"]
    return pd.DataFrame({"how often": rows, **shown})


def _share(name: str, limit: float | None, found: pd.DataFrame) -> str:
    """Return how often an estimate is right, with a confidence interval."""
    truth, value, low, high = (found[f"{name}_{part}"] for part in PARTS)
    counted = truth.notna() & ((name != "dead_zone") | (truth >= 2.0))
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
