"""Search gains as the options say, and print the best."""

from __future__ import annotations

import optuna
from rich.console import Console

from benchmarks.controllers.roster import ROSTER
from benchmarks.lib.command_line import blame, out_folder
from benchmarks.lib.tables import on_screen
from benchmarks.tune.options import TUNED, Options
from benchmarks.tune.search import FINAL_RUNS, Search


def execute(options: Options, console: Console) -> str:
    """Search, and write and print what was found."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    controller = ROSTER[options.controller]
    tuning = TUNED[options.controller]
    trials = options.trials or tuning.trials
    fan_out = options.fan_out.open()
    plant, out = options.plant.chosen(), out_folder(options.out)
    with blame("--out"):
        search = Search(controller, options.runs, out, fan_out, plant.arguments)
    search.run(trials)
    report = search.report(trials)
    console.print(f"The best, on {FINAL_RUNS} new runs")
    shown = report[[*tuning.space, "objective"]].head(5)
    console.print(on_screen(shown.map("{:.4g}".format)))
    return f"All trials are in {search.path}, the best in {search.path.with_suffix('.md')}"
