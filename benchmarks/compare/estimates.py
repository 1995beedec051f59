"""Estimate errors, ratios and scores of controllers from their runs."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from benchmarks.bounds.reference import Reference
from benchmarks.lib.statistics import Estimate, bootstrap, percentiles

BOOTSTRAP_SEED = 0  # seed of the resampling for confidence intervals, not of an episode


def estimate(runs: pd.DataFrame, references: Mapping[str, Reference]) -> pd.DataFrame:
    """Estimate the mean errors and the scores of controllers, with 95 % confidence intervals.

    The confidence intervals of a single run have no width.

    Parameters
    ----------
    runs : pandas.DataFrame
        Table with a row for each run, and the columns `scenario`, `agent` (the controller),
        `policy` (the number of the controller's member), `seed` and `mae` (the mean absolute
        error of the run, degC). The rows of a controller in a scenario are in the order of its
        members, and of their seeds.
    references : mapping
        Reference error of each scenario by name. A scenario that has none is left out of the
        result.

    Returns
    -------
    pandas.DataFrame
        Table with a row for each scenario and controller, and these columns in addition to
        `scenario` and `agent`:

        - `reference`: the reference error, degC;
        - `mean`: the mean error over the runs, degC, an `Estimate`;
        - `ratio`: `mean` divided by `reference`, an `Estimate`;
        - `scores`: an array with the score of each run, shape (members, runs).
    """
    rows = []
    for name, reference in references.items():
        for agent, errors in errors_by_agent(runs[runs["scenario"] == name]).items():
            mean = bootstrap(errors, seed=BOOTSTRAP_SEED)
            row = {
                "scenario": name,
                "agent": agent,
                "reference": reference.value,
                "mean": mean,
                "ratio": mean.scaled(1 / reference.value),
                "scores": reference.score(errors),
            }
            rows.append(row)
    return pd.DataFrame(rows)


def errors_by_agent(runs: pd.DataFrame) -> dict[str, NDArray[np.float64]]:
    """Return the errors of each controller, degC, shape (members, runs), by controller name.

    `runs` is a table with the rows of one scenario.
    """
    return {
        str(agent): rows["mae"].to_numpy().reshape(rows["policy"].nunique(), -1)
        for agent, rows in runs.groupby("agent", sort=False)
    }


def ranked(estimates: pd.DataFrame) -> dict[str, Estimate]:
    """Return the overall score of each controller by name, the highest score first.

    The overall score is the mean score over all scenarios, members and runs, with the 95 %
    confidence interval of `bootstrap`. A controller whose results are missing in a scenario
    comes after those with more scenarios, since their scores cannot be compared.
    """
    scores = {
        str(agent): bootstrap(*tables, seed=BOOTSTRAP_SEED)
        for agent, tables in estimates.groupby("agent", sort=False)["scores"]
    }
    cases = estimates["agent"].value_counts()
    order = sorted(scores, key=lambda agent: (-cases[agent], -scores[agent].value))
    return {agent: scores[agent] for agent in order}


def summarise(runs: pd.DataFrame) -> pd.DataFrame:
    """Return percentiles over runs of measures such as the mean error and the valve travel.

    The returned table has a row for each scenario, controller and measure, with the columns
    `scenario`, `agent`, `metric` (the name of the measure), `runs` (the number of runs of all
    members), `median`, `p10` and `p90`. The argument `runs` is a table with a row for each run.
    The members of a controller are its training runs, numbered in the column `policy` of
    `runs`; a controller that is not trained has one member.
    """
    measures = runs.columns.drop(["scenario", "agent", "policy", "seed"])
    rows = []
    for (scenario, agent), group in runs.groupby(["scenario", "agent"], sort=False):
        for name in measures:
            row = {"scenario": scenario, "agent": agent, "metric": name, "runs": len(group)}
            rows.append({**row, **percentiles(group[name].to_numpy())})
    return pd.DataFrame(rows)


def write_table(path: Path, table: pd.DataFrame) -> None:
    """Write a table of numbers, texts and objects of class `Estimate` to the CSV file `path`.

    A column NAME of estimates becomes three columns: NAME has the values, and NAME_low and
    NAME_high have the ends of the confidence intervals. The infinite settling time of a run
    that does not settle becomes "not settled".
    """
    columns: dict[Any, Any] = {}
    for name, cells in table.items():
        if isinstance(cells.iloc[0], Estimate):  # and so are all cells of the column
            for field, suffix in (("value", ""), ("low", "_low"), ("high", "_high")):
                columns[f"{name}{suffix}"] = [getattr(cell, field) for cell in cells]
        else:
            columns[name] = cells.replace(math.inf, "not settled")
    pd.DataFrame(columns).to_csv(path, index=False)
