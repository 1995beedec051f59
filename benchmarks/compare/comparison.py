"""Run controllers in scenarios, and compare their errors with the least possible errors.

A scenario is a plant, a set point and a length of the runs. The error of a run is the mean of
|e|, the absolute error, over the samples of the run.
"""

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

BOOTSTRAP_SEED = 0  # of the resampling for confidence intervals, not of an episode

# By the names of scenario and controller: only controllers that act before a square wave
# changes.
Anticipations = Mapping[tuple[str, str], Anticipation]


@dataclass(frozen=True)
class Result:
    """The results of one controller in one scenario.

    A controller with several trained networks has one member for each network.

    Attributes
    ----------
    scenario : str
        Name of the scenario.
    agent : str
        Name of the controller in options.
    runs : pandas.DataFrame
        A row for each run of each member. The columns are `scenario`, `agent`, `policy` (the
        number of the member), `seed`, and the measures of `benchmarks.loop.rollout.measure`.
    responses : pandas.DataFrame
        A row for each sample, with the temperature and the flow of the first run and their
        percentiles over the runs; see `_responses`.
    policies : sequence of mapping
        The origins of the trained networks, one for each member that was trained.
    seconds : float
        Processor time of the runs, s.
    anticipation : Anticipation, optional
        The errors in surprising runs, if the controller acts before a square wave changes.
    """

    scenario: str
    agent: str
    runs: pd.DataFrame
    responses: pd.DataFrame
    policies: Sequence[Mapping[str, Any]]
    seconds: float
    anticipation: Anticipation | None = None


def run_case(scenario: Scenario, controller: ControllerSpec, runs: int, seed: int) -> Result:
    """Run all members of a controller in a scenario, and return the results.

    If neither the scenario nor the controller uses random numbers, all runs of a member are
    equal. In this case, each member runs once, and the results have a copy of the run for each
    seed.

    Parameters
    ----------
    scenario
        The scenario.
    controller
        The record of the controller.
    runs
        Number of runs of each member.
    seed
        Seed of the first run; run i has the seed `seed + i`.
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
    """Return a table of a controller's temperature and flow over time, one row for each sample.

    The columns are `agent`, `sample`, `time_s` (s), `setpoint` (degC), and four columns each
    for the temperature, `output_...` (degC), and the applied flow, `applied_...` (t/h): `run`
    is the first run, and `median`, `p10` and `p90` are percentiles over all runs of all
    members. If the set points are random, the percentiles are those of the first run.

    Parameters
    ----------
    trajectories
        The signals of a batch of runs for each member of the controller.
    scenario
        The scenario.
    agent
        The name of the controller in options.
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
        # The method "nearest" returns values that occurred: an interpolated percentile of the
        # applied flow could lie in the dead zone.
        for name, percentile in percentiles(values, "nearest").items():
            columns[f"{signal}_{name}"] = percentile
    return pd.DataFrame(columns)


@dataclass(frozen=True)
class Scale:
    """The least possible errors with which a report compares the errors in a scenario.

    Attributes
    ----------
    scenario : Scenario
        The scenario.
    least : LeastPossible
        The least possible error of a controller that does not know future set points.
    preview : float
        The least possible error of a controller that knows all future set points, degC.
    """

    scenario: Scenario
    least: Any
    preview: float


