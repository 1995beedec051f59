"""Search a controller's gains with Optuna: `python -m benchmarks.tune nn`, `pi` or `ppo`.

All are judged on the same set points and seeds, which no comparison uses. NN and PI have the
same number of trials; PPO has fewer, as each is a training. The search is saved after every
trial; the same command continues it, to the same end.
"""

from __future__ import annotations

import argparse
import sys

import optuna
from rich.console import Console

from benchmarks import plants
from benchmarks.controllers.roster import ROSTER
from benchmarks.lib import command_line
from benchmarks.lib.tables import on_screen
from benchmarks.tune.search import FINAL_RUNS, RUNS, Search, tuning_of

TUNED = [name for name, controller in ROSTER.items() if controller.tuning]


def _add_options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("controller", choices=TUNED, help="whose gains to search")
    trials = ", ".join(f"{tuning_of(ROSTER[name]).trials} for {name}" for name in TUNED)
    add(
        "--trials",
        type=command_line.number,
        default=argparse.SUPPRESS,
        metavar="N",
        help=f"how many sets of gains to try (default: {trials})",
    )
    add(
        "--runs",
        type=command_line.number,
        default=RUNS,
        metavar="N",
        help="runs of each case in a trial",
    )
    plants.add_options(parser)
    command_line.add_out(parser, "results/tune")
    command_line.add_fan_out(parser, "runs and trainings")


@command_line.command(
    "tune", __doc__, _add_options, interrupted="the same command goes on from here."
)
def main(options: argparse.Namespace, console: Console) -> str:
    """Search, and write and print what was found."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    controller = ROSTER[options.controller]
    tuning = tuning_of(controller)
    trials = getattr(options, "trials", tuning.trials)
    fan_out = command_line.fan_out(options)
    plant = plants.chosen(options)
    command_line.out_folder(options.out)
    with command_line.blame("--out"):
        search = Search(controller, options.runs, options.out, fan_out, plant.arguments)
    search.run(trials)
    report = search.report(trials)
    console.print(f"The best, on {FINAL_RUNS} new runs")
    shown = report[[*tuning.space, "objective"]].head(5)
    console.print(on_screen(shown.map("{:.4g}".format)))
    return f"All trials are in {search.path}, the best in {search.path.with_suffix('.md')}"


if __name__ == "__main__":
    sys.exit(main(None))
