"""Search for a controller's gains with Optuna, keeping every trial."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import pandas as pd
from optuna.distributions import BaseDistribution, FloatDistribution
from tqdm import tqdm

from benchmarks.controllers.records import RosterEntry, Tuning
from benchmarks.lib.fan_out import FanOut
from benchmarks.lib.fingerprint import code, fingerprint
from benchmarks.lib.storage import write_text
from benchmarks.lib.tables import write_csv
from benchmarks.tune.objective import SCENARIOS, score

SEED = 1  # seed of the search
FIRST_RUN = 3_000_000  # first seed of the runs; no comparison uses these seeds
FINAL_RUNS, FINAL_FIRST_RUN = 1000, 4_000_000  # for judging the best again
DIGITS = 3  # significant digits of the gains that are judged again

Row = dict[str, float]  # gains, and their result from `score`


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
    """Folder for `<controller>.csv` and `<controller>.md`. The trials are kept in a subfolder
    named after everything that shapes them: code, plant, runs and versions."""
    fan_out: FanOut
    """Runs the members of a trial, or the finalists, in parallel."""

    @property
    def path(self) -> Path:
        """Path of the table of all trials."""
        return self.folder / f"{self.controller.name}.csv"

    @property
    def tuning(self) -> Tuning:
        """Settings of the search."""
        assert self.controller.tuning is not None
        return self.controller.tuning

    @cached_property
    def _kept(self) -> Path:
        train = self.tuning.train
        maker = train.__module__ if train else self.controller.members()[0].module
        judges = ("benchmarks.loop.metrics", "benchmarks.loop.rollout")
        name = fingerprint(
            maker,
            *judges,
            objective=code("benchmarks.tune.objective"),  # without its imports
            case=[self.runs, dict(self.plant), SEED, FIRST_RUN, optuna.__version__],
            tuning=[self.tuning.space, self.tuning.penalty, self.tuning.startup],
        )
        return self.folder / f"{self.controller.name}-{name}"

    def run(self, trials: int) -> pd.DataFrame:
        """Try gains until there are `trials` in all, and return one row for each trial."""
        rows: list[Row] = []
        try:
            with tqdm(total=trials, desc=self.controller.name) as bar:
                while len(rows) < trials:
                    propose = partial(_proposed, self.tuning, rows)
                    rows += self._judge({f"trial {len(rows)}": propose}, final=False)
                    bar.set_postfix(best=f"{min(row['objective'] for row in rows):.3f}")
                    bar.update()
        finally:
            if rows:
                write_csv(self.path, pd.DataFrame(rows))
        return pd.DataFrame(rows)

    def _judge(self, candidates: Mapping[str, Callable[[], Row]], *, final: bool) -> list[Row]:
        """Return each candidate's gains with the mean of its members' scores."""
        members = range(self.tuning.members[final])
        runs = (FINAL_RUNS, FINAL_FIRST_RUN) if final else (self.runs, FIRST_RUN)
        judged = partial(_judged, self.controller, self.plant, *runs, final)
        tasks = {
            f"{name}, member {member}": partial(judged, propose, member)
            for name, propose in candidates.items()
            for member in members
        }
        # A single task gains nothing from another process, which takes seconds to start.
        fan_out = self.fan_out if len(tasks) > 1 else FanOut(jobs=1)
        title = "new runs for the best" if final else ""
        found = fan_out.run(tasks, None if final else self._kept, title)
        rows = []
        for name in candidates:
            answers = [found[f"{name}, member {member}"] for member in members]
            rows.append({key: float(np.mean([a[key] for a in answers])) for key in answers[0]})
        return rows

    def report(self, trials: pd.DataFrame) -> pd.DataFrame:
        """Judge the best trials again, with rounded gains on new runs; write and return them.

        The best gains of a search owe some of their result to luck; new runs show how much.
        The rows are sorted, best first.
        """
        best = trials.nsmallest(self.tuning.finalists, "objective")
        candidates: dict[str, Callable[[], Row]] = {}
        for i, trial in best.iterrows():
            gains = {name: float(f"{trial[name]:.{DIGITS}g}") for name in self.tuning.space}
            candidates[f"trial {i}"] = partial(dict, gains)
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


def _proposed(tuning: Tuning, rows: list[Row]) -> Row:
    """Return the gains to try after these trials.

    The sampler is seeded anew with the search's seed and the trial's number, so that an
    interrupted search continues exactly as it would have without the interruption.
    """
    sampler = optuna.samplers.TPESampler(
        seed=SEED * 1_000_000 + len(rows), n_startup_trials=tuning.startup, multivariate=True
    )
    space: dict[str, BaseDistribution] = {
        name: FloatDistribution(*ends, log=True) for name, ends in tuning.space.items()
    }
    study = optuna.create_study(sampler=sampler)
    for row in rows:
        gains = {name: row[name] for name in space}
        study.add_trial(
            optuna.trial.create_trial(params=gains, distributions=space, value=row["objective"])
        )
    return study.ask(space).params


def _judged(
    controller: RosterEntry,
    plant: Mapping[str, Any],
    runs: int,
    first_run: int,
    final: bool,
    propose: Callable[[], Row],
    member: int,
) -> Row:
    """Return gains together with the score of a controller that has them."""
    gains, tuning = propose(), controller.tuning
    assert tuning is not None
    if tuning.train is None:
        (factory,) = controller.members()
        factory = replace(factory, make=partial(factory.make, **gains))
    else:
        factory = tuning.train(**gains, final=final, member=member)
    return {**gains, **score(factory, plant, runs, first_run, tuning.penalty)}