def scale_of(scenario: Scenario, runs: int, seed: int) -> Scale:
    """Return the least possible errors in a scenario, as means over episodes.

    Parameters
    ----------
    scenario
        The scenario.
    runs
        Number of runs. The means are over the episodes of these runs, but at most over
        `EPISODES` episodes.
    seed
        Seed of the first run; run i has the seed `seed + i`.

    Raises
    ------
    ValueError
        If no controller can have a smaller error than an idle valve.
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
    least.score(0.0)  # This raises a ValueError if an idle valve is as good as any controller.
    preview = least_possible(kind="preview", **arguments)
    return Scale(scenario, least, preview.value)


def estimate(
    runs: pd.DataFrame,
    scales: Mapping[str, Scale],
    anticipations: Anticipations = MappingProxyType({}),
) -> pd.DataFrame:
    """Estimate the mean errors and the scores of controllers, with 95 % confidence intervals.

    Parameters
    ----------
    runs : pandas.DataFrame
        A row for each run, with the columns `scenario`, `agent` (the controller), `policy` (the
        number of the member), `seed` and `mae` (the error of the run, degC). The controller in
        the first row is the reference for differences.
    scales : mapping
        The least possible errors of each scenario, by the scenario's name. Other scenarios are
        left out.
    anticipations : mapping
        The anticipation of each controller that acts before a square wave changes.

    Returns
    -------
    pandas.DataFrame
        A row for each scenario and controller, with the columns `scenario`, `agent` and:

        - `limit` and `preview`: the least possible errors without and with knowledge of future
          set points, degC;
        - `mean`: the mean error over the runs, degC, an `Estimate`. If random numbers are used
          and there is only one run, the ends of the interval are infinite;
        - `ratio`: the error ratio, which is `mean` divided by `limit`, an `Estimate`;
        - `scores`: an array with the score of each run, shape (policies, runs). If the
          controller anticipates, the scores are those in surprising runs;
        - `mark`: "‡" if the controller anticipates, and otherwise "";
        - `difference`: the mean over the runs of the error minus the error of the reference in
          the same run, degC, an `Estimate`;
        - `improvement`: the share of the runs in which the error is smaller than the error of
          the reference, an `Estimate`. A run with equal errors counts as half a run.
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
    """Return why controllers do not fit some plant: a sentence by the name of the controller.

    Controllers that fit all plants are left out. `controllers` are records by name, and
    `plants` are the plants of all scenarios.
    """
    misfits: dict[str, str] = {}
    for name, controller in controllers.items():
        for plant in plants:
            reason = controller.misfit(plant)
            if reason:
                misfits.setdefault(name, reason)
    return misfits


def ranked(estimates: pd.DataFrame, misfits: Collection[str] = ()) -> dict[str, Estimate]:
    """Return the overall score of each controller, by name, in the order of the ranking.

    The overall score is the mean score over scenarios, members (the trained networks of a
    controller) and runs. Its 95 % confidence interval is that of `bootstrap`.

    Parameters
    ----------
    estimates
        The table of `estimate`.
    misfits
        The names of controllers that do not fit all plants, which come last.
    """
    scores = {
        str(agent): bootstrap(*tables, seed=BOOTSTRAP_SEED)
        for agent, tables in estimates.groupby("agent", sort=False)["scores"]
    }
    return dict(sorted(scores.items(), key=lambda item: (item[0] in misfits, -item[1].value)))


def summarise(runs: pd.DataFrame) -> pd.DataFrame:
    """Return the percentiles over runs, with a row for each scenario, controller and measure.

    `runs` is a table as in `Result`. The columns of the returned table are `scenario`, `agent`,
    `metric` (the name of the measure), `runs` (their number), `median`, `p10` and `p90`.
    """
    measures = runs.columns.drop(["scenario", "agent", "policy", "seed"])
    rows = []
    for (scenario, agent), group in runs.groupby(["scenario", "agent"], sort=False):
        for name in measures:
            row = {"scenario": scenario, "agent": agent, "metric": name, "runs": len(group)}
            rows.append({**row, **percentiles(group[name].to_numpy())})
    return pd.DataFrame(rows)


def write_numbers(path: Path, table: pd.DataFrame) -> None:
    """Write a table of numbers, texts and objects of class `Estimate` to the CSV file `path`.

    A column of estimates becomes three columns: NAME has the values, and NAME_low and NAME_high
    have the ends of the intervals, with empty cells for infinite ends. Infinity in any other
    column, which is the settling time of a run that does not settle, becomes "not settled".
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
