"""Print bounds, or write those of the package."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
from rich.console import Console

from benchmarks.bounds.__main__ import Options
from benchmarks.bounds.least import CACHE, least_possible
from benchmarks.controllers.roster import ROSTER
from benchmarks.lib.command import blame, out_folder
from benchmarks.lib.fan_out import FanOut
from benchmarks.lib.statistics import Estimate, bootstrap
from benchmarks.lib.storage import ROOT, code, commit, versions, write_json
from benchmarks.lib.tables import on_screen
from benchmarks.loop.linear import check_linear
from benchmarks.loop.metrics import mean_error
from benchmarks.loop.plants import PlantOptions
from benchmarks.loop.scenarios import SCENARIOS, Scenario, scenarios_of
from mptc_gym import PRESETS, Parameters
from mptc_gym.evaluation import EPISODES, SAMPLES, SEED

HEADINGS = {"preview": "with preview", "causal": "without preview", "reference": "reference"}
PACKAGE = ROOT / "mptc_gym" / "bounds.json"
MORE = 20  # episodes beyond those of a score, for choosing policies
PACKAGED = PRESETS | {
    f"{name}, random set points": {**PRESETS[name], "setpoint": "random"}
    for name in ("paper", "disturbed", "fouling")  # for the data sets
}

NOTE = (
    "With preview: no controller does better on average, even one that knows the set point "
    "beforehand. Without: none that learns of a change of the set point when it happens; for "
    "random set points alone, which have a law. Reference: the same, if each change finds the "
    "plant settled; a controller that counts samples can come below it. Where a set point "
    "never changes, the three are the same. 95 % intervals over drawn episodes."
)


def execute(options: Options, console: Console) -> str:
    """Print the bounds of the scenarios and of the presets, or of another plant."""
    plant, one = options.plant.chosen(), options.plant != PlantOptions()
    cache = out_folder(options.cache or CACHE, "--cache")
    fan_out = options.fan_out
    if options.package:
        write_package(cache, fan_out)
        return f"Written to {PACKAGE}"
    cases: Mapping[str, Mapping[str, Any]] = PRESETS
    if one:
        with blame(plant.name):
            check_linear(Parameters(**plant.arguments))
        scenarios = scenarios_of(plant.name, plant.arguments)
        cases = {name: scenario.arguments for name, scenario in scenarios.items()}
    episodes = {each: getattr(options, each) for each in ("samples", "episodes", "seed")}
    episodes["folder"] = cache
    # Cases with drawn plants take longest, and start first.
    first = sorted(cases, key=lambda name: not Parameters(**cases[name]).ranges)
    tasks: dict[str, Callable[[], Any]] = {
        name: partial(row, name, cases[name], episodes, options.mpc) for name in first
    }
    compared = [] if one or options.samples != SAMPLES else list(SCENARIOS.values())
    tasks |= {
        f"scenario {each.name}": partial(row_of_scenario, each, cache) for each in compared
    }
    rows = fan_out.run(tasks, title="bounds")
    if compared:
        console.print("The scenarios of `python -m benchmarks.compare`, °C:")
        table = pd.DataFrame([rows[f"scenario {each.name}"] for each in compared])
        console.print(on_screen(table))
    console.print(f"{plant.name if one else 'The presets'}, mean |e| in °C:")
    console.print(on_screen(pd.DataFrame([rows[name] for name in cases])))
    return NOTE


def row_of_scenario(scenario: Scenario, cache: Path) -> dict[str, str]:
    """Return a row of the table of scenarios."""
    case = {"samples": scenario.samples, "folder": cache, **scenario.arguments}
    return {"scenario": scenario.name} | {
        HEADINGS[kind]: f"{least_possible(kind=kind, **case).value:.4f}"
        for kind in ("preview", "reference")
    }


def row(
    name: str, arguments: Mapping[str, Any], episodes: Mapping[str, Any], mpc: int | None
) -> dict[str, str]:
    """Return a row of the table of plants, with the error of `mpc` runs of MPC, if any.

    `episodes` holds their length, number and first seed, and the folder of kept bounds.
    """
    case = {**episodes, **arguments}
    of = least_possible(kind="preview", **case)
    idle = Estimate(of.idle, of.idle_low, of.idle_high, of.runs)
    cells = {"plant": name, "valve left alone": f"{idle:.3f}"}
    for kind, heading in HEADINGS.items():
        cells[heading] = ""
        # "causal" needs random set points, "reference" those that are held long enough.
        with suppress(ValueError):
            cells[heading] = f"{least_possible(kind=kind, **case):.3f}"
    if mpc:
        (predictive,) = ROSTER["mpc"].members()
        runs = predictive.run(arguments, episodes["samples"], mpc, episodes["seed"])
        cells["MPC"] = f"{bootstrap(mean_error(runs), seed=0):.3f}"
    return cells


def write_package(cache: Path, fan_out: FanOut) -> None:
    """Write the least possible error of each case, for every episode where they differ."""
    case: dict[str, Any] = {"samples": SAMPLES, "seed": SEED, "episodes": EPISODES + MORE}
    tasks = {
        name: partial(least_possible, folder=cache, **{**case, **arguments})
        for name, arguments in PACKAGED.items()
    }
    found = dict(fan_out.stream(tasks, title="bounds"))
    cases = {
        name: {"arguments": arguments, "kind": found[name].kind, "least": found[name].episodes}
        for name, arguments in PACKAGED.items()
    }
    about = {
        "command": "python -m benchmarks.bounds --package",
        "commit": commit(),
        "code": code(),
        "versions": versions(),
        "unit": "degC, mean of |e(k)| over k = 1 to samples",
    }
    write_json(PACKAGE, {**about, **case, "cases": cases})
