"""Try identification on a simulator of its own: `python -m benchmarks.identify.study [SEED]`.

About half of the logs are of plants with a fault. Recommended loops are tried on true plants.
"""

import math
import sys
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace as Plant
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.identify.__main__ import Options
from benchmarks.identify.advice import controllers
from benchmarks.identify.log import Log
from benchmarks.identify.model import identify
from benchmarks.lib.provenance import ROOT
from benchmarks.lib.storage import write_text

FINE = 5  # steps of the simulator in a sample
# Where a valve of size a goes from p when it is told u; t is the log's progress from -1 to 1.
MOVES: dict[str, Any] = {
    "backlash": lambda a, p, u, _: np.minimum(np.maximum(p, u - a), u + a),
    "stiction": lambda a, p, u, _: np.where(abs(u - p) > a, u, p),
    "stiction with a slip": lambda a, p, u, _: np.where(
        abs(u - p) > a, u - np.copysign(a / 2, u - p), p
    ),
    "saturation": lambda a, p, u, _: np.minimum(np.maximum(u, -0.3 - a), 0.3 + a),
    "subtractive dead zone": lambda a, p, u, _: np.copysign(np.maximum(abs(u) - a, 0), u),
    "few positions": lambda a, p, u, _: a * np.round(u / a),
    "gain by level": lambda a, p, u, _: u + a * u * u,
    "gain by time": lambda a, p, u, t: u * (1 + a * t),
}
FAULTS = *MOVES, "rate limit", "delay that varies", "two levels, saturation"
# Moves of the set point, as shares of the gain: where a valve sticks after one is chance.
LEVELS = np.r_[0.5, np.random.default_rng(0).uniform(-0.6, 0.6, 40)]


def simulate(plant: Plant, held: Any, noise: Any, kp: float = 0.0, ti: float = 1.0) -> Any:
    """Return flows and temperatures of `held` flows, or set points of a PI, in columns."""
    a, h, time, kind = plant.size, plant.h, plant.delay + sum(plant.lags), plant.fault
    move = MOVES.get(kind.removeprefix("two levels, "), lambda a, p, u, _: u)
    shares = [1 - math.exp(-h / FINE / lag) for lag in plant.lags]
    pipe = np.zeros((int(1.5 * plant.delay / h * FINE) + 3, *held.shape[1:]))
    p = y = total = 0.0 * held[0]
    x = [p for _ in shares]
    most = h / FINE / time / (4 * a) if kind == "rate limit" else 9.0
    flows, temperatures = held.copy(), np.empty(held.shape)
    for k in range(len(noise)):
        temperatures[k] = y + noise[k]
        if kp:
            error = held[k] - temperatures[k]
            u = kp * (error + total + error * h / ti)
            flows[k] = np.minimum(np.maximum(u, -1.0), 1.0)
            total = total + (abs(u) < 1) * error * h / ti
        to = move(a, p, flows[k] * (abs(flows[k]) >= plant.zone), 2 * k / len(noise) - 1)
        delay = plant.delay * (1 + a * math.sin(k * h / time) * (kind == "delay that varies"))
        for i in range(k * FINE, (k + 1) * FINE):
            p = p + np.minimum(np.maximum(to - p, -most), most)
            pipe[i % len(pipe)], at = p, i - delay / h * FINE
            early, late = (pipe[(math.floor(at) + j) % len(pipe)] for j in (0, 1))
            value, before = plant.gain * (early + at % 1 * (late - early)), x[-1]
            for j, share in enumerate(shares):
                value = x[j] = x[j] + share * (value - x[j])
            y = value + plant.lead * (value - before) / h * FINE
    return flows, temperatures


def sensitivity(plant: Plant, kp: float, ti: float, stretch: float = 1.0) -> float:
    """Return the true Ms, with the largest gain of a plant whose gain changes."""
    w = np.geomspace(1e-4 / (plant.delay + plant.lags[0]), math.pi / plant.h, 4000)
    s, z = 1j * w, np.exp(1j * w * plant.h)
    most = 1 + plant.size * {"gain by level": 2, "gain by time": 1}.get(plant.fault, 0)
    upper = most * plant.gain * np.exp(-s * (stretch * plant.delay + plant.h / 2))
    lower = np.prod([1 + s * lag for lag in plant.lags], axis=0) / (1 + plant.lead * s)
    near = 1 + kp * (1 + plant.h / ti * z / (z - 1)) * upper / lower
    turns = np.unwrap(np.angle(near))
    return math.inf if abs(turns[-1] - turns[0] - 1.6) > 1 else float(1 / np.abs(near).min())


