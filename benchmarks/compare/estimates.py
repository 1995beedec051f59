"""From runs to estimates: how near the limits, how much better than another, how sure."""

from __future__ import annotations

import math
from collections.abc import Mapping

import pandas as pd

from benchmarks.lib.statistics import Estimate, bootstrap, improvement, interquartile_mean
from benchmarks.limits import scenario_limit
from benchmarks.scenarios import Scenario

SEED = 0  # of the bootstraps


def limit_of(scenario: Scenario) -> float:
    """Return the least possible mean |e| of a scenario, degC; NaN if it is not known."""
    try:
        return scenario_limit(scenario).mae
    except ValueError:
        return math.nan


def estimate(runs: pd.DataFrame, limits: Mapping[str, float], reference: str) -> pd.DataFrame:
    """Return one row for each scenario and agent: estimates with 95 % intervals.

    Parameters
    ----------
    runs
        One row a run, with `scenario`, `agent`, `policy`, `seed` and `mae`.
    limits
        The least possible error of each scenario, degC; NaN where it is not known.
    reference
        The agent that the others are compared with, run by run.

    Returns
    -------
    DataFrame
        The mean and the interquartile mean of |e|, degC; the least that is possible; the mean
        as a multiple of that; the mean difference to the reference; and the probability of
        doing better than it. `_low` and `_high` are the ends of intervals.
    """
    rows = []
    for scenario, cases in runs.groupby("scenario", sort=False):
        limit = limits[scenario]
        errors = {
            agent: group.pivot_table(index="policy", columns="seed", values="mae").to_numpy()
            for agent, group in cases.groupby("agent", sort=False)
        }
        base = errors[reference].mean(axis=0) if reference in errors else None
        for agent, values in errors.items():
            mean = bootstrap(values, SEED)
            row = {"scenario": scenario, "agent": agent, "limit": limit, **_ends("mean", mean)}
            iqm = bootstrap(values, SEED, interquartile_mean)
            row |= _ends("interquartile_mean", iqm)
            row |= {f"ratio{end}": row[f"mean{end}"] / limit for end in ("", "_low", "_high")}
            if base is not None and agent != reference:
                row |= _ends("difference", bootstrap(values - base, SEED))
                row |= _ends("improvement", improvement(values, base, SEED))
            rows.append(row)
    return pd.DataFrame(rows)


def _ends(name: str, found: Estimate) -> dict[str, float]:
    return {name: found.value, f"{name}_low": found.low, f"{name}_high": found.high}


def beaten(estimates: pd.DataFrame) -> pd.DataFrame:
    """Return the rows whose mean error lies below the limit, the whole interval included."""
    return estimates[estimates["ratio_high"] < 1.0 - 1e-6]
