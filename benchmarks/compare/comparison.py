"""Run controllers in scenarios, and compare the errors with the least possible errors.

A scenario is a plant, a set point and a length of the runs. The error of a run is the mean of
|e|, the absolute error, over the samples of the run.
"""

import math
import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from benchmarks.bounds.least import LeastPossible, least_possible
from benchmarks.controllers.roster import ROSTER
from benchmarks.controllers.spec import ControllerSpec
from benchmarks.lib.outputs import write_csv
from benchmarks.lib.statistics import Estimate, bootstrap, percentiles
from benchmarks.loop.rollout import Trajectory, is_random, measure
from benchmarks.loop.scenarios import Scenario
from mptc_gym import Parameters
from mptc_gym.evaluation import EPISODES

BOOTSTRAP_SEED = 0  # seed of the resampling for confidence intervals, not of an episode


@dataclass(frozen=True)
class Result:
    """The results of one controller in one scenario.

    The members of a controller are its trained networks, and each member has its own runs. A
    controller without trained networks has one member.

    Attributes
    ----------
    scenario : str
        Name of the scenario.
    agent : str
        Name of the controller in options, such as "mpc".
    runs : pandas.DataFrame
        Table with a row for each run of each member, and the columns `scenario`, `agent`,
        `policy` (the number of the member), `seed`, and the measures that
        `benchmarks.loop.rollout.measure` returns.
    responses : pandas.DataFrame
        Table of temperature and flow with a row for each sample, from `responses_over_time`.
    policies : sequence of mapping
        Provenance of each member of which a provenance is known, such as a trained network.
    seconds : float
        Processor time of the runs, s.
    """

    scenario: str
    agent: str
    runs: pd.DataFrame
    responses: pd.DataFrame
    policies: Sequence[Mapping[str, Any]]
    seconds: float


def run_case(scenario: Scenario, controller: ControllerSpec, runs: int, seed: int) -> Result:
    """Run all members of a controller in a scenario, and return the results.

    If neither the scenario nor the controller uses random numbers, each member runs only once,
    and the results have a copy of this run for each seed.

    `runs` is the number of runs of each member, and run i has the seed `seed + i`.
    """
    start = time.process_time()
    members = controller.members()
    are_equal = not (controller.random or is_random(scenario.parameters))
    simulated_runs = 1 if are_equal else runs
    trajectories = []
    tables = []
    for number, member in enumerate(members):
        trajectory = member.run(scenario.arguments, scenario.samples, simulated_runs, seed)
        columns: dict[str, Any] = {
            "scenario": scenario.name,
            "agent": controller.name,
            "policy": number,
            "seed": range(seed, seed + runs),
        }
        for name, values in measure(trajectory, scenario.parameters).items():
            columns[name] = np.broadcast_to(values, runs)
        trajectories.append(trajectory)
        tables.append(pd.DataFrame(columns))
    seconds = time.process_time() - start
    return Result(
        scenario=scenario.name,
        agent=controller.name,
        runs=pd.concat(tables, ignore_index=True),
        responses=responses_over_time(trajectories, scenario, controller.name),
        policies=[dict(member.provenance) for member in members if member.provenance],
        seconds=seconds,
    )


