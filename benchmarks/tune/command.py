"""Search for a controller's gains with Optuna, whose storage keeps every trial."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import optuna
import pandas as pd
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import TrialState
from rich.console import Console

from benchmarks.controllers.records import Tuning
from benchmarks.controllers.roster import ROSTER
from benchmarks.lib.command import out_folder
from benchmarks.lib.fan_out import progress_bar
from benchmarks.lib.storage import commit, write_text
from benchmarks.lib.tables import ScreenTable, write_csv
from benchmarks.loop.metrics import mean_error, settled, split
from benchmarks.loop.scenarios import Scenario
from benchmarks.tune.__main__ import Options

SEED = 1  # of the search
FIRST_RUN = 3_000_000  # first seed of the runs; no comparison uses these seeds
FINAL_RUNS, FINAL_FIRST_RUN = 1000, 4_000_000  # for judging the best again

Row = dict[str, float]  # gains, and their result from `score`


def _square(
    name: str, more: str, samples: int, amplitude: float, period: int, **plant: float
) -> Scenario:
    arguments = {"setpoint_amplitude": amplitude, "setpoint_period": period, **plant}
    return Scenario(name, f"square wave{more}", samples, arguments)


# Neighbours of the paper's cases, each with the first sample that counts: three that count from
# an untrained controller on, and two that count only what follows learning.
SCENARIOS: tuple[tuple[Scenario, int], ...] = (
    (Scenario("constant", "constant set point", 600, {"setpoint": 4.8}), 0),
    (_square("dead zone", ", dead zone 6.5 t/h", 1280, 5.1, 640, dead_zone=6.5), 0),
    (_square("noise", ", R = 0.4 °C²", 1040, 4.9, 520, noise_variance=0.4), 0),
    (_square("learnt", "", 2240, 5.2, 560), 1120),
    (_square("learnt, slow", "", 1920, 5.4, 640), 1280),
)


def execute(options: Options, console: Console) -> str:
    """Run the search, and write and print its results."""
    optuna.logging.set_verbosity(optuna.logging.ERROR)  # no traceback after Ctrl-C
    name, out = options.controller, out_folder(options.out)
    tuning = tuning_of(name)
    judge = partial(score, name, options.plant.chosen().arguments)
    count = options.trials or tuning.trials
    trials = search(tuning, partial(judge, options.runs, FIRST_RUN), count, out / f"{name}.csv")
    # The best gains of a search owe some of their result to luck; new runs show how much.
    best = trials.nsmallest(tuning.finalists, "objective")
    rounded = best[[*tuning.space]].map(lambda gain: float(f"{gain:.3g}"))
    tasks = {
        f"trial {i}": partial(judge, FINAL_RUNS, FINAL_FIRST_RUN, gains)
        for i, gains in rounded.to_dict("index").items()
    }
    table = pd.DataFrame(options.fan_out.run(tasks, "new runs for the best").values())
    table["in the search"] = best["objective"].to_numpy()
    table = table.sort_values("objective", ignore_index=True)
    write_text(out / f"{name}.md", _page(name, table, trials, options.runs))
    console.print(f"The best, on {FINAL_RUNS} new runs")
    shown = table[[*tuning.space, "objective"]].head(5)
    console.print(ScreenTable(shown.map("{:.4g}".format)))
    return f"All trials are in {out / name}.csv, the best in {out / name}.md"


def tuning_of(name: str) -> Tuning:
    """Return the settings of the search for a controller's gains."""
    tuning = ROSTER[name].tuning
    assert tuning is not None
    return tuning


