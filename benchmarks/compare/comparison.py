"""Run controllers on scenarios, side by side on the cores, and keep what has finished."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import pandas as pd

from benchmarks.compare import tables
from benchmarks.compare.estimates import Scale, scale_of, travel_frontier
from benchmarks.controllers.records import Factory
from benchmarks.controllers.roster import ROSTER
from benchmarks.lib.fan_out import FanOut
from benchmarks.loop.metrics import join, mean_error, measure
from benchmarks.loop.rollout import make_plants, rollout
from benchmarks.loop.scenarios import Scenario
from mptc_gym.evaluation import SEED

TWICE = "square"  # who learns runs this scenario a second time, with what was learnt
# What takes long begins first, so that no core waits at the end.
LONG = ("mpc", "nn-self-tuning", "ppo", "self-tuning", "nn-smith")


@dataclass(frozen=True)
class Case:
    """What a controller did in a scenario."""

    runs: pd.DataFrame
    """One row for each run of each member."""
    responses: pd.DataFrame
    """Percentiles over the runs, one row for each sample."""
    again: float | None
    """Mean |e| in a second run with what was learnt, degC, if there was one."""
    seconds: float
    """How long the runs took."""


def run_case(scenario: Scenario, agent: str, members: Sequence[Factory], runs: int) -> Case:
    """Run all members of a controller on a scenario."""
    began = time.perf_counter()
    trajectories, rows, again = [], [], []
    for number, member in enumerate(members):
        controller = member(scenario.arguments, runs, SEED)
        plants = make_plants(runs, scenario.samples, **member.arguments(scenario.arguments))
        trajectory = rollout(plants, controller, scenario.samples, SEED)
        if scenario.name == TWICE:
            # Who does not learn does the same again; of a user's own that is not known.
            learns = member.learns or agent not in ROSTER
            second = (
                rollout(plants, controller, scenario.samples, SEED) if learns else trajectory
            )
            again.append(float(mean_error(second).mean()))
        plants.close()
        trajectories.append(trajectory)
        about = {"scenario": scenario.name, "agent": agent, "policy": number}
        seeds = pd.DataFrame({**about, "seed": range(SEED, SEED + runs)})
        measures = pd.DataFrame(measure(trajectory, scenario.parameters))
        rows.append(pd.concat([seeds, measures], axis=1))
    return Case(
        pd.concat(rows, ignore_index=True),
        tables.summarise_responses(join(trajectories), scenario, agent),
        sum(each / len(members) for each in again) if again else None,
        time.perf_counter() - began,
    )


@dataclass
class Comparison:
    """Controllers, scenarios, and what is known of them so far."""

    scenarios: Mapping[str, Scenario]
    controllers: Mapping[str, Sequence[Factory]]
    """The members of each."""
    count: int
    """How many runs of each there are: the first episodes of `mptc_gym.evaluate`."""
    cases: dict[tuple[str, str], Case] = field(default_factory=dict)
    """What has finished, by scenario and controller."""
    scales: dict[str, Scale] = field(default_factory=dict)
    """What the errors of a scenario are measured against."""
    frontiers: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    """The same for a given travel of the valve; see `travel_frontier`."""

    def run(self, fan_out: FanOut) -> Iterator[Case]:
        """Run all, and yield each case when it has finished.

        Raises
        ------
        TasksFailedError
            At the end, if a controller raised an exception; all others have finished.
        """
        tasks: dict[str, Callable[[], Any]] = {}
        places: dict[str, tuple[dict[Any, Any], Any]] = {}

        def add(name: str, place: dict[Any, Any], key: Any, task: Any, *given: Any) -> None:
            tasks[name], places[name] = partial(task, *given), (place, key)

        scenarios = self.scenarios.values()
        # The bounds of drawn plants are the longest tasks of all.
        for each in sorted(scenarios, key=lambda each: not each.parameters.ranges):
            add(f"{each.name}: bounds", self.scales, each.name, scale_of, each, self.count)
        long = [agent for agent in LONG if agent in self.controllers]
        agents = dict.fromkeys([*long, *self.controllers])
        for agent, each in itertools.product(agents, scenarios):
            task = run_case, each, agent, self.controllers[agent], self.count
            add(f"{agent}, {each.name}", self.cases, (each.name, agent), *task)
        for each in scenarios:
            add(f"{each.name}: frontier", self.frontiers, each.name, travel_frontier, each)
        for name, result in fan_out.stream(tasks, "compare"):
            place, key = places[name]
            place[key] = result
            if isinstance(result, Case):
                yield result

    @property
    def agents(self) -> list[str]:
        """The controllers that have run on a scenario, in order."""
        return [name for name in self.controllers if any(name == a for _, a in self.cases)]

    @property
    def names(self) -> list[str]:
        """The scenarios that a controller has run on, in order."""
        return [name for name in self.scenarios if any(name == n for n, _ in self.cases)]

    @property
    def runs(self) -> pd.DataFrame:
        """One row for each run, in order, whatever finished first."""
        order = ((name, agent) for agent in self.controllers for name in self.scenarios)
        finished = [self.cases[key].runs for key in order if key in self.cases]
        return pd.concat(finished, ignore_index=True)

    def responses(self, scenario: str) -> pd.DataFrame:
        """Return the responses of all controllers to a scenario."""
        order = ((scenario, agent) for agent in self.controllers)
        finished = [self.cases[key].responses for key in order if key in self.cases]
        return pd.concat(finished, ignore_index=True)
