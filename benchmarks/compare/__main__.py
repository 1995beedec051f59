"""Compare controllers, all of them on the same noise: `python -m benchmarks.compare --help`."""

from __future__ import annotations

import argparse
import hashlib
import itertools
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

from rich.console import Console

from benchmarks import plants
from benchmarks.compare.comparison import Comparison
from benchmarks.controllers import options as controller_options
from benchmarks.controllers.factories import build, load_factory, observation
from benchmarks.controllers.records import Controller
from benchmarks.controllers.roster import ROSTER
from benchmarks.lib import command_line
from benchmarks.lib.tables import on_screen
from benchmarks.scenarios import PRESET_SCENARIOS, SCENARIOS, SETPOINTS, Scenario, scenarios_of
from mptc_gym import Parameters

OUT = Path("results/compare")
COMPARED = [name for name, controller in ROSTER.items() if controller.compared]
RUNS = 100
LONGEST = 60  # characters of a folder's name


def _add_options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    controller_options.add_options(parser, COMPARED, "trainings")
    add(
        "--scenarios",
        nargs="*",
        default=argparse.SUPPRESS,
        metavar="NAME",
        help=f"which cases to run, out of {', '.join(SCENARIOS)}; with --presets the presets, "
        f"on a plant of your own {', '.join(name for name, *_ in SETPOINTS)} (default: all)",
    )
    plants.add_options(parser)
    add(
        "--presets",
        action="store_true",
        help="run all presets of the environment in place of the paper's cases",
    )
    add(
        "--runs",
        type=command_line.number,
        default=RUNS,
        metavar="N",
        help="runs of each controller in each case",
    )
    add(
        "--retrain",
        action="store_true",
        help="train policies of PPO anew, which takes many minutes",
    )
    add(
        "--out",
        type=Path,
        default=argparse.SUPPRESS,
        metavar="FOLDER",
        help=f"folder to write to (default: {OUT}, and a name of its own beside that for a "
        "comparison of other controllers or cases)",
    )


@command_line.command(
    "compare",
    "Run controllers on the same cases in the same noise, and write a report with tables, data "
    "and pictures.",
    _add_options,
    width=190,
)
def main(options: argparse.Namespace, console: Console) -> str:
    """Run the comparison and write what it finds."""
    controllers = controller_options.chosen(options.agents, options.agent)
    options.agents = list(controllers)
    plant = plants.chosen(options)
    if options.presets and plant.arguments:
        raise command_line.UsageError("--presets: goes without --plant, --preset and --set")
    scenarios = PRESET_SCENARIOS if options.presets else SCENARIOS
    if plant.arguments:
        scenarios = scenarios_of(plant.name, plant.arguments)
    names = getattr(options, "scenarios", list(scenarios))
    names = command_line.known("--scenarios", names, list(scenarios))
    if not names:
        raise command_line.UsageError("--scenarios: none to run")
    training = controller_options.training(options, retrain=options.retrain)
    if plant.arguments:
        _try_out(controllers.values(), [scenarios[name] for name in names])
    out = getattr(options, "out", None) or _folder(
        [*controllers] if [*controllers] != COMPARED else [],
        names if names != [*scenarios] else [],
        [plant.name] if plant.arguments else ["presets"] if options.presets else [],
        [f"{options.runs}-runs"] if options.runs != RUNS else [],
    )
    out = command_line.out_folder(out)
    comparison = Comparison([scenarios[name] for name in names], options.runs, out, options)
    try:
        for controller in controllers.values():
            comparison.run(controller, training)
    except BaseException:  # Ctrl-C, too
        comparison.finish(complete=False)
        raise
    report = comparison.finish(complete=True)

    for section in report[:2]:
        console.print(section.title, *section.text, sep="\n")
        if section.table is not None:
            console.print(on_screen(section.table))
    return f"The report, tables, data and plots are in {out}/"


def _try_out(controllers: Iterable[Controller], scenarios: Sequence[Scenario]) -> None:
    """Make each controller once, as not every one can be set up for every plant."""
    for controller, scenario in itertools.product(controllers, scenarios):
        if controller.factory:
            factory = load_factory(controller.factory)
            arguments = {**scenario.arguments, **observation(factory)}
            with command_line.blame(f"{controller.name} on {scenario.title}"):
                build(factory, Parameters(**arguments), num_envs=1, seed=0)


def _folder(*differences: list[str]) -> Path:
    """Return a folder that says what was run, where that is not what is run by default."""
    name = "-".join(part for difference in differences for part in difference)
    if not name:
        return OUT
    name = "".join(c if c.isalnum() or c in "-_." else "-" for c in name)
    if len(name) > LONGEST:
        name = f"{name[:LONGEST]}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"
    return OUT.with_name(f"{OUT.name}-{name}")


if __name__ == "__main__":
    sys.exit(main(None))
