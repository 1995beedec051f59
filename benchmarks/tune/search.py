"""Search for a controller's gains with Optuna, whose storage keeps every trial."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import optuna
import pandas as pd
from optuna.distributions import BaseDistribution, FloatDistribution
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import create_trial
from rich.console import Console
from tqdm import tqdm

from benchmarks.controllers.records import RosterEntry, Tuning
from benchmarks.controllers.roster import ROSTER
from benchmarks.lib.command import out_folder
from benchmarks.lib.fan_out import FanOut
from benchmarks.lib.storage import key, write_text
from benchmarks.lib.tables import on_screen, write_csv
from benchmarks.tune.__main__ import Options
from benchmarks.tune.objective import SCENARIOS, score

SEED = 1  # seed of the search
FIRST_RUN = 3_000_000  # first seed of the runs; no comparison uses these seeds
FINAL_RUNS, FINAL_FIRST_RUN = 1000, 4_000_000  # for judging the best again
DIGITS = 3  # significant digits of the gains that are judged again

Row = dict[str, float]  # gains, and their result from `score`


def execute(options: Options, console: Console) -> str:
    """Run the search, and write and print its results."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    plant, out = options.plant.chosen().arguments, out_folder(options.out)
    search = Search(ROSTER[options.controller], options.runs, plant, out, options.fan_out)
    report = search.report(search.run(options.trials or search.tuning.trials))
    console.print(f"The best, on {FINAL_RUNS} new runs")
    shown = report[[*search.tuning.space, "objective"]].head(5)
    console.print(on_screen(shown.map("{:.4g}".format)))
    return f"All trials are in {search.path}, the best in {search.path.with_suffix('.md')}"


@dataclass(frozen=True)
class Search:
    """A search that resumes after an interruption and gives the same result as without it."""

    controller: RosterEntry
    """The controller to tune."""
    runs: int
    """Runs of each scenario in a trial."""
    plant: Mapping[str, Any]
    """Arguments of the environment, if the plant is not the paper's."""
    folder: Path
    """Folder for `<controller>.csv`, `<controller>.md` and the trials."""
    fan_out: FanOut
    """Runs the finalists in parallel."""

    @property
    def path(self) -> Path:
        """Path of the table of all trials."""
        return self.folder / f"{self.controller.name}.csv"

    @property
    def tuning(self) -> Tuning:
        """Settings of the search."""
        assert self.controller.tuning is not None
        return self.controller.tuning

    def run(self, trials: int) -> pd.DataFrame:
        """Try gains until there are `trials` in all, and return one row for each trial.

        Each trial has a sampler of its own, seeded with the search's seed and the number of
        trials before, so that an interrupted search continues exactly as it would have.
        """
        study, tuning = self._study(), self.tuning
        space: dict[str, BaseDistribution] = {
            name: FloatDistribution(*ends, log=True) for name, ends in tuning.space.items()
        }
        try:
            with tqdm(
                total=trials, initial=len(study.trials), desc=self.controller.name
            ) as bar:
                for number in range(len(study.trials), trials):
                    sampler = optuna.samplers.TPESampler(
                        seed=SEED * 1_000_000 + number,
                        n_startup_trials=tuning.startup,
                        multivariate=True,
                    )
                    before = optuna.create_study(sampler=sampler)
                    before.add_trials(study.trials)
                    gains = before.ask(space).params
                    (row,) = self._judge({"": gains}, final=False)
                    study.add_trial(
                        create_trial(
                            params=gains,
                            distributions=space,
                            value=row["objective"],
                            user_attrs=row,
                        )
                    )
                    bar.set_postfix(best=f"{study.best_value:.3f}")
                    bar.update()
        finally:
            rows = pd.DataFrame([trial.user_attrs for trial in study.trials[:trials]])
            write_csv(self.path, rows)
        return rows

    def _study(self) -> optuna.Study:
        """Return the study of everything that shapes the trials, with those of before."""
        tuning = self.tuning
        shaped_by = self.controller.name, self.runs, dict(self.plant), tuning.space
        return optuna.create_study(
            study_name=key(*shaped_by, tuning.penalty, tuning.startup),
            storage=JournalStorage(JournalFileBackend(str(self.folder / "trials.log"))),
            load_if_exists=True,
        )

    def _judge(self, candidates: Mapping[str, Row], *, final: bool) -> list[Row]:
        """Return each candidate's gains with its score."""
        runs = (FINAL_RUNS, FINAL_FIRST_RUN) if final else (self.runs, FIRST_RUN)
        judged = partial(_judged, self.controller, self.plant, *runs)
        tasks = {name: partial(judged, gains) for name, gains in candidates.items()}
        # A single task gains nothing from another process, which takes seconds to start.
        fan_out = self.fan_out if len(tasks) > 1 else FanOut(jobs=1)
        return [*fan_out.run(tasks, "new runs for the best" if final else "").values()]

    def report(self, trials: pd.DataFrame) -> pd.DataFrame:
        """Judge the best trials again, with rounded gains on new runs; write and return them.

        The best gains of a search owe some of their result to luck; new runs show how much.
        The rows are sorted, best first.
        """
        best = trials.nsmallest(self.tuning.finalists, "objective")
        candidates = {
            f"trial {i}": {
                name: float(f"{trial[name]:.{DIGITS}g}") for name in self.tuning.space
            }
            for i, trial in best.iterrows()
        }
        table = pd.DataFrame(self._judge(candidates, final=True))
        table["in the search"] = best["objective"].to_numpy()
        table = table.sort_values("objective", ignore_index=True)
        write_text(self.path.with_suffix(".md"), self._page(table, trials))
        return table

    def _page(self, table: pd.DataFrame, trials: pd.DataFrame) -> str:
        improved = trials[trials["objective"].cummin().diff().fillna(-1.0) < 0.0]
        scenarios = pd.DataFrame(
            [(s.name, s.title, s.samples, first) for s, first in SCENARIOS],
            columns=["scenario", "what it is", "samples", "first that counts"],
        )
        return "\n\n".join(
            [
                f"# Gains: {self.controller.label}",
                f"By `python -m benchmarks.tune {self.controller.name} --trials {len(trials)} "
                f"--runs {self.runs}`. In each scenario: the median over runs of the mean "
                "absolute error, °C. The objective is their mean, plus "
                f"{self.tuning.penalty:g} °C times the share of runs at the constant set point "
                "that do not settle.",
                f"## The best {len(table)} of {len(trials)}, on {FINAL_RUNS} new runs",
                table.to_markdown(index=False, floatfmt=".4g"),
                "## The search: every trial that was better than all before",
                improved.reset_index(names="trial").to_markdown(index=False, floatfmt=".4g"),
                "## Scenarios",
                scenarios.to_markdown(index=False),
                "",
            ]
        )


def _judged(
    controller: RosterEntry,
    plant: Mapping[str, Any],
    runs: int,
    first_run: int,
    gains: Row,
) -> Row:
    """Return gains together with the score of a controller that has them."""
    assert controller.tuning is not None
    (factory,) = controller.members()
    factory = replace(factory, make=partial(factory.make, **gains))
    return {**gains, **score(factory, plant, runs, first_run, controller.tuning.penalty)}
