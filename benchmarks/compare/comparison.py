"""Run controllers on cases, and estimate how far they are from the least possible error."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from benchmarks.controllers.roster import Controller
from benchmarks.lib.statistics import Estimate, bootstrap, groups, improvement, percentiles
from benchmarks.loop.rollout import Trajectory, is_random, join, measure
from benchmarks.loop.scenarios import Scenario
from mptc_gym.evaluation import EPISODES, SEED

Array = NDArray[np.float64]
Score = tuple[Estimate, dict[str, float]]  # overall, and by case

BOOTSTRAP = 0  # seed of the bootstraps


@dataclass(frozen=True)
class Case:
    """The results of a controller in a case."""

    scenario: str
    agent: str
    runs: pd.DataFrame
    """Measures, one row for each run of each member."""
    responses: pd.DataFrame
    """Percentiles over the runs, one row for each sample."""
    policies: Sequence[Mapping[str, Any]]
    """Origin of each member, if it was trained."""
    seconds: float
    """Processor time of the runs, s."""


def run_case(scenario: Scenario, controller: Controller, runs: int) -> Case:
    """Run all members of a controller on a case.

    Where nothing is drawn, all runs are alike: then there is one, and its row is repeated.
    """
    began = time.process_time()
    members = controller.members()
    alike = not (controller.random or is_random(scenario.parameters))
    trajectories, tables = [], []
    for number, member in enumerate(members):
        trajectory = member.run(
            scenario.arguments, scenario.samples, 1 if alike else runs, SEED
        )
        trajectories.append(trajectory)
        measures = measure(trajectory, scenario.parameters)
        about = {"scenario": scenario.name, "agent": controller.name, "policy": number}
        rows = {name: np.broadcast_to(values, runs) for name, values in measures.items()}
        tables.append(pd.DataFrame({**about, "seed": range(SEED, SEED + runs), **rows}))
    return Case(
        scenario.name,
        controller.name,
        pd.concat(tables, ignore_index=True),
        _responses(join(trajectories), scenario, controller.name),
        [dict(each.provenance) for each in members if each.provenance],
        time.process_time() - began,
    )


def _responses(trajectory: Trajectory, scenario: Scenario, agent: str) -> pd.DataFrame:
    """Return the set point and percentiles of y and u_a over the runs, one row per sample.

    If the runs differ in their set points, the first run stands for all.
    """
    if scenario.parameters.setpoint == "random":
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


@dataclass(frozen=True)
class Scale:
    """The bounds that the errors of a case are measured against."""

    scenario: str
    least: Any
    """`LeastPossible`, of the kind "causal", "reference" or "preview" that applies."""
    preview: Any
    """The least possible error of any controller, even with foresight."""
    drawn: bool
    """Whether anything is random, so that runs differ."""


def scale_of(scenario: Scenario, runs: int) -> Scale:
    """Return the bounds on the errors of a case: means over the episodes that are run."""
    from benchmarks.bounds.least import least_possible  # here: SciPy is slow to import

    episodes: dict[str, Any] = {"samples": scenario.samples, "episodes": min(runs, EPISODES)}
    least = least_possible(**episodes, **scenario.arguments)
    least.score(0.0)  # raises an error if nothing is better than no control
    preview = least_possible(kind="preview", **episodes, **scenario.arguments)
    return Scale(scenario.name, least, preview, is_random(scenario.parameters))


def estimate(runs: pd.DataFrame, scale: Scale, reference: str) -> pd.DataFrame:
    """Return estimates for a case with 95 % intervals, one row for each agent.

    They are the `mean` of |e|, degC; `ratio`, the mean as a multiple of `limit`, the least
    possible error that applies; `difference`, the mean paired difference from the reference
    agent; and `improvement`, the probability of doing better than that agent. `preview` is the
    least possible error of any controller. Ends are infinite if runs differ but there is only
    one.
    """
    rows = []
    limit = scale.least.value
    errors = {agent: _errors(group) for agent, group in groups(runs, "agent")}
    base = errors[reference].mean(axis=0) if reference in errors else None
    for agent, values in errors.items():
        mean = bootstrap(values, seed=BOOTSTRAP)
        if scale.drawn and values.size == 1:
            mean = replace(mean, low=-math.inf, high=math.inf)
        ends = {end: getattr(mean, end) / limit for end in ("value", "low", "high")}
        row: dict[str, Any] = {
            "scenario": scale.scenario,
            "agent": agent,
            "limit": limit,
            "preview": scale.preview.value,
            "mean": mean,
            "ratio": replace(mean, **ends),
        }
        if base is not None and agent != reference:
            row["difference"] = bootstrap(values - base, seed=BOOTSTRAP)
            row["improvement"] = improvement(values, base, BOOTSTRAP)
        rows.append(row)
    return pd.DataFrame(rows)


def ranked(runs: pd.DataFrame, scales: Mapping[str, Scale]) -> dict[str, Score]:
    """Return the scores of all agents, the best first: overall, and in each case.

    A run scores 0 for the mean error without control and 1 for the least possible error. The
    score of a case is the mean over its runs, which is the score of `mptc_gym.evaluate`; the
    overall score is the mean over the cases, however hard they are. Its 95 % interval resamples
    policies and runs within each case.
    """
    found: dict[str, Score] = {}
    for agent, of_agent in groups(runs, "agent"):
        tables = {
            scenario: scales[scenario].least.score(_errors(group))
            for scenario, group in groups(of_agent, "scenario")
        }
        overall = bootstrap(*tables.values(), seed=BOOTSTRAP)
        found[agent] = overall, {name: float(table.mean()) for name, table in tables.items()}
    return dict(sorted(found.items(), key=lambda each: -each[1][0].value))


def summarise(runs: pd.DataFrame) -> pd.DataFrame:
    """Return percentiles over the runs, one row for each case, agent and metric."""
    metrics = runs.columns.drop(["scenario", "agent", "policy", "seed"])
    return pd.DataFrame(
        [
            {"scenario": scenario, "agent": agent, "metric": metric, "runs": len(group)}
            | percentiles(group[metric].to_numpy())
            for (scenario, agent), group in runs.groupby(["scenario", "agent"], sort=False)
            for metric in metrics
        ]
    )


def _errors(runs: pd.DataFrame) -> Array:
    """Return the errors of a controller's runs, shape (policies, seeds)."""
    return runs.pivot_table(index="policy", columns="seed", values="mae").to_numpy()
