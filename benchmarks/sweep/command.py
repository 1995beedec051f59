"""Run a sweep from its options, and write its results."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any

from rich.console import Console

from benchmarks.controllers.options import chosen
from benchmarks.controllers.records import provenances
from benchmarks.controllers.roster import ROSTER
from benchmarks.lib.command import blame, out_folder
from benchmarks.lib.report import provenance_line, show, write_report
from benchmarks.lib.storage import Kept, origin, write_json
from benchmarks.lib.tables import write_csv
from benchmarks.loop.designs import SPANS, WIDE, around, grid, random_design
from benchmarks.sweep.__main__ import Options
from benchmarks.sweep.report import report, table
from benchmarks.sweep.tasks import agent_task, limit_task
from mptc_gym import Parameters

NOTHING = "nothing"  # the idle controller, which sets the scale


def execute(options: Options, console: Console) -> str:
    """Run the sweep and write its results."""
    controllers = chosen(options.agents, options.controllers.agent)
    nominal = options.plant.chosen().arguments
    if options.design == "grid":
        differing = grid()
    else:
        spans = SPANS if options.design == "random" else WIDE
        differing = random_design(options.plants, options.design_seed, options.samples, spans)
    with blame("--plant, --preset, --set"):
        differing = around(nominal, differing)
    plants = [{**nominal, **plant} for plant in differing]
    for plant in plants:
        with blame(f"--design {options.design}"):
            Parameters(**plant)
    told = plants if options.told == "each" else [nominal] * len(plants)
    made = origin()
    out = out_folder(options.out or Path(f"results/sweep-{options.design}"))
    known = {NOTHING: ROSTER[NOTHING], **controllers}
    members = {name: entry.members() for name, entry in known.items()}
    began = time.perf_counter()

    tasks: dict[str, Callable[[], Any]] = {
        f"plant {i}": partial(limit_task, plant, options.samples)
        for i, plant in enumerate(plants)
    }
    for name, factories in members.items():
        # The plants take the members in turn, so that the maps show how much they differ.
        for i, given in enumerate(zip(cycle(factories), told, plants, strict=False)):
            tasks[f"plant {i}, {name}"] = partial(
                agent_task, *given, options.samples, options.runs
            )
    found = options.controllers.fan_out.run(tasks, "sweep", Kept(out / "tasks"))
    limits = [found[f"plant {i}"] for i in range(len(plants))]
    results = {
        name: [found[f"plant {i}, {name}"] for i in range(len(plants))] for name in members
    }
    seconds = time.perf_counter() - began

    runs = table(differing, list(controllers), limits, results)
    sections = report(runs, out, options.design, options.told)
    write_csv(out / "runs.csv", runs)
    about = {"seconds": round(seconds, 1), "options": asdict(options)}
    write_json(out / "provenance.json", {**made, **about, "policies": provenances(members)})
    knowing = "are told" if options.told == "each" else "were not made for"
    title = f"Controllers on plants that they {knowing}"
    write_report(out, title, sections, provenance_line("sweep", made))
    show(sections, console)
    return f"{len(tasks)} tasks in {seconds:.0f} s. The report, data and maps are in {out}/"
