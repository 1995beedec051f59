"""Search for a controller's gains with Optuna: `python -m benchmarks.tune --help`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from cyclopts import Parameter

from benchmarks.controllers.roster import ROSTER
from benchmarks.lib.command import Count, FanOut, Folder, Runs, command, options, progress_bar
from benchmarks.lib.storage import Kept, origin, out_folder, write_csv
from benchmarks.loop.rollout import mean_error, settled, split
from benchmarks.loop.scenarios import PlantOptions

if TYPE_CHECKING:
    import pandas as pd

SEED = 1  # of the search
FIRST_RUN = 3_000_000  # first seed of the runs; no comparison uses these seeds
FINAL_RUNS, FINAL_FIRST_RUN = 1000, 4_000_000  # for judging the best again
TRIALS, STARTUP = 800, 200  # of the search, and those at random before the sampler learns
FINALISTS = 10  # of the best trials, which are evaluated again
PENALTY = 5.0  # degC, for failing to settle: the cost of doing nothing about an error of 5 degC
TUNED = {name: each.gains for name, each in ROSTER.items() if each.gains}

NOTE = (
    "For each case, the median over runs of the mean absolute error, °C. The objective is "
    f"their mean, plus {PENALTY:g} °C times the share of runs that do not settle at the "
    "constant set point."
)

Row = dict[str, float]  # gains, and their result from `score`


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Tune a controller's gains with Optuna.

    All trials use the same set points and seeds, which no comparison uses. Finished trials are
    kept, if no file of the checkout differs from its commit: the same command, run again, goes
    on from there and gives the same result.
    """

    controller: Annotated[str, Parameter(choices=TUNED)] = field(kw_only=False)
    """Whose gains to search."""
    trials: Count = TRIALS
    """How many sets of gains to try."""
    runs: Runs = 100
    """Runs of each case in a trial."""
    plant: PlantOptions = field(default_factory=PlantOptions)
    out: Folder = Path("results/tune")
    fan_out: FanOut = field(default_factory=FanOut)


# Neighbours of the paper's cases: samples, the first of them that counts, and arguments. Three
# count from an untrained controller on, and two count only what follows learning.
CASES: dict[str, tuple[int, int, dict[str, float]]] = {
    "constant": (600, 0, {"setpoint": 4.8}),
    "dead zone": (
        1280, 0, {"setpoint_amplitude": 5.1, "setpoint_period": 640, "dead_zone": 6.5}
    ),
    "noise": (
        1040, 0, {"setpoint_amplitude": 4.9, "setpoint_period": 520, "noise_variance": 0.4}
    ),
    "learnt": (2240, 1120, {"setpoint_amplitude": 5.2, "setpoint_period": 560}),
    "learnt, slow": (1920, 1280, {"setpoint_amplitude": 5.4, "setpoint_period": 640}),
}  # fmt: skip


def work(options: Options) -> str:
    """Run the search, and write and print its results."""
    import pandas as pd

    from benchmarks.lib.report import Section, provenance_line, show, write_report

    name, plant, made = options.controller, options.plant.arguments(), origin()
    out, judge = out_folder(options.out / name), partial(score, name, plant)
    in_search = partial(judge, options.runs, FIRST_RUN)
    trials = search(TUNED[name], in_search, options.trials, out)
    # The best gains of a search owe some of their result to luck; new runs show how much.
    best = trials.nsmallest(FINALISTS, "objective")
    rounded = best[[*TUNED[name]]].map(lambda gain: float(f"{gain:.3g}"))
    tasks = {
        f"trial {i}": partial(judge, FINAL_RUNS, FINAL_FIRST_RUN, gains)
        for i, gains in rounded.to_dict("index").items()
    }
    table = pd.DataFrame(options.fan_out.run(tasks, "new runs for the best").values())
    table = table.assign(**{"in the search": best["objective"].to_numpy()})
    table = table.sort_values("objective", ignore_index=True).map("{:.4g}".format)
    title = f"The best gains of {len(trials)} trials, on {FINAL_RUNS} new runs"
    sections = [Section(title, [NOTE], table)]
    made_by = provenance_line("tune", made)
    write_report(out, f"Gains: {ROSTER[name].label}", sections, made_by)
    show(sections)
    return f"All trials are in {out}/trials.csv, the best in {out}/report.md"


def search(
    gains: Mapping[str, tuple[float, float]],
    judge: Callable[[Row], Row],
    count: int,
    out: Path,
) -> pd.DataFrame:
    """Try `count` gains within these ranges, and return and write one row for each.

    What a trial tries follows from those before it. So an interrupted search takes the same
    course again, and finds the results of its first trials in the folder.
    """
    import optuna
    import pandas as pd

    optuna.logging.set_verbosity(optuna.logging.CRITICAL)
    study, run = optuna.create_study(), partial(FanOut(jobs=1).run, kept=Kept(out / "tasks"))
    rows: list[Row] = []
    try:
        with progress_bar("trials", count) as advance:
            for i in range(count):
                study.sampler = optuna.samplers.TPESampler(
                    seed=SEED * 1_000_000 + i, n_startup_trials=STARTUP, multivariate=True
                )
                trial, spans = study.ask(), gains.items()
                new = {name: trial.suggest_float(name, *span, log=True) for name, span in spans}
                rows += run({f"trial {i}": partial(judge, new)}).values()
                study.tell(trial, rows[-1]["objective"])
                advance()
    finally:
        write_csv(out / "trials.csv", pd.DataFrame(rows))
    return pd.DataFrame(rows)


def score(name: str, plant: Mapping[str, Any], runs: int, first_run: int, gains: Row) -> Row:
    """Judge a controller with these gains on the cases of the search.

    Each case has seeds of its own, beginning with `first_run`. Returned are the gains; for
    each case the median over runs of the mean |e|, degC; `not converged`, the share of runs
    at the constant set point that fail to settle; and `objective`, the mean of the medians plus
    the penalty times that share.
    """
    (factory,) = ROSTER[name].members()
    factory = replace(factory, make=partial(factory.make, **gains))
    medians: Row = {}
    for i, (case, (samples, first, arguments)) in enumerate(CASES.items()):
        trajectory = factory.run({**plant, **arguments}, samples, runs, first_run + i * 100_000)
        _, counted = split(trajectory, first)
        medians[case] = float(np.median(mean_error(counted)))
        if case == "constant":
            failed = 1.0 - float(settled(trajectory).mean())
    objective = float(np.mean(list(medians.values()))) + PENALTY * failed
    return {**gains, **medians, "not converged": failed, "objective": objective}


main = command("tune", Options, work)

if __name__ == "__main__":
    raise SystemExit(main(None))
