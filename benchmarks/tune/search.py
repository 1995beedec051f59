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

from benchmarks.controllers.records import RosterEntry, Tuning
from benchmarks.controllers.roster import ROSTER, label
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
    gains: dict[str, float],
    runs: int,
    first_run: int,
    plant: Mapping[str, Any],
    *,
    final: bool,
    member: int,
) -> dict[str, float]:
    tuning = tuning_of(controller)
    if tuning.train is None:
        (factory,) = controller.members()
        factory = replace(factory, make=partial(factory.make, **gains))
    else:
        factory = tuning.train(**gains, final=final, member=member)
    return score(factory, runs, first_run, tuning.penalty, plant)


def tuning_of(controller: RosterEntry) -> Tuning:
    """Return how a controller's gains are searched; ValueError if they are not."""
    if controller.tuning is None:
        tuned = ", ".join(name for name, each in ROSTER.items() if each.tuning)
        raise ValueError(f"no gains of {controller.name!r} to search; there are {tuned}")
    return controller.tuning


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
        self.path = folder / f"{controller.name}.csv"
        self._plant = dict(plant or {})
        self._runs = runs
        self._controller = controller
        self._fan_out = fan_out
        self._tuning = tuning_of(controller)
        space = self._tuning.space
        self._space: dict[str, BaseDistribution] = {
            name: FloatDistribution(*ends, log=True) for name, ends in space.items()
        }
        self._study = optuna.create_study()
        self._rows: list[dict[str, float]] = []
        # In the form in which JSON gives it back.
        self._settings = json.loads(
            json.dumps(
                {
                    "runs": runs,
                    "plant": self._plant,
                    "seed": SEED,
                    "first run": FIRST_RUN,
                    "space": {name: list(ends) for name, ends in space.items()},
                    "scenarios": {
                        s.name: [s.samples, first, s.arguments] for s, first in SCENARIOS
                    },
                    "penalty": self._tuning.penalty,
                    "startup": self._tuning.startup,
                    "Optuna": optuna.__version__,
                    "code": self._code(),
                }
            )
        )
        self._kept = self.path.with_suffix(".json")
        for row in self._earlier():
            self._add(row)

    def _code(self) -> str:
        """Return a hash of the code that makes and judges the controller."""
        train = self._tuning.train
        maker = train.__module__ if train else self._controller.members()[0].module
        judges = ("benchmarks.loop.metrics", "benchmarks.loop.rollout")
        objective = code("benchmarks.tune.objective")  # and not all that it imports
        return fingerprint(maker, *judges, objective=objective)

    def _earlier(self) -> list[dict[str, float]]:
        """Return the trials that are kept, if they are of this search."""
        begin_anew = f"remove {self.path} and {self._kept}, or choose another folder"
        try:
            kept = unseal(self._kept.read_text(encoding="utf-8"))
            earlier, rows = kept["settings"], kept["trials"]
        except FileNotFoundError as error:
            if self.path.exists():
                raise ValueError(
                    f"{self._kept}, which {self.path} goes on from, is missing: bring it back; "
                    f"or, to begin anew, {begin_anew}"
                ) from error
            return []
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(
                f"{self._kept} is damaged ({error}): to begin anew, {begin_anew}"
            ) from error
        changed = [name for name in self._settings if self._settings[name] != earlier.get(name)]
        if changed:
            raise ValueError(
                f"{self._kept} is of a search with other {', '.join(changed)}: to begin anew, "
                f"{begin_anew}"
            )
        return list(rows)

    @property
    def trials(self) -> pd.DataFrame:
        """One row a trial: the gains, and what `score` says of them."""
        return pd.DataFrame(self._rows)

    def _add(self, row: dict[str, float]) -> None:
        gains = {name: row[name] for name in self._space}
        self._study.add_trial(
            optuna.trial.create_trial(
                params=gains, distributions=self._space, value=row["objective"]
            )
        )
        self._rows.append(row)

    def run(self, trials: int) -> None:
        """Try gains until `trials` have been tried in all."""
        with tqdm(total=trials, initial=len(self._rows), desc=self._controller.name) as bar:
            while len(self._rows) < trials:
                self._add(self._try())
                write_text(self._kept, seal({"settings": self._settings, "trials": self._rows}))
                write_csv(self.path, self.trials)
                bar.set_postfix(best=f"{self._study.best_value:.3f}")
                bar.update()

    def _try(self) -> dict[str, float]:
        # The sampler starts anew from the search's seed and the trial's number, so that a
        # search that was interrupted goes on as it would have gone.
        seed = SEED * 1_000_000 + len(self._rows)
        sampler = optuna.samplers.TPESampler(
            seed=seed, n_startup_trials=self._tuning.startup, multivariate=True
        )
        asking = optuna.create_study(sampler=sampler)
        asking.add_trials(self._study.trials)
        gains = asking.ask(self._space).params
        return {**gains, **self._judge([gains], self._runs, FIRST_RUN, final=False)[0]}

    def _judge(
        self, candidates: list[dict[str, float]], runs: int, first_run: int, *, final: bool
    ) -> list[dict[str, float]]:
        """Return, for each of the candidates, the mean of its members' scores."""
        members = self._tuning.members[final]
        tasks = {
            f"candidate {i}, member {member}": partial(
                _score,
                self._controller,
                gains,
                runs,
                first_run,
                self._plant,
                final=final,
                member=member,
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
        """Judge the best gains again, rounded and on new runs, and write them, best first.

        The best gains of a search owe some of their result to luck; new runs show how much.

        Parameters
        ----------
        trials
            How many of the trials count.
        """
        best = self.trials.head(trials).nsmallest(self._tuning.finalists, "objective")
        candidates = [
            {name: float(f"{trial[name]:.{DIGITS}g}") for name in self._space}
            for _, trial in best.iterrows()
        ]
        again = self._judge(candidates, FINAL_RUNS, FINAL_FIRST_RUN, final=True)
        rows: list[dict[str, Any]] = [
            {**gains, **judged, "in the search": objective}
            for gains, judged, objective in zip(
                candidates, again, best["objective"], strict=True
            )
        ]
        table = pd.DataFrame(rows).sort_values("objective", ignore_index=True)
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
                f"# Gains: {label(self._controller.name)}",
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