def tried(seed: int, fault: str) -> dict[str, Any]:
    """Identify a log of a random plant, and try the recommended loop on the plant."""
    generator = np.random.default_rng(seed)
    r, lag = generator.uniform, math.exp(generator.uniform(3.0, 7.3))
    lags = [lag, lag * r(0.1, 0.8), lag * r(0.03, 0.2)][: int(r(1, 4))]
    delay, gain = lag * math.exp(r(-2.3, 1.1)), r(0.3, 6.0) * (-1) ** int(r(0, 2))
    time, zone = delay + sum(lags), r(0.08, 0.45) * (r() < 0.5) * (fault == "none")
    h, lead = float(f"{time / math.exp(r(2.7, 4.6)):.2g}"), -r(0.1, 0.4) * lag * (r() < 0.2)
    shape = {"gain": gain, "delay": delay, "lags": lags, "lead": lead * (len(lags) > 1)}
    plant = Plant(fault=fault, size=r(0.05, 0.5), zone=zone, h=h, **shape)
    # Steps, walks or a loop whose set point moves; noise with a base line that walks.
    kind, rows = int(r(0, 3)), int(min(4000, r(25, 60) * time / h))
    lengths = r(0.2 + kind / 2, 2.0 + kind, rows) * time / h
    held = np.repeat(r(-1, 1, rows), lengths.astype(int) + 1)[:rows]
    white = generator.normal(size=(2, rows)) * abs(gain) * math.exp(r(-5.7, -3.2))
    noise = np.convolve(white[0], 0.8 ** np.arange(15))[:rows]
    noise += np.cumsum(white[1]) * r(0, 0.2) * math.sqrt(h / time)
    half = sum(lags[1:2]) / 2  # SIMC's half rule, for the true plant
    late = delay + h / 2 + half + sum(lags[2:]) - plant.lead
    simc = (lag + half) / gain / 2 / late, min(lag + half, 8 * late)
    if fault.startswith("two levels"):
        held, kind = np.sign(held), 0
    scale, kp = (0.7 * gain, 0.6 * simc[0]) if kind == 2 else (1.0, 0.0)
    flow, temperature = simulate(plant, scale * held, noise, kp, simc[1])
    found: dict[str, Any] = {"fault": fault, "logs": 1, "recommended": 0, "unsafe": 0}
    with suppress(ValueError):  # refused
        model = identify(Log(flow, temperature, h, given=Options(Path(), operating_flow=0.0)))
        truths = {"delay": delay / h, "gain": gain, "dead_zone": zone}
        for name, true in truths.items() if fault == "none" else ():
            _, low, high = model.estimates[name]
            found[name] = 100.0 * (low - 1e-9 <= true <= high + 1e-9)
        for each in controllers(model)["recommended"]:
            typed = each["kp"], each["ti"]
            off = max(sensitivity(plant, *typed, stretch) for stretch in (0.8, 1.2))
            found |= {"Ms": sensitivity(plant, *typed), "Ms, delay a fifth off": off}
            # What loops swing long after a move, by what is recommended and by the rule.
            moved = gain * np.outer(np.sign(np.arange(rows) - rows / 2), LEVELS)
            ran = [simulate(plant, moved, 0 * noise, *x)[1] for x in (typed, simc)]
            own, rule = (np.ptp(y[-rows // 8 :], 0) / abs(gain) for y in ran)
            more = own.mean() > 1.1 * rule.mean() + 0.02
            found |= {"recommended": 1, "unsafe": int(found["Ms"] > 2 or more)}
            found["by one move"] = int(found["Ms"] > 2 or own[0] > 1.1 * rule[0] + 0.02)
    return found


def main(seed: int, rounds: int = 10) -> None:
    """Print the table, and write it where the page takes its numbers from."""
    faults = (["none"] * 10 + [*FAULTS]) * rounds
    found = pd.DataFrame([tried(seed + i, fault) for i, fault in enumerate(faults)])
    rows = pd.concat([found, found[found["fault"] != "none"].assign(fault="all faults")])
    how = dict.fromkeys(["logs", "recommended", "unsafe", "by one move"], "sum")
    how |= dict.fromkeys(["delay", "gain", "dead_zone"], "mean")
    how |= dict.fromkeys(["Ms", "Ms, delay a fifth off"], "max")
    table = rows.groupby("fault", sort=False).agg(how).to_markdown(floatfmt=".4g")
    print(text := f"{table.replace('nan', '   ')}\n")
    write_text(ROOT / "benchmarks/published/identify.md", text)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 200_000)
