"""Print bounds as the options say, or test them."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import pandas as pd
from rich.console import Console
from tqdm import tqdm

from benchmarks.controllers.roster import ROSTER
from benchmarks.lib.command_line import UsageError, blame, out_folder
from benchmarks.lib.statistics import bootstrap
from benchmarks.lib.tables import on_screen
from benchmarks.limits import packaged
from benchmarks.limits.bounds import CACHE, LeastPossible, least_possible
from benchmarks.limits.options import Options
from benchmarks.limits.verify import errors, verify
from benchmarks.loop.linear import check_linear
from benchmarks.loop.scenarios import SCENARIOS, scenarios_of
from mptc_gym import PRESETS, Parameters

SAMPLES = 1200  # of an episode of a preset

NOTE = (
    "With preview: no controller does better on average, even one that knows the set point "
    "beforehand. Without: none to which a change of the set point is news; for random set "
    "points alone, which have a law. Reference: without preview, if each change finds the "
    "plant settled; a controller that counts samples can come below it. Where a set point "
    "never changes, the three are the same. 95 % intervals over drawn episodes."
)


def execute(options: Options, console: Console) -> str:
    """Print the bounds of the scenarios and of the presets, or test them.

    With `--verify` the exit status is 1 if a controller beats a bound beyond its interval.
    """
    plant = options.plant.chosen()
    if options.verify and (plant.arguments or options.mpc):
        raise UsageError("--verify: goes without --mpc, --plant, --preset and --set")
    cache = out_folder(options.cache or CACHE, "--cache")
    if options.package:
        packaged.write(cache)
        return f"Written to {packaged.PLACE}"
    if options.verify:
        table, beaten = verify(options.runs, cache, options.fan_out.open())
        console.print(on_screen(table))
        if beaten:
            console.print(f"Beaten beyond the interval: {'; '.join(beaten)}.")
            raise SystemExit(1)
        return "No controller beats the bound that applies to it, beyond its interval."
    if plant.arguments:
        with blame(plant.name):
            check_linear(Parameters(**plant.arguments))
        cases = scenarios_of(plant.name, plant.arguments)
        console.print(f"{plant.name}, mean |e| in °C:")
        console.print(on_screen(bounds({n: c.arguments for n, c in cases.items()}, options)))
        return NOTE
    console.print("The scenarios of `python -m benchmarks.compare`, °C:")
    console.print(on_screen(scenarios(cache)))
    console.print("The presets, mean |e| in °C:")
    console.print(on_screen(bounds(PRESETS, options)))
    return NOTE


def scenarios(cache: Path) -> pd.DataFrame:
    """Return the table of the scenarios."""
    rows = []
    for name, scenario in tqdm(SCENARIOS.items(), unit="scenario"):
        case = {"samples": scenario.samples, "folder": cache, **scenario.arguments}
        row = {"scenario": name}
        for kind, title in (("preview", "with preview"), ("reference", "reference")):
            row[title] = f"{least_possible(kind=kind, **case).value:.4f}"
        rows.append(row)
    return pd.DataFrame(rows)


def bounds(cases: Mapping[str, Mapping[str, Any]], options: Options) -> pd.DataFrame:
    """Return the table of plants by name, with MPC's errors if `--mpc` asks for them."""
    rows = []
    for name, arguments in tqdm(cases.items(), unit="plant"):
        case: dict[str, Any] = {"samples": SAMPLES, "episodes": options.episodes}
        case["folder"] = options.cache or CACHE
        found = {"preview": least_possible(kind="preview", **case, **arguments)}
        for kind in ("news", "reference"):
            # "news" is for random set points, "reference" for those that are held long enough.
            with suppress(ValueError):
                found[kind] = least_possible(kind=kind, **case, **arguments)
        idle = found["preview"]
        row = {
            "plant": name,
            "valve left alone": _cell(idle.idle, idle.idle_low, idle.idle_high),
            "with preview": _shown(found["preview"]),
            "without preview": _shown(found["news"]) if "news" in found else "",
            "reference": _shown(found["reference"]) if "reference" in found else "",
        }
        if options.mpc:
            (mpc,) = ROSTER["mpc"].members()
            error = bootstrap(errors(mpc, options.mpc, SAMPLES, **arguments), 0)
            row["MPC"] = _cell(error.value, error.low, error.high)
        rows.append(row)
    return pd.DataFrame(rows)


def _shown(least: LeastPossible) -> str:
    return _cell(least.value, least.low, least.high)


def _cell(value: float, low: float, high: float) -> str:
    if f"{low:.3f}" == f"{high:.3f}":
        return f"{value:.3f}"
    return f"{value:.3f} ({low:.3f} to {high:.3f})"
