"""Run controllers on scenarios in parallel, and keep the cases that have finished."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import pandas as pd

from benchmarks.compare.estimates import Scale, bounds
from benchmarks.compare.tables import summarise_responses
from benchmarks.controllers.records import Factory
from benchmarks.controllers.roster import ROSTER
from benchmarks.lib.fan_out import FanOut
from benchmarks.loop.metrics import join, mean_error, measure
from benchmarks.loop.scenarios import Scenario
from mptc_gym.evaluation import SEED

TWICE = "square"  # controllers that learn run this scenario again, keeping what they learnt
# Slow controllers start first, so that no core is idle at the end.
LONG = {"mpc", "nn-self-tuning", "ppo", "self-tuning", "nn-smith"}


@dataclass(frozen=True)
class CaseResult:
    """The results of a controller in a scenario."""

    scenario: str
    agent: str
    runs: pd.DataFrame
    """Measures, one row for each run of each member."""
    responses: pd.DataFrame
    """Percentiles over the runs, one row for each sample."""
    again: float | None
    """Mean |e| of a second run that keeps what was learnt, degC, if there was one."""
    seconds: float
    """Duration of the runs, s."""


def run_case(
    scenario: Scenario, agent: str, members: Sequence[Factory], runs: int
) -> CaseResult:
    """Run all members of a controller on a scenario."""
    began = time.perf_counter()
    trajectories, rows, again = [], [], []
    for number, member in enumerate(members):
        controller = member(scenario.arguments, runs, SEED)
        given = scenario.arguments, scenario.samples, runs, SEED, controller
        trajectory = member.run(*given)
        if scenario.name == TWICE:
            # Without learning a second run is the same; a user's own controller may learn.
            learns = member.learns or agent not in ROSTER
            second = member.run(*given) if learns else trajectory
            again.append(float(mean_error(second).mean()))
        trajectories.append(trajectory)
        about = {"scenario": scenario.name, "agent": agent, "policy": number}
        seeds = {**about, "seed": range(SEED, SEED + runs)}
        rows.append(pd.DataFrame({**seeds, **measure(trajectory, scenario.parameters)}))
    return CaseResult(
        scenario.name,
        agent,
        pd.concat(rows, ignore_index=True),
        summarise_responses(join(trajectories), scenario, agent),
        sum(each / len(members) for each in again) if again else None,
        time.perf_counter() - began,
    )


@dataclass
class Comparison:
    """Controllers, scenarios, and their results so far."""

    scenarios: Mapping[str, Scenario]
    controllers: Mapping[str, Sequence[Factory]]
    """The members of each controller."""
    count: int
    """Number of runs of each member: the first episodes of `mptc_gym.evaluate`."""
    cases: dict[tuple[str, str], CaseResult] = field(default_factory=dict)
    """Finished cases, by controller and scenario."""
    scales: dict[str, Scale] = field(default_factory=dict)
    """The bounds that errors are measured against, by scenario."""

    def run(self, fan_out: FanOut) -> Iterator[CaseResult]:
        """Run everything and yield each case as it finishes; raise at the end if any failed."""
        scenarios = self.scenarios.values()
        # The bounds of drawn plants are the longest tasks of all.
        tasks: dict[str, Callable[[], CaseResult | Scale]] = {
            f"{each.name}: bounds": partial(bounds, each, self.count)
            for each in sorted(scenarios, key=lambda each: not each.parameters.ranges)
        }
        agents = sorted(self.controllers, key=lambda agent: agent not in LONG)
        for agent, each in itertools.product(agents, scenarios):
            case = partial(run_case, each, agent, self.controllers[agent], self.count)
            tasks[f"{agent}, {each.name}"] = case
        for _, result in fan_out.stream(tasks, "compare"):
            if isinstance(result, CaseResult):
                self.cases[result.agent, result.scenario] = result
                yield result
            else:
                self.scales[result.scenario] = result

    @property
    def finished(self) -> list[CaseResult]:
        """Finished cases, in the order of controllers and scenarios."""
        order = itertools.product(self.controllers, self.scenarios)
        return [self.cases[key] for key in order if key in self.cases]

    @property
    def agents(self) -> list[str]:
        """Controllers with a finished case, in order."""
        return list(dict.fromkeys(case.agent for case in self.finished))

    @property
    def names(self) -> list[str]:
        """Scenarios with a finished case, in order."""
        run = {name for _, name in self.cases}
        return [name for name in self.scenarios if name in run]

    @property
    def runs(self) -> pd.DataFrame:
        """Measures, one row for each run."""
        return pd.concat([case.runs for case in self.finished], ignore_index=True)
