"""Search a controller's gains with Optuna: `python -m benchmarks.tune nn`, `pi` or `ppo`.

All are judged on the same set points and seeds, which no comparison uses. NN and PI have the
same number of trials; PPO has fewer, as each is a training. The search is saved after every
trial; the same command continues it, to the same end.
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import pandas as pd
from optuna.distributions import FloatDistribution
from tqdm import tqdm

from agents import DirectNNController, PIController
from benchmarks import command_line
from benchmarks.experiments import mean_error, settled, split
from benchmarks.fan_out import FanOut
from benchmarks.rollout import make_plants, rollout
from benchmarks.roster import LABELS, Factory, build, observation
from benchmarks.scenarios import Scenario
from benchmarks.storage import replacing, write_json, write_text
from benchmarks.tables import on_screen
from mptc_gym import Parameters

DRAWS = 100  # runs of each scenario in a trial, each with noise and initial weights of its own
SEED = 1  # of the search
FIRST_RUN = 3_000_000  # runs have seeds from here on, which no comparison uses
FINAL_DRAWS, FINAL_RUN = 1000, 4_000_000  # for the best, judged again
DIGITS = 3  # significant, of the gains that are proposed

# Neighbours of the paper's cases, each with its first sample that counts: three that begin with
# an untrained controller, and two that show what comes after learning.
SCENARIOS: tuple[tuple[Scenario, int], ...] = (
    (Scenario("constant", "constant set point", 600, {"setpoint": 4.8}), 0),
    (
        Scenario(
            "dead zone", "square wave, dead zone 6.5 t/h", 1280,
            {"setpoint_amplitude": 5.1, "setpoint_period": 640, "dead_zone": 6.5},
        ),
        0,
    ),
    (
        Scenario(
            "noise", "square wave, R = 0.4 °C²", 1040,
            {"setpoint_amplitude": 4.9, "setpoint_period": 520, "noise_variance": 0.4},
        ),
        0,
    ),
    (
        Scenario(
            "learnt", "square wave", 2240, {"setpoint_amplitude": 5.2, "setpoint_period": 560}
        ),
        1120,
    ),
    (
        Scenario(
            "learnt, slow", "square wave", 1920,
            {"setpoint_amplitude": 5.4, "setpoint_period": 640},
        ),
        1280,
    ),
)  # fmt: skip

# A run at the constant set point that has not settled at its end has failed to converge. That
# costs what doing nothing about a set point of 5 degC costs.
PENALTY = 5.0
PPO_POLICIES, FINAL_POLICIES = 2, 4  # of a trial, and of one of the best
PPO_SEED, FINAL_SEED = 1000, 2000  # of the first of them, others than a comparison uses


@dataclass(frozen=True)
class Subject:
    """What can be tuned.

    Attributes
    ----------
    make
        Called with gains by name, `final`, whether they are judged for the last time, and the
        number of the member; returns a factory.
    space
        Name of a gain: lowest and highest value. Gains are searched on a logarithmic scale.
    trials, startup
        Number of trials, and how many of them are at random before the sampler learns.
    finalists
        How many of the best are judged again.
    penalty
        For failing to converge, degC.
    members
        How many factories are made of the same gains, in the search and at last. Their
        objectives are averaged.
    """

    make: Callable[..., Factory]
    space: dict[str, tuple[float, float]]
    trials: int = 800
    startup: int = 200
    finalists: int = 10
    penalty: float = PENALTY
    members: tuple[int, int] = (1, 1)


def _make_nn(*, final: bool, member: int, **gains: float) -> Factory:
    return partial(DirectNNController, **gains)


def _make_pi(*, final: bool, member: int, **gains: float) -> Factory:
    return partial(PIController, **gains)


def _make_ppo(*, final: bool, member: int, **gains: float) -> Factory:
    from benchmarks import ppo  # here: torch takes seconds to load

    first = FINAL_SEED if final else PPO_SEED
    with tempfile.TemporaryDirectory() as folder:
        return ppo.Policy(ppo.PPOArguments(seed=first + member, **gains), Path(folder))


SUBJECTS = {
    "nn": Subject(
        _make_nn,
        {
            "eta": (1e-3, 10.0),
            "eta_1": (1e-3, 1.0),
            "eta_theta": (1e-4, 1.0),
            "eta_1_theta": (1e-4, 1.0),
            "input_scale": (0.02, 1.0),
            "weight_scale": (0.05, 2.0),
        },
    ),
    "pi": Subject(_make_pi, {"kp": (0.1, 10.0), "ki": (1e-3, 1.0)}),
    # Without integral action a policy does not settle to the last; only its errors count.
    "ppo": Subject(
        _make_ppo,
        {
            "learning_rate": (7e-4, 2e-3),
            "gamma": (0.96, 0.985),
            "noise_variance": (0.1, 0.8),
            "setpoint_amplitude": (5.0, 7.0),
        },
        trials=9,
        startup=5,
        finalists=2,
        penalty=0.0,
        members=(PPO_POLICIES, FINAL_POLICIES),
    ),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Search, and write and print what was found.

    Parameters
    ----------
    arguments
        The command line without the program's name.

    Returns
    -------
    int
        0, or 130 if it was interrupted.
    """
    parser = command_line.parser("tune", __doc__)
    add = parser.add_argument
    add("controller", choices=SUBJECTS, help="whose gains to search")
    trials = ", ".join(f"{subject.trials} for {name}" for name, subject in SUBJECTS.items())
    add(
        "--trials",
        type=command_line.number,
        default=argparse.SUPPRESS,
        help=f"how many gains to try (default: {trials})",
    )
    add("--draws", type=command_line.number, default=DRAWS, help="runs of each scenario")
    add("--out", type=Path, default=Path("results/tune"), help="folder to write to")
    command_line.add_fan_out(parser, "runs and trainings")
    options = parser.parse_args(arguments)
    trials = getattr(options, "trials", SUBJECTS[options.controller].trials)

    try:
        fan_out = command_line.fan_out(options)
    except ValueError as error:
        parser.error(f"--backend: {error}")
    try:
        search = Search(options.controller, options.draws, options.out, fan_out)
    except ValueError as error:
        parser.error(f"--out, --draws: {error}")
    console = command_line.console(120)
    try:
        search.run(trials)
        report = search.report(trials)
    except KeyboardInterrupt:
        console.print("\nInterrupted: the same command goes on from here.")
        return 130
    console.print(f"The best, on {FINAL_DRAWS} new runs")
    shown = report[[*SUBJECTS[options.controller].space, "objective"]].head(5)
    console.print(on_screen(shown.map("{:.4g}".format)))
    console.print(
        f"All trials are in {search.path}, the best in {search.path.with_suffix('.md')}"
    )
    return 0


