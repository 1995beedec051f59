"""Try identification on a simulator of its own: `python -m benchmarks.identify.study [SEED]`.

Half of the logs are of plants with a fault. What is recommended is tried on the true plants.
"""

from __future__ import annotations

import math
import sys
from types import SimpleNamespace as Plant
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.identify.advice import recommended
from benchmarks.identify.log import Log
from benchmarks.identify.model import identify
from benchmarks.identify.options import Knowledge
from benchmarks.lib.storage import ROOT, write_text

FINE = 5  # steps of the simulator in a sample
LOGS = {
    "none": 60, "backlash": 6, "stiction": 6, "stiction with a slip": 6, "saturation": 6,
    "rate limit": 6, "subtractive dead zone": 6, "few positions": 6, "gain by level": 6,
    "gain by time": 6, "delay that varies": 6, "two levels, saturation": 6,
}  # fmt: skip


def simulate(plant: Plant, held: Any, noise: Any, kp: float = 0.0, ti: float = 1.0) -> Any:
    """Return flows and temperatures; `held` are flows, or set points of a PI controller."""
    fault, a, h, time = plant.fault, plant.size, plant.h, plant.delay + sum(plant.lags)
    shares, x = [1 - math.exp(-h / FINE / lag) for lag in plant.lags], [0.0] * len(plant.lags)
    pipe, p, y = [0.0] * (int(1.5 * plant.delay / h * FINE) + 3), 0.0, 0.0
    most = h / FINE / time / (4 * a) if fault == "rate limit" else 9.0
    flows, temperatures, total = held.copy(), np.empty(len(noise)), 0.0
    for k in range(len(noise)):
        temperatures[k] = y + noise[k]
        if kp:
            error = held[k] - temperatures[k]
            u = kp * (error + total + error * h / ti)
            total += (abs(u) < 1) * error * h / ti
            flows[k] = min(max(u, -1.0), 1.0)
        u = flows[k]
        to = {
            "backlash": min(max(p, u - a), u + a),
            "stiction": u if abs(u - p) > a else p,
            "stiction with a slip": u - math.copysign(a / 2, u - p) if abs(u - p) > a else p,
            "saturation": min(max(u, -0.3 - a), 0.3 + a),
            "subtractive dead zone": math.copysign(max(abs(u) - a, 0), u),
            "few positions": a * round(u / a),
            "gain by level": u + a * u * u,
            "gain by time": u * (1 + a * (2 * k / len(noise) - 1)),
        }.get(fault.removeprefix("two levels, "), u if abs(u) >= plant.zone else 0.0)
        wave = 1 + a * math.sin(k * h / time) * (fault == "delay that varies")
        for i in range(k * FINE, (k + 1) * FINE):
            p += min(max(to - p, -most), most)
            pipe[i % len(pipe)] = p
            at = i - plant.delay * wave / h * FINE
            early, late = (pipe[(math.floor(at) + j) % len(pipe)] for j in (0, 1))
            value, before = plant.gain * (early + at % 1 * (late - early)), x[-1]
            for j, share in enumerate(shares):
                value = x[j] = x[j] + share * (value - x[j])
            y = value + plant.lead * (value - before) / h * FINE
    return flows, temperatures


def sensitivity(plant: Plant, kp: float, ti: float, stretch: float) -> float:
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
    plant = Plant(
        fault=fault, size=r(0.05, 0.5), zone=zone, h=h, gain=gain, delay=delay, lags=lags,
        lead=lead * (len(lags) > 1),
    )  # fmt: skip
    # Steps, walks or a loop whose set point moves; noise with a base line that walks.
    kind, rows = int(r(0, 3)), int(min(4000, r(25, 60) * time / h))
    lengths = r(0.2 + kind / 2, 2.0 + kind, rows) * time / h
    held = np.repeat(r(-1, 1, rows), lengths.astype(int) + 1)[:rows]
    held = np.sign(held) if fault.startswith("two levels") else held
    white = generator.normal(size=(2, rows)) * abs(gain) * math.exp(r(-5.7, -3.2))
    noise = np.convolve(white[0], 0.8 ** np.arange(15))[:rows]
    noise += np.cumsum(white[1]) * r(0, 0.2) * math.sqrt(h / time)
    half = sum(lags[1:2]) / 2
    late = delay + h / 2 + half + sum(lags[2:]) - plant.lead
    simc = (lag + half) / gain / 2 / late, min(lag + half, 8 * late)
    if kind == 2 and not fault.startswith("two levels"):
        flow, temperature = simulate(plant, 0.7 * gain * held, noise, 0.6 * simc[0], simc[1])
    else:
        flow, temperature = simulate(plant, held, noise)
    found: dict[str, Any] = {"fault": fault, "logs": 1, "recommended": 0, "unsafe": 0}
    try:
        model = identify(Log(flow, temperature, h), Knowledge(operating_flow=0.0))
    except ValueError:  # refused
        return found
    for name, true in {"delay": delay / h, "gain": gain, "dead_zone": zone}.items():
        _, low, high = model.estimates[name]
        found[name] = 100.0 * (low - 1e-9 <= true <= high + 1e-9)
    for each in recommended(model):
        found["Ms"] = sensitivity(plant, each["kp"], each["ti"], 1.0)
        off = [sensitivity(plant, each["kp"], each["ti"], stretch) for stretch in (0.8, 1.2)]
        found |= {"Ms, delay a fifth off": max(off), "recommended": 1}
        moved = 0.5 * gain * np.sign(np.arange(rows) - rows / 2)
        cycles = [
            float(np.ptp(simulate(plant, moved, 0 * noise, *typed)[1][-rows // 8 :]))
            for typed in ((each["kp"], each["ti"]), simc)
        ]
        found["unsafe"] = found["Ms"] > 2 or cycles[0] > 1.1 * cycles[1] + 0.02 * abs(gain)
    return found


def main(seed: int) -> None:
    """Print the table, and write it where the page takes its numbers from."""
    faults = [fault for fault, count in LOGS.items() for _ in range(count)]
    found = pd.DataFrame([tried(seed + i, fault) for i, fault in enumerate(faults)])
    found.loc[found["fault"] != "none", ["delay", "gain", "dead_zone"]] = np.nan
    rows = pd.concat([found, found[found["fault"] != "none"].assign(fault="all faults")])
    how: dict[str, Any] = dict.fromkeys(found.columns[1:], "sum")
    how |= dict.fromkeys(["delay", "gain", "dead_zone"], "mean")
    how |= {name: "max" for name in how if "Ms" in name}
    text = (
        rows.groupby("fault", sort=False)
        .agg(how)
        .to_markdown(floatfmt=".4g")
        .replace("nan", "   ")
    )
    print(text)
    write_text(ROOT / "benchmarks/published/identify.md", f"{text}\n")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 50_000)
