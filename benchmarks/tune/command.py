"""Run a search for gains from its options, and print the best."""

from __future__ import annotations

import optuna
from rich.console import Console

from benchmarks.controllers.roster import ROSTER
from benchmarks.lib.command_line import out_folder
from benchmarks.lib.tables import on_screen
from benchmarks.tune.options import Options
from benchmarks.tune.search import FINAL_RUNS, Search


def execute(options: Options, console: Console) -> str:
    """Run the search, and write and print its results."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    fan_out, plant = options.fan_out.open(), options.plant.chosen().arguments
    out = out_folder(options.out)
    search = Search(ROSTER[options.controller], options.runs, plant, out, fan_out)
    report = search.report(search.run(options.trials or search.tuning.trials))
    console.print(f"The best, on {FINAL_RUNS} new runs")
    shown = report[[*search.tuning.space, "objective"]].head(5)
    console.print(on_screen(shown.map("{:.4g}".format)))
    return f"All trials are in {search.path}, the best in {search.path.with_suffix('.md')}"