def score(
    factory: Factory, draws: int, first_run: int, penalty: float = PENALTY
) -> dict[str, float]:
    """Judge a controller on the tuning scenarios.

    Parameters
    ----------
    factory
        Makes the controller, as `roster.build` calls it.
    draws
        Runs of each scenario.
    first_run
        Seed of the first; every scenario has seeds of its own.
    penalty
        For failing to converge, degC.

    Returns
    -------
    dict
        For each scenario the median over runs of the mean |e|, degC; `not converged`, the
        share of runs at the constant set point that failed to; and `objective`: the mean of
        the medians, plus the penalty times that share.
    """
    medians: dict[str, float] = {}
    for i, (scenario, first_sample) in enumerate(SCENARIOS):
        seed = first_run + i * 100_000
        environment = {**scenario.arguments, **observation(factory)}
        controller = build(factory, Parameters(**environment), draws, seed)
        plants = make_plants(draws, scenario.samples, **environment)
        trajectory = rollout(plants, controller, scenario.samples, seed)
        _, counted = split(trajectory, first_sample)
        medians[scenario.name] = float(np.median(mean_error(counted)))
        if scenario.name == "constant":
            failed = 1.0 - float(settled(trajectory).mean())
    objective = float(np.mean(list(medians.values()))) + penalty * failed
    return {**medians, "not converged": failed, "objective": objective}


def _score(
    subject: Subject,
    gains: dict[str, float],
    draws: int,
    first_run: int,
    *,
    final: bool,
    member: int,
) -> dict[str, float]:
    factory = subject.make(**gains, final=final, member=member)
    return score(factory, draws, first_run, subject.penalty)


