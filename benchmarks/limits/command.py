"""Print bounds as the options say, or test them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
from rich.console import Console

from benchmarks.controllers.roster import ROSTER
from benchmarks.lib.command_line import UsageError, blame, out_folder
from benchmarks.lib.statistics import Estimate, bootstrap
from benchmarks.lib.tables import on_screen
from benchmarks.limits import packaged
from benchmarks.limits.bounds import CACHE, least_possible
from benchmarks.limits.options import Options
from benchmarks.limits.verify import errors, verify
from benchmarks.loop.linear import check_linear
from benchmarks.loop.scenarios import SCENARIOS, scenarios_of
from mptc_gym import PRESETS, Parameters

SAMPLES = 1200  # of an episode of a preset
KINDS = {"preview": "with preview", "news": "without preview", "reference": "reference"}

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
        packaged.write(cache, options.fan_out.open())
        return f"Written to {packaged.PLACE}"
    if options.verify:
        table, beaten = verify(options.runs, cache, options.fan_out.open())
        console.print(on_screen(table))
        if beaten:
            console.print(f"Beaten beyond the interval: {'; '.join(beaten)}.")
            raise SystemExit(1)
        return "No controller beats the bound that applies to it, beyond its interval."
    cases = PRESETS
    if plant.arguments:
        with blame(plant.name):
            check_linear(Parameters(**plant.arguments))
        scenarios = scenarios_of(plant.name, plant.arguments)
        cases = {name: scenario.arguments for name, scenario in scenarios.items()}
    # Those whose plants are drawn take the longest, and begin first.
    first = sorted(cases, key=lambda name: not Parameters(**cases[name]).ranges)
    tasks: dict[str, Callable[[], Any]] = {
        name: partial(
            bounds, name, cases[name], folder=cache, episodes=options.episodes, mpc=options.mpc
        )
        for name in first
    }
    compared = {} if plant.arguments else {f"scenario {name}": name for name in SCENARIOS}
    tasks |= {key: partial(bounds_of_scenario, name, cache) for key, name in compared.items()}
    rows = options.fan_out.open().run(tasks, title="bounds")
    if compared:
        console.print("The scenarios of `python -m benchmarks.compare`, °C:")
        console.print(on_screen(pd.DataFrame([rows[key] for key in compared])))
    console.print(f"{plant.name if plant.arguments else 'The presets'}, mean |e| in °C:")
    console.print(on_screen(pd.DataFrame([rows[name] for name in cases])))
    return NOTE


def bounds_of_scenario(name: str, cache: Path) -> dict[str, str]:
    """Return a row of the table of scenarios."""
    scenario = SCENARIOS[name]
    row = {"scenario": name}
    for kind in ("preview", "reference"):
        least = least_possible(
            kind=kind, samples=scenario.samples, folder=cache, **scenario.arguments
        )
        row[KINDS[kind]] = f"{least.value:.4f}"
    return row


def bounds(
    name: str, arguments: Mapping[str, Any], *, folder: Path, episodes: int, mpc: int | None
) -> dict[str, str]:
    """Return a row of the table of plants, with the error of so many runs of MPC, if any."""
    found = {}
    for kind in KINDS:
        # "news" is for random set points, "reference" for those that are held long enough.
        with suppress(ValueError):
            found[kind] = least_possible(
                kind=kind, samples=SAMPLES, episodes=episodes, folder=folder, **arguments
            )
    of = found["preview"]
    idle = Estimate(of.idle, of.idle_low, of.idle_high, of.runs)
    row = {"plant": name, "valve left alone": f"{idle:.3f}"}
    for kind, title in KINDS.items():
        row[title] = f"{found[kind]:.3f}" if kind in found else ""
    if mpc:
        (predictive,) = ROSTER["mpc"].members()
        row["MPC"] = f"{bootstrap(errors(predictive, mpc, SAMPLES, **arguments), seed=0):.3f}"
    return row
