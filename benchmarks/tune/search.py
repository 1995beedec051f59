"""A search for a controller's gains with Optuna, which is saved after every trial."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import pandas as pd
from optuna.distributions import BaseDistribution, FloatDistribution
from tqdm import tqdm

from benchmarks.controllers.records import RosterEntry
from benchmarks.lib.fan_out import FanOut
from benchmarks.lib.fingerprint import code, fingerprint
from benchmarks.lib.storage import seal, unseal, write_text
from benchmarks.lib.tables import write_csv
from benchmarks.tune.objective import SCENARIOS, score

SEED = 1  # of the search
FIRST_RUN = 3_000_000  # runs have seeds from here on, which no comparison uses
FINAL_RUNS, FINAL_FIRST_RUN = 1000, 4_000_000  # for the best, judged again
DIGITS = 3  # significant, of the gains that are proposed


def _score(
    controller: RosterEntry,
    runs: int,
    first_run: int,
    plant: Mapping[str, Any],
    gains: dict[str, float],
    *,
    final: bool,
    member: int,
) -> dict[str, float]:
    tuning = controller.tuning
    assert tuning is not None
    if tuning.train is None:
        (factory,) = controller.members()
        factory = replace(factory, make=partial(factory.make, **gains))
    else:
        factory = tuning.train(**gains, final=final, member=member)
    return score(factory, runs, first_run, tuning.penalty, plant)


class Search:
    """A search that is saved after every trial.

    Parameters
    ----------
    controller
        Whose gains are searched.
    runs
        Of each scenario in a trial.
    folder
        Where the search is kept, as `<controller>.json`. A search that is there already is
        continued. `<controller>.csv` holds the trials, too, for readers.
    fan_out
        Runs the members of a trial, or the finalists, side by side.
    plant
        Arguments of the environment, if it is not the paper's plant.

    Raises
    ------
    ValueError
        If the file is of another search, was made by other code, or is damaged; the message
        says what to do.
    """

    def __init__(
        self,
        controller: RosterEntry,
        runs: int,
        folder: Path,
        fan_out: FanOut,
        plant: Mapping[str, Any] | None = None,
    ) -> None:
        assert controller.tuning is not None
        self.path = folder / f"{controller.name}.csv"
        self._kept = self.path.with_suffix(".json")
        self._controller = controller
        self._tuning = controller.tuning
        self._runs = runs
        self._fan_out = fan_out
        self._plant = dict(plant or {})
        space = self._tuning.space
        self._space: dict[str, BaseDistribution] = {
            name: FloatDistribution(*ends, log=True) for name, ends in space.items()
        }
        settings = {
            "runs": runs,
            "plant": self._plant,
            "seed": SEED,
            "first run": FIRST_RUN,
            "space": space,
            "scenarios": {s.name: [s.samples, first, s.arguments] for s, first in SCENARIOS},
            "penalty": self._tuning.penalty,
            "startup": self._tuning.startup,
            "Optuna": optuna.__version__,
            "code": self._code(),
        }
        self._settings = json.loads(json.dumps(settings))  # in the form in which it comes back
        self._rows = self._earlier()

    def _code(self) -> str:
        """Return a hash of the code that makes and judges the controller."""
        train = self._tuning.train
        maker = train.__module__ if train else self._controller.members()[0].module
        judges = ("benchmarks.loop.metrics", "benchmarks.loop.rollout")
        objective = code("benchmarks.tune.objective")  # and not all that it imports
        return fingerprint(maker, *judges, objective=objective)

    def _earlier(self) -> list[dict[str, float]]:
        """Return the trials that are kept, if they are of this search."""
        files = f"{self.path} and {self._kept}"
        begin_anew = f"to begin anew, remove {files}, or choose another folder"
        try:
            kept = unseal(self._kept.read_text(encoding="utf-8"))
            earlier, rows = kept["settings"], kept["trials"]
        except FileNotFoundError as error:
            if self.path.exists():
                raise ValueError(
                    f"{self._kept}, which {self.path} goes on from, is missing: bring it back; "
                    f"or, {begin_anew}"
                ) from error
            return []
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{self._kept} is damaged ({error}): {begin_anew}") from error
        changed = [name for name in self._settings if self._settings[name] != earlier.get(name)]
        if changed:
            raise ValueError(
                f"{self._kept} is of a search with other {', '.join(changed)}: {begin_anew}"
            )
        return list(rows)

    @property
    def trials(self) -> pd.DataFrame:
        """One row a trial: the gains, and what `score` says of them."""
        return pd.DataFrame(self._rows)

    def run(self, trials: int) -> None:
        """Try gains until `trials` have been tried in all."""
        with tqdm(total=trials, initial=len(self._rows), desc=self._controller.name) as bar:
            while len(self._rows) < trials:
                gains = self._next()
                (judged,) = self._judge([gains], self._runs, FIRST_RUN, final=False)
                self._rows.append({**gains, **judged})
                write_text(self._kept, seal({"settings": self._settings, "trials": self._rows}))
                write_csv(self.path, self.trials)
                bar.set_postfix(best=f"{self.trials['objective'].min():.3f}")
                bar.update()

    def _next(self) -> dict[str, float]:
        """Return the gains to try next.

        The sampler starts anew from the search's seed and the trial's number, so that a search
        that was interrupted goes on as it would have gone.
        """
        sampler = optuna.samplers.TPESampler(
            seed=SEED * 1_000_000 + len(self._rows),
            n_startup_trials=self._tuning.startup,
            multivariate=True,
        )
        study = optuna.create_study(sampler=sampler)
        for row in self._rows:
            gains = {name: row[name] for name in self._space}
            study.add_trial(
                optuna.trial.create_trial(
                    params=gains, distributions=self._space, value=row["objective"]
                )
            )
        return study.ask(self._space).params

    def _judge(
        self, candidates: list[dict[str, float]], runs: int, first_run: int, *, final: bool
    ) -> list[dict[str, float]]:
        """Return, for each of the candidates, the mean of its members' scores."""
        members = self._tuning.members[final]
        settings = self._controller, runs, first_run, self._plant
        tasks = {
            f"candidate {i}, member {member}": partial(
                _score, *settings, gains, final=final, member=member
            )
            for i, gains in enumerate(candidates)
            for member in range(members)
        }
        # One alone gains nothing from another process, which takes seconds to start.
        fan_out = self._fan_out if len(tasks) > 1 else FanOut(jobs=1)
        answers = fan_out.run(tasks, title="new runs for the best" if final else "")
        scores = pd.DataFrame(list(answers.values()))
        groups = [scores.iloc[i : i + members] for i in range(0, len(scores), members)]
        return [
            {name: float(np.mean(group[name])) for name in scores.columns} for group in groups
        ]

    def report(self, trials: int) -> pd.DataFrame:
        """Judge the best of so many trials again, rounded and on new runs, and write them.

        The best gains of a search owe some of their result to luck; new runs show how much.
        They are returned, too, best first.
        """
        best = self.trials.head(trials).nsmallest(self._tuning.finalists, "objective")
        candidates = [
            {name: float(f"{trial[name]:.{DIGITS}g}") for name in self._space}
            for _, trial in best.iterrows()
        ]
        again = self._judge(candidates, FINAL_RUNS, FINAL_FIRST_RUN, final=True)
        table = pd.concat([pd.DataFrame(candidates), pd.DataFrame(again)], axis=1)
        table["in the search"] = best["objective"].to_numpy()
        table = table.sort_values("objective", ignore_index=True)
        write_text(self.path.with_suffix(".md"), self._page(table, trials))
        return table

    def _page(self, table: pd.DataFrame, trials: int) -> str:
        improved = self.trials.head(trials)
        improved = improved[improved["objective"].cummin().diff().fillna(-1.0) < 0.0]
        scenarios = pd.DataFrame(
            [(s.name, s.title, s.samples, first) for s, first in SCENARIOS],
            columns=["scenario", "what it is", "samples", "first that counts"],
        )
        penalty = self._tuning.penalty
        return "\n\n".join(
            [
                f"# Gains: {self._controller.label}",
                f"By `python -m benchmarks.tune {self._controller.name} --trials {trials} "
                f"--runs {self._runs}`. In each scenario: the median over runs of the mean "
                f"absolute error, °C. The objective is their mean, plus {penalty:g} °C times "
                "the share of runs at the constant set point that do not settle.",
                f"## The best {len(table)} of {trials}, on {FINAL_RUNS} new runs",
                table.to_markdown(index=False, floatfmt=".4g"),
                "## The search: every trial that was better than all before",
                improved.reset_index(names="trial").to_markdown(index=False, floatfmt=".4g"),
                "## Scenarios",
                scenarios.to_markdown(index=False),
                "",
            ]
        )
