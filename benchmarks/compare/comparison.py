"""Run controllers in scenarios, and estimate how far they are from the least possible error."""

import math
import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.compare.anticipation import Anticipation, anticipation
from benchmarks.controllers.roster import ROSTER
from benchmarks.controllers.spec import ControllerSpec
from benchmarks.lib.statistics import Estimate, bootstrap, percentiles
from benchmarks.lib.storage import write_csv
from benchmarks.loop.rollout import Trajectory, is_random, measure
from benchmarks.loop.scenarios import Scenario
from mptc_gym import Parameters
from mptc_gym.evaluation import EPISODES

BOOTSTRAP_SEED = 0

Anticipations = Mapping[
    tuple[str, str], Anticipation
]  # by the names of scenario and controller


@dataclass(frozen=True)
class Result:
    """The results of a controller in a scenario.

    Attributes
    ----------
    scenario : str
        Name of the scenario.
    agent : str
        Name of the controller.
    runs : pandas.DataFrame
        Measures, with a row for each run of each member of the controller.
    responses : pandas.DataFrame
        Percentiles over the runs, with a row for each sample.
    policies : sequence of mapping
        Provenance of the members that were trained.
    seconds : float
        Processor time of the runs, s.
    anticipation : Anticipation, optional
        What the controller gains and loses by moving before a square wave changes, if it does.
    """

    scenario: str
    agent: str
    runs: pd.DataFrame
    responses: pd.DataFrame
    policies: Sequence[Mapping[str, Any]]
    seconds: float
    anticipation: Anticipation | None = None


def run_case(scenario: Scenario, controller: ControllerSpec, runs: int, seed: int) -> Result:
    """Run all members of a controller in a scenario; run i has the seed `seed + i`.

    If nothing is drawn at random, all runs are equal. Then one run is made, and the results
    have a copy of it for each seed.
    """
    began = time.process_time()
    members = controller.members()
    are_equal = not (controller.random or is_random(scenario.parameters))
    count = 1 if are_equal else runs
    trajectories = [
        member.run(scenario.arguments, scenario.samples, count, seed) for member in members
    ]
    tables = []
    for number, trajectory in enumerate(trajectories):
        columns: dict[str, Any] = {"scenario": scenario.name, "agent": controller.name}
        columns["policy"] = number
        columns["seed"] = range(seed, seed + runs)
        for name, values in measure(trajectory, scenario.parameters).items():
            columns[name] = np.broadcast_to(values, runs)
        tables.append(pd.DataFrame(columns))
    seconds = time.process_time() - began
    return Result(
        scenario.name,
        controller.name,
        pd.concat(tables, ignore_index=True),
        _responses(trajectories, scenario, controller.name),
        [dict(member.provenance) for member in members if member.provenance],
        seconds,
        anticipation(scenario, members, trajectories, runs, seed),
    )


def _responses(
    trajectories: Sequence[Trajectory], scenario: Scenario, agent: str
) -> pd.DataFrame:
    """Return the output and the applied flow over time, with a row for each sample.

    The table has the set point, the first run, and percentiles over all runs of all members.
    `trajectories` has a batch of runs for each member. If the runs differ in their set points,
    the percentiles are those of the first run alone.
    """
    setpoint = trajectories[0].setpoint[:, 0]
    k = np.arange(len(setpoint))
    interval = scenario.parameters.sampling_interval
    columns = {"agent": agent, "sample": k, "time_s": k * interval, "setpoint": setpoint}
    for signal in ("output", "applied"):
        values = np.hstack([getattr(trajectory, signal) for trajectory in trajectories])
        columns[f"{signal}_run"] = values[:, 0]
        if scenario.parameters.setpoint == "random":
            values = values[:, :1]
        # Values that occurred: an interpolated applied flow could lie in the dead zone.
        for name, percentile in percentiles(values, "nearest").items():
            columns[f"{signal}_{name}"] = percentile
    return pd.DataFrame(columns)


@dataclass(frozen=True)
class Scale:
    """The bounds with which the errors in a scenario are compared.

    Attributes
    ----------
    scenario : Scenario
        The scenario.
    least : LeastPossible
        The least possible error, of the kind of bound that applies to the scenario.
    preview : float
        The least possible mean error of a controller that knows all set points in advance,
        degC.
    """

    scenario: Scenario
    least: Any
    preview: float


def scale_of(scenario: Scenario, runs: int, seed: int) -> Scale:
    """Return the bounds on the errors in a scenario: means over the episodes that are run.

    Run i has the seed `seed + i`. An error is raised if no controller can do better than an
    idle valve.
    """
    from benchmarks.bounds.least import (
        least_possible,
    )  # imported here, as SciPy is slow to import

    arguments = {
        "samples": scenario.samples,
        "episodes": min(runs, EPISODES),
        "seed": seed,
        **scenario.arguments,
    }
    least = least_possible(**arguments)
    least.score(0.0)  # This raises the error.
    preview = least_possible(kind="preview", **arguments)
    return Scale(scenario, least, preview.value)


