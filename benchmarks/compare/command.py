"""Run a comparison as its options say, and write what it finds."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.console import Console

from benchmarks.compare.comparison import Comparison
from benchmarks.compare.estimates import scale_of
from benchmarks.compare.options import COMPARED, RUNS, Options
from benchmarks.controllers.options import chosen
from benchmarks.controllers.records import Factory
from benchmarks.lib import command_line
from benchmarks.lib.options import flat
from benchmarks.lib.tables import on_screen
from benchmarks.loop.scenarios import PRESET_SCENARIOS, SCENARIOS, Scenario, scenarios_of

OUT = Path("results/compare")
LONGEST = 60  # characters of a folder's name


def execute(options: Options, console: Console) -> str:
    """Run the comparison and write what it finds."""
    controllers = chosen(options.agents, options.controllers.agent)
    plant = options.plant.chosen()
    if options.presets and plant.arguments:
        raise command_line.UsageError("--presets: goes without --plant, --preset and --set")
    scenarios = PRESET_SCENARIOS if options.presets else SCENARIOS
    if plant.arguments:
        scenarios = scenarios_of(plant.name, plant.arguments)
    given = list(scenarios) if options.scenarios is None else options.scenarios
    names = command_line.known("--scenarios", given, list(scenarios))
    if not names:
        raise command_line.UsageError("--scenarios: none to run")
    training = options.controllers.training()
    members = {name: entry.members(training) for name, entry in controllers.items()}
    if plant.arguments:
        _try_out(members, [scenarios[name] for name in names], options.runs)
    out = options.out or _folder(
        [*controllers] if (*controllers,) != COMPARED else [],
        names if names != [*scenarios] else [],
        [plant.name] if plant.arguments else ["presets"] if options.presets else [],
        [f"{options.runs}-runs"] if options.runs != RUNS else [],
    )
    out = command_line.out_folder(out)
    recorded = {**flat(options), "agents": list(controllers)}
    comparison = Comparison([scenarios[name] for name in names], options.runs, out, recorded)
    try:
        for name, entry in controllers.items():
            comparison.run(entry, members[name])
    except BaseException:  # Ctrl-C, too
        comparison.finish(complete=False)
        raise
    report = comparison.finish(complete=True)

    for section in report[:2]:
        console.print(section.title, *section.text, sep="\n")
        if section.table is not None:
            console.print(on_screen(section.table))
    return f"The report, tables, data and plots are in {out}/"


def _try_out(
    members: Mapping[str, list[Factory]], scenarios: Sequence[Scenario], runs: int
) -> None:
    """Refuse a plant that has no score, or that a controller cannot be set up for."""
    for scenario in scenarios:
        with command_line.blame(scenario.title):
            scale_of(scenario, runs).least.score(0.0)
    for name, scenario in itertools.product(members, scenarios):
        with command_line.blame(f"{name} on {scenario.title}"):
            members[name][0](scenario.arguments, 1, 0)


def _folder(*differences: list[str]) -> Path:
    """Return a folder that says what was run, where that is not what is run by default."""
    name = "-".join(part for difference in differences for part in difference)
    if not name:
        return OUT
    name = "".join(c if c.isalnum() or c in "-_." else "-" for c in name)
    if len(name) > LONGEST:
        name = f"{name[:LONGEST]}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"
    return OUT.with_name(f"{OUT.name}-{name}")
