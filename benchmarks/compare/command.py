"""Compare controllers as the options say, and write the results."""

from __future__ import annotations

import hashlib
import itertools
import re
import time
from collections.abc import Collection, Mapping
from dataclasses import asdict
from pathlib import Path

from rich.console import Console

from benchmarks.compare import report
from benchmarks.compare.__main__ import COMPARED, RUNS, Options
from benchmarks.compare.comparison import Comparison
from benchmarks.compare.estimates import scale_of
from benchmarks.controllers.options import chosen
from benchmarks.controllers.records import Factory, provenances
from benchmarks.lib.command import UsageError, blame, known, out_folder
from benchmarks.lib.report import Section, provenance_line, show
from benchmarks.lib.storage import origin, write_json
from benchmarks.loop.plants import PlantOptions
from benchmarks.loop.scenarios import PRESET_SCENARIOS, SCENARIOS, Scenario, scenarios_of
from mptc_gym.evaluation import SEED


def execute(options: Options, console: Console) -> str:
    """Run the comparison and write its results."""
    controllers = chosen(options.agents, options.controllers.agent)
    plant, another = options.plant.chosen(), options.plant != PlantOptions()
    if options.presets and another:
        raise UsageError("--presets: goes without --plant, --preset and --set")
    known_cases = PRESET_SCENARIOS if options.presets else SCENARIOS
    if another:
        known_cases = scenarios_of(plant.name, plant.arguments)
    given = list(known_cases) if options.scenarios is None else options.scenarios
    names = known("--scenarios", given, list(known_cases))
    if not names:
        raise UsageError("--scenarios: none to run")
    scenarios = {name: known_cases[name] for name in names}
    members = {name: entry.members() for name, entry in controllers.items()}
    if another:
        _try_out(members, scenarios.values(), options.runs)
    out = options.out or _folder(
        [*controllers] if (*controllers,) != COMPARED else [],
        names if names != [*known_cases] else [],
        [plant.name] if another else ["presets"] if options.presets else [],
        [f"{options.runs}-runs"] if options.runs != RUNS else [],
    )
    folder, made = out_folder(out), origin()
    about = {
        "options": {**asdict(options), "agents": list(members)},
        "seeds": list(range(SEED, SEED + options.runs)),
        "scenarios": {
            name: {"samples": each.samples, "arguments": each.arguments}
            for name, each in scenarios.items()
        },
        "policies": provenances(members),
    }
    comparison = Comparison(scenarios, members, options.runs)
    began = time.perf_counter()

    def save(*, complete: bool = False) -> None:
        report.write_numbers(folder / "runs.csv", comparison.runs)
        seconds = round(time.perf_counter() - began, 1)
        state = {"complete": complete, "seconds": seconds}
        write_json(folder / "provenance.json", {**state, **made, **about})

    def write(jobs: int | None = 1) -> list[Section]:
        save()
        return report.write(comparison, folder, provenance_line("compare", made), jobs)

    try:
        comparison.run(options.controllers.fan_out)
    except BaseException:  # including Ctrl-C
        if comparison.cases:
            write()
        raise
    sections = write(options.controllers.fan_out.jobs)
    save(complete=True)
    show(sections[:2], console)
    return f"The report, tables, data and plots are in {out}/"


def _try_out(
    members: Mapping[str, list[Factory]], scenarios: Collection[Scenario], runs: int
) -> None:
    """Reject a plant that has no score, or that a controller cannot be set up for."""
    for scenario in scenarios:
        with blame(scenario.title):
            scale_of(scenario, runs).least.score(0.0)
    for (name, (first, *_)), scenario in itertools.product(members.items(), scenarios):
        with blame(f"{name} on {scenario.title}"):
            first(scenario.arguments, 1, 0)


def _folder(*differences: list[str]) -> Path:
    """Return a folder named after the differences from the default comparison."""
    name = re.sub(r"[^\w.-]", "-", "-".join(["compare", *itertools.chain(*differences)]))
    if len(name) > 70:
        name = f"{name[:60]}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"
    return Path("results", name)