def responses_over_time(
    trajectories: Sequence[Trajectory], scenario: Scenario, agent: str
) -> pd.DataFrame:
    """Return a table of a controller's temperature and flow over time, one row for each sample.

    The columns are `agent`, `sample`, `time_s` (s) and `setpoint` (degC); `output_run` (degC)
    and `applied_run` (t/h), the temperature and the applied flow of the first run; and the
    percentiles `output_median`, `output_p10`, `output_p90`, `applied_median`, `applied_p10` and
    `applied_p90` over all runs of all members. If the set points are random, the runs have
    different set points, and the percentiles are the values of the first run.
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
        # The method "nearest" returns a percentile that occurred in a run. An interpolated
        # percentile of the applied flow could lie in the dead zone.
        for name, percentile in percentiles(values, "nearest").items():
            columns[f"{signal}_{name}"] = percentile
    return pd.DataFrame(columns)


@dataclass(frozen=True)
class Scale:
    """The least possible errors in a scenario, with and without known future set points.

    Attributes
    ----------
    scenario : Scenario
    least : LeastPossible
        Least possible error of a controller that does not know future set points.
    preview : float
        Least possible error of a controller that knows all future set points, degC.
    """

    scenario: Scenario
    least: LeastPossible
    preview: float


def scale_of(scenario: Scenario, runs: int, seed: int) -> Scale:
    """Return the least possible errors in a scenario, as means over episodes.

    As least possible errors take long to compute, the means are over the first `runs` episodes,
    but at most over `EPISODES` episodes. Episode i has the seed `seed + i`.

    Raises
    ------
    ValueError
        If the error of an idle valve in `scenario` is not above the least possible error.
    """
    arguments = {
        "samples": scenario.samples,
        "episodes": min(runs, EPISODES),
        "seed": seed,
        **scenario.arguments,
    }
    least = least_possible(**arguments)
    # The method `score` is called only because it raises a ValueError if the error of an idle
    # valve is not above the least possible error. `estimate` computes the scores of
    # controllers.
    least.score(0.0)
    # The kind "preview" is for controllers that know all future set points.
    preview = least_possible(kind="preview", **arguments)
    return Scale(scenario, least, preview.value)


def estimate(runs: pd.DataFrame, scales: Mapping[str, Scale]) -> pd.DataFrame:
    """Estimate the mean errors and the scores of controllers, with 95 % confidence intervals.

    Parameters
    ----------
    runs : pandas.DataFrame
        Table with a row for each run, and the columns `scenario`, `agent` (the controller),
        `policy` (the number of the controller's member), `seed` and `mae` (the mean absolute
        error of the run, degC). The controller in the first row is the reference controller,
        with which all other controllers are compared.
    scales : mapping
        Least possible errors by the name of the scenario. A scenario that is not in `scales` is
        left out of the result.

    Returns
    -------
    pandas.DataFrame
        Table with a row for each scenario and controller, and these columns in addition to
        `scenario` and `agent`:

        - `limit` and `preview`: the least possible errors without and with knowledge of future
          set points, degC;
        - `mean`: the mean error over the runs, degC, an `Estimate`. If runs use random numbers
          and the table has only one run, the ends of the confidence interval are infinite;
        - `ratio`: the error ratio, which is `mean` divided by `limit`, an `Estimate`;
        - `scores`: an array with the score of each run, shape (members, runs);
        - `difference`: the mean over the runs of the controller's error minus the error of the
          reference controller in the same run (the mean over its members), degC, an `Estimate`;
        - `improvement`: the share of the runs in which the controller's error is smaller than
          the error of the reference controller, an `Estimate`. A run in which both controllers
          have equal errors counts as half a run.
    """
    reference = runs["agent"].iloc[0]
    rows = []
    for name, scale in scales.items():
        errors_of = errors_by_agent(runs[runs["scenario"] == name])
        is_noisy = is_random(scale.scenario.parameters)
        for agent, errors in errors_of.items():
            mean = bootstrap(errors, seed=BOOTSTRAP_SEED)
            draws_numbers = agent in ROSTER and ROSTER[agent].random
            if errors.size == 1 and (draws_numbers or is_noisy):
                mean = replace(mean, low=-math.inf, high=math.inf)
            row = {
                "scenario": name,
                "agent": agent,
                "limit": scale.least.value,
                "preview": scale.preview,
                "mean": mean,
                "ratio": mean.scaled(1 / scale.least.value),
                "scores": scale.least.score(errors),
            }
            if agent != reference and reference in errors_of:
                reference_errors = errors_of[reference].mean(axis=0)
                differences = errors - reference_errors
                is_better = (differences < 0.0) + 0.5 * (differences == 0.0)
                row["difference"] = bootstrap(differences, seed=BOOTSTRAP_SEED)
                row["improvement"] = bootstrap(is_better, seed=BOOTSTRAP_SEED)
            rows.append(row)
    return pd.DataFrame(rows)


def errors_by_agent(runs: pd.DataFrame) -> dict[str, NDArray[np.float64]]:
    """Return the errors of each controller, degC, shape (members, runs), by controller name.

    `runs` is a table like `Result.runs`, with the rows of one scenario.
    """
    errors = {}
    for agent, rows in runs.groupby("agent", sort=False):
        table = rows.pivot_table(index="policy", columns="seed", values="mae")
        errors[str(agent)] = table.to_numpy()
    return errors


def misfits_of(
    controllers: Mapping[str, ControllerSpec], plants: Sequence[Parameters]
) -> dict[str, str]:
    """Return a sentence for each controller that does not fit all of `plants`, by its name.

    The sentence says for which other plant the controller was made. If a controller does not
    fit several plants, the sentence gives the reason for the first of these plants.
    """
    misfits: dict[str, str] = {}
    for name, controller in controllers.items():
        reasons = [controller.misfit(plant) for plant in plants]  # "" if the controller fits
        if any(reasons):
            misfits[name] = next(filter(None, reasons))
    return misfits


def ranked(estimates: pd.DataFrame, misfits: Collection[str]) -> dict[str, Estimate]:
    """Return the overall score of each controller by name, the highest score first.

    The overall score is the mean score over all scenarios, members and runs, with the 95 %
    confidence interval of `bootstrap`. The controllers in `misfits`, which do not fit all
    plants, come last in the result.
    """
    scores = {
        str(agent): bootstrap(*tables, seed=BOOTSTRAP_SEED)
        for agent, tables in estimates.groupby("agent", sort=False)["scores"]
    }
    return dict(sorted(scores.items(), key=lambda item: (item[0] in misfits, -item[1].value)))


def summarise(runs: pd.DataFrame) -> pd.DataFrame:
    """Return percentiles over runs of measures such as the mean error and the valve travel.

    The returned table has a row for each scenario, controller and measure, with the columns
    `scenario`, `agent`, `metric` (the name of the measure), `runs` (the number of runs),
    `median`, `p10` and `p90`. The argument `runs` is a table like `Result.runs`.
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

    A column NAME of estimates becomes three columns: NAME has the values, and NAME_low and
    NAME_high have the ends of the confidence intervals. An infinite end of an interval becomes
    an empty cell. The infinite settling time of a run that does not settle becomes "not
    settled".
    """
    columns: dict[Any, Any] = {}
    for name, cells in table.items():
        if any(isinstance(cell, Estimate) for cell in cells):
            for field, suffix in (("value", ""), ("low", "_low"), ("high", "_high")):
                # A cell without an estimate is NaN, which does not have the attribute.
                numbers = pd.Series([getattr(cell, field, math.nan) for cell in cells])
                columns[f"{name}{suffix}"] = numbers.replace([math.inf, -math.inf], math.nan)
        else:
            columns[name] = cells.replace(math.inf, "not settled")
    write_csv(path, pd.DataFrame(columns))