def search(tuning: Tuning, judge: Callable[[Row], Row], count: int, path: Path) -> pd.DataFrame:
    """Try gains until there are `count` trials, and return and write one row for each.

    Each trial has a sampler of its own, seeded with the search's seed and the number of trials
    before, so that an interrupted search continues exactly as it would have.
    """
    log = path.with_name("trials.log")
    if log.exists() and not (lines := log.read_bytes()).endswith(b"\n"):
        # Its writer was killed, or the disk was full: Optuna could not read an unfinished line.
        log.write_bytes(lines[: lines.rfind(b"\n") + 1])
    study = optuna.create_study(
        # Of everything that shapes the trials.
        study_name=_name(judge, tuning, commit()),
        storage=JournalStorage(JournalFileBackend(str(log))),
        load_if_exists=True,
    )

    def attempt(trial: optuna.Trial) -> float:
        row = judge(
            {
                name: trial.suggest_float(name, *ends, log=True)
                for name, ends in tuning.space.items()
            }
        )
        trial.set_user_attr("row", row)
        return row["objective"]

    def rows() -> list[Row]:
        done = study.get_trials(deepcopy=False, states=[TrialState.COMPLETE])
        return [trial.user_attrs["row"] for trial in done[:count]]

    try:
        done = len(rows())
        with progress_bar(path.stem, count - done) as advance:
            for number in range(done, count):
                study.sampler = optuna.samplers.TPESampler(
                    seed=SEED * 1_000_000 + number,
                    n_startup_trials=tuning.startup,
                    multivariate=True,
                )
                study.optimize(attempt, n_trials=1)
                advance()
    finally:
        write_csv(path, pd.DataFrame(rows()))
    return pd.DataFrame(rows())


def _name(*search: object) -> str | None:
    """Return a name for a search, None if its parts have none."""
    with suppress(Exception):  # whatever pickling raises
        return str(joblib.hash(search))
    return None


def score(name: str, plant: Mapping[str, Any], runs: int, first_run: int, gains: Row) -> Row:
    """Judge a controller with these gains on the tuning scenarios.

    Parameters
    ----------
    name
        Name of the controller in the roster.
    plant
        Arguments of the environment that differ from the paper's.
    runs, first_run
        Runs of each scenario, and the seed of the first; each scenario has seeds of its own.
    gains
        The gains.

    Returns
    -------
    dict
        The gains; for each scenario the median over runs of the mean |e|, degC; `not
        converged`, the share of runs at the constant set point that fail to settle; and
        `objective`, the mean of the medians plus the penalty times that share.
    """
    (factory,) = ROSTER[name].members()
    factory = replace(factory, make=partial(factory.make, **gains))
    medians: Row = {}
    for i, (scenario, first_sample) in enumerate(SCENARIOS):
        arguments = {**plant, **scenario.arguments}
        trajectory = factory.run(arguments, scenario.samples, runs, first_run + i * 100_000)
        _, counted = split(trajectory, first_sample)
        medians[scenario.name] = float(np.median(mean_error(counted)))
        if scenario.name == "constant":
            failed = 1.0 - float(settled(trajectory).mean())
    objective = float(np.mean(list(medians.values()))) + tuning_of(name).penalty * failed
    return {**gains, **medians, "not converged": failed, "objective": objective}


def _page(name: str, table: pd.DataFrame, trials: pd.DataFrame, runs: int) -> str:
    improved = trials[trials["objective"].cummin().diff().fillna(-1.0) < 0.0]
    scenarios = pd.DataFrame(
        [(s.name, s.title, s.samples, first) for s, first in SCENARIOS],
        columns=["scenario", "what it is", "samples", "first that counts"],
    )
    return "\n\n".join(
        [
            f"# Gains: {ROSTER[name].label}",
            f"By `python -m benchmarks.tune {name} --trials {len(trials)} --runs {runs}`. In "
            "each scenario: the median over runs of the mean absolute error, °C. The objective "
            f"is their mean, plus {tuning_of(name).penalty:g} °C times the share of runs at "
            "the constant set point that do not settle.",
            f"## The best {len(table)} of {len(trials)}, on {FINAL_RUNS} new runs",
            table.to_markdown(index=False, floatfmt=".4g"),
            "## The search: every trial that was better than all before",
            improved.reset_index(names="trial").to_markdown(index=False, floatfmt=".4g"),
            "## Scenarios",
            scenarios.to_markdown(index=False),
            "",
        ]
    )