class Search:
    """A search that is saved after every trial.

    Parameters
    ----------
    controller
        A name in `SUBJECTS`.
    draws
        Runs of each scenario in a trial.
    folder
        Where it is kept, as `<controller>.csv`; what is there is continued.
    fan_out
        Runs what does not depend on each other: the members of a trial, and the finalists.

    Raises
    ------
    ValueError
        If what is there was another search.
    """

    def __init__(self, controller: str, draws: int, folder: Path, fan_out: FanOut) -> None:
        self.path = folder / f"{controller}.csv"
        self._draws = draws
        self._controller = controller
        self._fan_out = fan_out
        self._subject = SUBJECTS[controller]
        space = self._subject.space
        self._space = {name: FloatDistribution(*ends, log=True) for name, ends in space.items()}
        self._study = optuna.create_study()
        self._rows: list[dict[str, float]] = []
        # In the form in which JSON gives it back.
        settings = json.loads(
            json.dumps(
                {
                    "draws": draws,
                    "seed": SEED,
                    "first run": FIRST_RUN,
                    "space": space,
                    "scenarios": {
                        s.name: [s.samples, first, s.arguments] for s, first in SCENARIOS
                    },
                    "penalty": self._subject.penalty,
                    "startup": self._subject.startup,
                    "Optuna": optuna.__version__,
                }
            )
        )
        beside = self.path.with_suffix(".json")
        if self.path.exists():
            earlier = json.loads(beside.read_text(encoding="utf-8"))
            changed = [name for name in settings if settings[name] != earlier.get(name)]
            if changed:
                raise ValueError(f"{self.path} is of a search with other {', '.join(changed)}")
            with self.path.open(encoding="utf-8", newline="") as file:
                for row in csv.DictReader(file):
                    self._add({name: float(value) for name, value in row.items()})
        write_json(beside, settings)

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
        with tqdm(total=trials, initial=len(self._rows), desc=self._controller) as bar:
            while len(self._rows) < trials:
                self._add(self._try())
                with replacing(self.path) as file:
                    self.trials.to_csv(file, index=False)
                bar.set_postfix(best=f"{self._study.best_value:.3f}")
                bar.update()

    def _try(self) -> dict[str, float]:
        # The sampler starts anew from the search's seed and the trial's number, so that a
        # search that was interrupted goes on as it would have gone.
        seed = SEED * 1_000_000 + len(self._rows)
        sampler = optuna.samplers.TPESampler(
            seed=seed, n_startup_trials=self._subject.startup, multivariate=True
        )
        asking = optuna.create_study(sampler=sampler)
        asking.add_trials(self._study.trials)
        gains = asking.ask(self._space).params
        return {**gains, **self._judge([gains], self._draws, FIRST_RUN, final=False)[0]}

    def _judge(
        self, candidates: list[dict[str, float]], draws: int, first_run: int, *, final: bool
    ) -> list[dict[str, float]]:
        """Return, for each of the candidates, the mean of its members' scores."""
        members = self._subject.members[final]
        cells = {
            f"candidate {i}, member {member}": partial(
                _score, self._subject, gains, draws, first_run, final=final, member=member
            )
            for i, gains in enumerate(candidates)
            for member in range(members)
        }
        # One alone gains nothing from another process, which takes seconds to start.
        fan_out = self._fan_out if len(cells) > 1 else FanOut(jobs=1)
        answers = fan_out.run(cells, title="new runs for the best", progress=final)
        scores = pd.DataFrame(list(answers.values()))
        groups = [scores.iloc[i : i + members] for i in range(0, len(scores), members)]
        return [{name: float(np.mean(group[name])) for name in group} for group in groups]

    def report(self, trials: int) -> pd.DataFrame:
        """Judge the best gains again, rounded and on new runs, and write them, best first.

        The gains that did best in a search did so by luck too; new runs tell.

        Parameters
        ----------
        trials
            How many of the trials count.
        """
        best = self.trials.head(trials).nsmallest(self._subject.finalists, "objective")
        candidates = [
            {name: float(f"{trial[name]:.{DIGITS}g}") for name in self._space}
            for _, trial in best.iterrows()
        ]
        again = self._judge(candidates, FINAL_DRAWS, FINAL_RUN, final=True)
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
        penalty = self._subject.penalty
        return "\n\n".join(
            [
                f"# Gains: {LABELS[self._controller]}",
                f"By `python -m benchmarks.tune {self._controller} --trials {trials} "
                f"--draws {self._draws}`. In each scenario: the median over runs of the mean "
                f"absolute error, °C. The objective is their mean, plus {penalty:g} °C times "
                "the share of runs at the constant set point that do not settle.",
                f"## The best {len(table)} of {trials}, on {FINAL_DRAWS} new runs",
                table.to_markdown(index=False, floatfmt=".4g"),
                "## The search: every trial that was better than all before",
                improved.reset_index(names="trial").to_markdown(index=False, floatfmt=".4g"),
                "## Scenarios",
                scenarios.to_markdown(index=False),
                "",
            ]
        )


if __name__ == "__main__":
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    sys.exit(main())
