"""Run a comparison as its options say, and write what it finds."""

from __future__ import annotations

import hashlib
import itertools
import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.console import Console

from benchmarks.compare import report
from benchmarks.compare.comparison import Comparison
from benchmarks.compare.estimates import scale_of
from benchmarks.compare.options import COMPARED, RUNS, Options
from benchmarks.compare.record import Record
from benchmarks.controllers.options import chosen
from benchmarks.controllers.records import Factory, provenances
from benchmarks.lib.command_line import UsageError, blame, known, out_folder
from benchmarks.lib.fan_out import FanOut
from benchmarks.lib.options import flat
from benchmarks.lib.report import Section, show
from benchmarks.lib.storage import origin
from benchmarks.loop.scenarios import PRESET_SCENARIOS, SCENARIOS, Scenario, scenarios_of
from mptc_gym.evaluation import SEED

OUT = Path("results/compare")
LONGEST = 60  # characters of a folder's name
PAUSE = 2.0  # s between two times that the runs so far are written


def execute(options: Options, console: Console) -> str:
    """Run the comparison and write what it finds."""
    controllers = chosen(options.agents, options.controllers.agent)
    plant = options.plant.chosen()
    if options.presets and plant.arguments:
        raise UsageError("--presets: goes without --plant, --preset and --set")
    scenarios = PRESET_SCENARIOS if options.presets else SCENARIOS
    if plant.arguments:
        scenarios = scenarios_of(plant.name, plant.arguments)
    given = list(scenarios) if options.scenarios is None else options.scenarios
    names = known("--scenarios", given, list(scenarios))
    if not names:
        raise UsageError("--scenarios: none to run")
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
    comparison = Comparison({name: scenarios[name] for name in names}, members, options.runs)
    about = {
        "options": {**flat(options), "agents": list(members)},
        "seeds": list(range(SEED, SEED + options.runs)),
        "scenarios": {
            name: {"samples": each.samples, "arguments": each.arguments}
            for name, each in comparison.scenarios.items()
        },
        "policies": provenances(members),
    }
    record = Record(out_folder(out), {**origin(), **about})

    def write(fan_out: FanOut, *, complete: bool) -> list[Section]:
        return report.write(comparison, controllers, record, fan_out, complete=complete)

    try:
        written = -math.inf
        for _ in comparison.run(training.fan_out):
            if time.monotonic() - written >= PAUSE:
                record.write_runs(comparison.runs, complete=False)
                written = time.monotonic()
    except BaseException:  # Ctrl-C, too
        write(FanOut(jobs=1), complete=False)
        raise
    show(write(FanOut(options.controllers.fan_out.jobs), complete=True)[:3], console)
    return f"The report, tables, data and plots are in {out}/"


def _try_out(
    members: Mapping[str, list[Factory]], scenarios: Sequence[Scenario], runs: int
) -> None:
    """Refuse a plant that has no score, or that a controller cannot be set up for."""
    for scenario in scenarios:
        with blame(scenario.title):
            scale_of(scenario, runs).least.score(0.0)
    for name, scenario in itertools.product(members, scenarios):
        with blame(f"{name} on {scenario.title}"):
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
