"""Run controllers on scenarios in parallel, and hold their results."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.compare.estimates import Scale, bounds
from benchmarks.controllers.records import Factory
from benchmarks.lib.fan_out import FanOut
from benchmarks.lib.tables import percentiles
from benchmarks.loop.metrics import join, measure
from benchmarks.loop.rollout import Trajectory
from benchmarks.loop.scenarios import Scenario
from mptc_gym.evaluation import SEED


@dataclass(frozen=True)
class CaseResult:
    """The results of a controller in a scenario."""

    scenario: str
    agent: str
    runs: pd.DataFrame
    """Measures, one row for each run of each member."""
    responses: pd.DataFrame
    """Percentiles over the runs, one row for each sample."""
    seconds: float
    """Duration of the runs, s."""


def run_case(
    scenario: Scenario, agent: str, members: Sequence[Factory], runs: int
) -> dict[str, Any]:
    """Run all members of a controller on a scenario; return a `CaseResult` as JSON values."""
    began = time.perf_counter()
    trajectories, rows = [], []
    for number, member in enumerate(members):
        trajectory = member.run(scenario.arguments, scenario.samples, runs, SEED)
        trajectories.append(trajectory)
        about = {"scenario": scenario.name, "agent": agent, "policy": number}
        seeds = {**about, "seed": range(SEED, SEED + runs)}
        rows.append(pd.DataFrame({**seeds, **measure(trajectory, scenario.parameters)}))
    responses = summarise_responses(join(trajectories), scenario, agent)
    return {
        "scenario": scenario.name,
        "agent": agent,
        "runs": pd.concat(rows, ignore_index=True).to_dict("list"),
        "responses": responses.to_dict("list"),
        "seconds": time.perf_counter() - began,
    }


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

    def run(self, fan_out: FanOut) -> None:
        """Run everything, and raise at the end if any case failed; see `FanOut.stream`."""
        # Short tasks last, so that no core waits long at the end; the bounds of drawn plants
        # are the longest of all.
        scenarios = sorted(self.scenarios.values(), key=lambda each: -each.samples)
        tasks: dict[str, Callable[[], dict[str, Any]]] = {
            f"{each.name}: bounds": partial(bounds, each, self.count)
            for each in sorted(scenarios, key=lambda each: not each.parameters.ranges)
        }
        for (agent, members), each in itertools.product(self.controllers.items(), scenarios):
            tasks[f"{agent}, {each.name}"] = partial(run_case, each, agent, members, self.count)
        for _, result in fan_out.stream(tasks, "compare"):
            if "agent" in result:
                frames = {each: pd.DataFrame(result[each]) for each in ("runs", "responses")}
                case = CaseResult(**{**result, **frames})
                self.cases[case.agent, case.scenario] = case
            else:
                self.scales[result["scenario"]] = Scale.of(result)

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


def summarise_responses(trajectory: Trajectory, scenario: Scenario, agent: str) -> pd.DataFrame:
    """Return the set point and percentiles of y and u_a over the runs, one row per sample.

    If the runs differ in their set points, the first run stands for all.
    """
    if (trajectory.setpoint != trajectory.setpoint[:, :1]).any():
        trajectory = Trajectory(*(values[:, :1] for values in vars(trajectory).values()))
    k = np.arange(len(trajectory.setpoint))
    columns = {
        "agent": agent,
        "sample": k,
        "time_s": k * scenario.parameters.sampling_interval,
        "setpoint": trajectory.setpoint[:, 0],
    }
    for signal in ("output", "applied"):
        # Values that occurred: an interpolated applied input could lie in the dead zone.
        for name, values in percentiles(getattr(trajectory, signal), "nearest").items():
            columns[f"{signal}_{name}"] = values
    return pd.DataFrame(columns)