def estimate(
    runs: pd.DataFrame,
    scales: Mapping[str, Scale],
    anticipations: Anticipations = MappingProxyType({}),
) -> pd.DataFrame:
    """Estimate the errors and the scores of controllers, with 95 % confidence intervals.

    Parameters
    ----------
    runs : pandas.DataFrame
        A row for each run, with `scenario`, `agent`, `policy`, `seed` and `mae`. The agent of
        the first row is the reference for the differences.
    scales : mapping
        The scale of each scenario by name. Scenarios without a scale are left out.
    anticipations : mapping
        The anticipations of controllers.

    Returns
    -------
    pandas.DataFrame
        A row for each scenario and agent with these columns:

        - `limit` and `preview`: the least possible errors without and with foresight, degC;
        - `mean`: the mean of |e|, degC, an `Estimate`. If a quantity is random and there is
          only one run, the ends of the interval are infinite;
        - `ratio`: `mean` divided by `limit`, an `Estimate`;
        - `scores`: the scores of the runs, shape (policies, runs). If the controller
          anticipates changes, these are the scores where changes surprise;
        - `mark`: "‡" if the controller anticipates changes, else "";
        - `difference`: the mean difference of |e| from the reference in the same run, degC, an
          `Estimate`;
        - `improvement`: the share of runs with a smaller error than the reference, an
          `Estimate`. An equal error counts as half a run.
    """
    reference = runs["agent"].iloc[0]
    rows = []
    for name, scale in scales.items():
        tables = {}
        for agent, of_agent in runs[runs["scenario"] == name].groupby("agent", sort=False):
            table = of_agent.pivot_table(index="policy", columns="seed", values="mae")
            tables[str(agent)] = table.to_numpy()
        limit = scale.least.value
        for agent, errors in tables.items():
            mean = bootstrap(errors, seed=BOOTSTRAP_SEED)
            is_drawn = agent in ROSTER and ROSTER[agent].random
            if errors.size == 1 and (is_drawn or is_random(scale.scenario.parameters)):
                mean = replace(mean, low=-math.inf, high=math.inf)
            row = {
                "scenario": name,
                "agent": agent,
                "limit": limit,
                "preview": scale.preview,
                "mean": mean,
                "ratio": mean.scaled(1 / limit),
                "scores": scale.least.score(errors),
                "mark": "",
            }
            if (name, agent) in anticipations:
                row["scores"] = anticipations[name, agent].scores
                row["mark"] = "‡"
            if agent != reference and reference in tables:
                reference_errors = tables[reference].mean(axis=0)
                differences = errors - reference_errors
                is_better = (differences < 0.0) + 0.5 * (differences == 0.0)
                row["difference"] = bootstrap(differences, seed=BOOTSTRAP_SEED)
                row["improvement"] = bootstrap(is_better, seed=BOOTSTRAP_SEED)
            rows.append(row)
    return pd.DataFrame(rows)


def misfits_of(
    controllers: Mapping[str, ControllerSpec], plants: Sequence[Parameters]
) -> dict[str, str]:
    """Return the reason, in a sentence, for each controller that does not fit all plants."""
    misfits: dict[str, str] = {}
    for name, controller in controllers.items():
        for plant in plants:
            reason = controller.misfit(plant)
            if reason:
                misfits.setdefault(name, reason)
    return misfits


def ranked(estimates: pd.DataFrame, misfits: Collection[str] = ()) -> dict[str, Estimate]:
    """Return the overall score of each agent, the best agent first and `misfits` last.

    The overall score is the mean over the scenarios. Its 95 % confidence interval resamples
    policies and runs within each scenario.
    """
    scores = {
        str(agent): bootstrap(*tables, seed=BOOTSTRAP_SEED)
        for agent, tables in estimates.groupby("agent", sort=False)["scores"]
    }
    return dict(sorted(scores.items(), key=lambda item: (item[0] in misfits, -item[1].value)))


def summarise(runs: pd.DataFrame) -> pd.DataFrame:
    """Return percentiles over the runs, with a row for each scenario, agent and measure."""
    measures = runs.columns.drop(["scenario", "agent", "policy", "seed"])
    rows = []
    for (scenario, agent), group in runs.groupby(["scenario", "agent"], sort=False):
        for name in measures:
            row = {"scenario": scenario, "agent": agent, "metric": name, "runs": len(group)}
            rows.append({**row, **percentiles(group[name].to_numpy())})
    return pd.DataFrame(rows)


def write_numbers(path: Path, table: pd.DataFrame) -> None:
    """Write a table of numbers, texts and estimates as a CSV file.

    An estimate becomes three columns: its value, and the ends of its interval, which are empty
    if they are unknown. An infinite number, which is a settling time, becomes "not settled".
    """
    columns: dict[Any, Any] = {}
    for name, cells in table.items():
        columns[name] = cells
        if any(isinstance(cell, Estimate) for cell in cells):
            for end, suffix in (("value", ""), ("low", "_low"), ("high", "_high")):
                ends = pd.Series([getattr(cell, end, math.nan) for cell in cells])
                columns[f"{name}{suffix}"] = ends.replace([math.inf, -math.inf], math.nan)
    numbers = pd.DataFrame(columns)
    for name in numbers:
        is_infinite = numbers[name] == math.inf
        if is_infinite.any():
            numbers[name] = numbers[name].astype(object).mask(is_infinite, "not settled")
    write_csv(path, numbers)
