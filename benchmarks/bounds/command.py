"""Print bounds, or write those of the package."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from typing import Any

from rich.console import Console

from benchmarks.bounds.__main__ import Options
from benchmarks.bounds.least import CACHE, least_possible
from benchmarks.controllers.roster import ROSTER
from benchmarks.lib.command import out_folder
from benchmarks.lib.fan_out import FanOut
from benchmarks.lib.statistics import Estimate, bootstrap
from benchmarks.lib.storage import ROOT, commit, versions, write_json
from benchmarks.loop.metrics import mean_error
from benchmarks.loop.plants import PlantOptions
from benchmarks.loop.scenarios import PRESET_SCENARIOS, SCENARIOS, Scenario, scenarios_of
from mptc_gym import PRESETS
from mptc_gym.evaluation import EPISODES, SAMPLES, SEED

HEADINGS = {"preview": "with preview", "causal": "without preview", "reference": "reference"}
PACKAGE = ROOT / "mptc_gym" / "bounds.json"
MORE = 20  # episodes beyond those of a score, for choosing policies
PACKAGED = PRESETS | {
    f"{name}, random set points": {**PRESETS[name], "setpoint": "random"}
    for name in ("paper", "disturbed", "fouling")  # for the data sets
}

NOTE = (
    "\nWith preview: no controller does better on average, even one that knows the set point "
    "beforehand. Without: none that learns of a change of the set point when it happens; for "
    "random set points alone, which have a law. Reference: the same, if each change finds the "
    "plant settled; a controller that counts samples can come below it. Where a set point "
    "never changes, the three are the same. 95 % intervals over drawn episodes."
)


def execute(options: Options, console: Console) -> str:
    """Print the bounds of the scenarios and of the presets, or of another plant."""
    plant, one = options.plant.chosen(), options.plant != PlantOptions()
    cache = out_folder(options.cache or CACHE, "--cache")
    if options.package:
        write_package({"folder": cache}, options.fan_out)
        return f"Written to {PACKAGE}"
    cases = {**SCENARIOS, **PRESET_SCENARIOS}
    if one:
        cases = scenarios_of(plant.name, plant.arguments)
    drawn = {"episodes": options.episodes, "seed": options.seed, "folder": cache}
    tasks: dict[str, Callable[[], list[str]]] = {
        name: partial(row, case, options.samples, drawn, options.mpc)
        for name, case in cases.items()
    }

    def show(name: str, cells: list[str]) -> None:
        line = f"{name:20}" + "".join(f"{cell:>26}" for cell in cells)
        console.print(line.rstrip(), soft_wrap=True)

    console.print(f"Mean |e| in °C, {plant.name}:" if one else "Mean |e| in °C:")
    show("", ["valve left alone", *HEADINGS.values(), *["MPC"] * bool(options.mpc)])
    for name, cells in options.fan_out.stream(tasks):
        show(name, cells)
    return NOTE


def row(
    case: Scenario, samples: int | None, drawn: Mapping[str, Any], mpc: int | None
) -> list[str]:
    """Return the bounds of a case, and the error of `mpc` runs of MPC, if any.

    `drawn` holds the number and first seed of the episodes, and the folder of kept bounds.
    """
    samples = samples or case.samples
    ask = {"samples": samples, **drawn, **case.arguments}
    of = least_possible(kind="preview", **ask)
    cells = [f"{Estimate(of.idle, of.idle_low, of.idle_high, of.runs):.4f}"]
    for kind in HEADINGS:
        cells.append("")
        # "causal" needs random set points, "reference" those that are held long enough.
        with suppress(ValueError):
            cells[-1] = f"{least_possible(kind=kind, **ask):.4f}"
    if mpc:
        (predictive,) = ROSTER["mpc"].members()
        runs = predictive.run(case.arguments, samples, mpc, drawn["seed"])
        cells.append(f"{bootstrap(mean_error(runs), seed=0):.4f}")
    return cells


def write_package(kept: Mapping[str, Any], fan_out: FanOut) -> None:
    """Write the least possible error of each case, for every episode where they differ."""
    case: dict[str, Any] = {"samples": SAMPLES, "seed": SEED, "episodes": EPISODES + MORE}
    tasks = {
        name: partial(least_possible, **kept, **{**case, **arguments})
        for name, arguments in PACKAGED.items()
    }
    found = fan_out.run(tasks, "bounds")
    cases = {
        name: {"arguments": arguments, "kind": found[name].kind, "least": found[name].episodes}
        for name, arguments in PACKAGED.items()
    }
    about = {
        "command": "python -m benchmarks.bounds --package",
        "commit": commit(),
        "versions": versions(),
        "unit": "degC, mean of |e(k)| over k = 1 to samples",
    }
    write_json(PACKAGE, {**about, **case, "cases": cases})
