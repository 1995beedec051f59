"""Where controllers still work on other plants: `python -m benchmarks.sweep --help`."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from datetime import datetime, timezone
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from benchmarks import plants as plant_options
from benchmarks.controllers import options as controller_options
from benchmarks.controllers.factories import Factory, provenances
from benchmarks.controllers.records import Controller
from benchmarks.controllers.roster import ROSTER
from benchmarks.designs import Plant, grid, random_design
from benchmarks.lib import command_line
from benchmarks.lib.fingerprint import fingerprint
from benchmarks.lib.report import provenance_line, write_report
from benchmarks.lib.storage import commit, versions, write_json
from benchmarks.lib.tables import on_screen, write_csv
from benchmarks.sweep.cells import agent_cell, limit_cell
from benchmarks.sweep.report import report, table

SWEPT = [name for name, controller in ROSTER.items() if controller.swept]
SEED = 0  # of a plant's first run
NOTHING = "nothing"  # the controller that sets the scale


def _add_options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "--design",
        choices=("grid", "random"),
        default="grid",
        help="grid: 20 delays by 10 gains; random: plants that differ in everything, half of "
        "which drift",
    )
    count = command_line.number
    add("--plants", type=count, default=200, metavar="N", help="plants of a random design")
    add(
        "--design-seed",
        type=command_line.seed,
        default=0,
        metavar="N",
        help="seed that the plants of a random design are drawn with",
    )
    add("--runs", type=count, default=20, metavar="N", help="runs of a controller on a plant")
    add("--samples", type=count, default=1200, metavar="N", help="samples of 8 s in a run")
    controller_options.add_options(parser, SWEPT, "runs and trainings")
    plant_options.add_options(parser)
    add(
        "--out",
        type=Path,
        default=argparse.SUPPRESS,
        metavar="FOLDER",
        help="folder to write to (default: results/sweep-DESIGN)",
    )


@command_line.command(
    "sweep",
    "Run controllers on plants that they were not made for. The plant that they were made for "
    "is the paper's, or that of --plant, --preset or --set; the others differ from it in what "
    "the design says.",
    _add_options,
    width=150,
    interrupted="what has finished is kept, and the next call goes on.",
)
def main(options: argparse.Namespace, console: Console) -> str:
    """Run the sweep and write what it finds."""
    controllers = controller_options.chosen(options.agents, options.agent)
    nominal = plant_options.chosen(options).arguments
    started = datetime.now(timezone.utc).isoformat(timespec="seconds")
    out = getattr(options, "out", Path(f"results/sweep-{options.design}"))
    out = command_line.out_folder(out)
    training = controller_options.training(options)
    known = {NOTHING: ROSTER[NOTHING], **controllers}
    members = {
        name: controller.members_in_service(training) for name, controller in known.items()
    }
    differing = (
        grid()
        if options.design == "grid"
        else random_design(options.plants, options.design_seed, options.samples)
    )
    plants = [{**nominal, **plant} for plant in differing]
    began = time.perf_counter()
    results = training.fan_out.run(
        _limit_cells(plants, options),
        out / "cells" / _limit_key(plants, options),
        title="limit",
    )
    for name, factories in members.items():
        results |= training.fan_out.run(
            _agent_cells(name, factories, plants, nominal, options),
            # A folder for each, so that one more controller leaves the others' cells valid.
            out / "cells" / _agent_key(known[name], factories, plants, nominal, options),
            title=name,
        )
    seconds = time.perf_counter() - began

    runs = table(plants, list(controllers), results)
    sections = report(runs, out, options.design)
    write_csv(out / "runs.csv", runs)
    origin = {
        "started": started,
        "seconds": round(seconds, 1),
        "options": {name: str(value) for name, value in vars(options).items()},
        "policies": provenances(members),
        "versions": versions(),
        "commit": commit(),
    }
    write_json(out / "provenance.json", origin)
    title = "Controllers on plants that they were not made for"
    write_report(out, title, sections, provenance_line("sweep", origin))
    for section in sections:
        console.print(section.title, *section.text, sep="\n")
        if section.table is not None:
            console.print(on_screen(section.table))
    return f"{len(results)} cells in {seconds:.0f} s. The report, data and maps are in {out}/"


def _limit_cells(
    plants: list[Plant], options: argparse.Namespace
) -> dict[str, Callable[[], Any]]:
    return {
        f"limit {i}": partial(limit_cell, plant, options.samples)
        for i, plant in enumerate(plants)
    }


def _limit_key(plants: list[Plant], options: argparse.Namespace) -> str:
    return fingerprint(limit_cell.__module__, plants=plants, samples=options.samples)


def _agent_cells(
    name: str,
    factories: Sequence[Factory],
    plants: list[Plant],
    nominal: Plant,
    options: argparse.Namespace,
) -> dict[str, Callable[[], Any]]:
    """Return a controller on every plant, by name."""
    common = {"samples": options.samples, "runs": options.runs, "seed": SEED}
    return {
        # Every plant has its own member, in turn: how much they differ shows in the maps.
        f"{name} {i}": partial(
            agent_cell, factories[i % len(factories)], nominal, plant, **common
        )
        for i, plant in enumerate(plants)
    }


def _agent_key(
    controller: Controller,
    factories: Sequence[Factory],
    plants: list[Plant],
    nominal: Plant,
    options: argparse.Namespace,
) -> str:
    """Return a name made of everything that shapes the results of a controller."""
    location = controller.in_service or controller.factory
    modules = [location.partition(":")[0]] if location else []
    return fingerprint(
        agent_cell.__module__,
        *modules,
        options=[options.runs, options.samples],
        plants=plants,
        nominal=nominal,
        controller=location,
        policies=provenances({controller.name: factories}),
    )


if __name__ == "__main__":
    sys.exit(main(None))
