"""From runs to tables: percentiles over runs, and how they are written."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import pandas as pd

from benchmarks.compare.estimates import Scale
from benchmarks.controllers.roster import label
from benchmarks.lib.statistics import Estimate
from benchmarks.lib.tables import PERCENTILES, percentiles
from benchmarks.loop.metrics import METRICS
from benchmarks.loop.rollout import Trajectory
from benchmarks.loop.scenarios import Scenario

NOT_SETTLED = "not settled"
NO_MEASURE = "not measured"
STEP_METRICS = ("overshoot", "settling_time")  # which mean nothing in noise


def summarise(runs: pd.DataFrame) -> pd.DataFrame:
    """Return one row for each scenario, agent and metric: percentiles over the runs."""
    rows = []
    for (scenario, agent), group in runs.groupby(["scenario", "agent"], sort=False):
        for metric in METRICS:
            row = {"scenario": scenario, "agent": agent, "metric": metric, "runs": len(group)}
            rows.append(row | percentiles(group[metric].to_numpy()))
    return pd.DataFrame(rows)


def summarise_responses(trajectory: Trajectory, scenario: Scenario, agent: str) -> pd.DataFrame:
    """Return the set point and the percentiles of y and u_a over the runs, row by sample.

    Where every run has a set point of its own, the first run stands for all.
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
        # Values that occurred: between those of the applied input may lie the dead zone.
        for name, values in percentiles(getattr(trajectory, signal), "nearest").items():
            columns[f"{signal}_{name}"] = values
    return pd.DataFrame(columns)


def for_csv(table: pd.DataFrame) -> pd.DataFrame:
    """Write infinite values, which only a settling time can have, in words."""
    return table.astype(object).where(table != math.inf, NOT_SETTLED)


def format_cell(row: pd.Series) -> str:
    """Write the median and, where they differ, the 10th and 90th percentile."""
    form = ".3f" if row["metric"] == "mae" else ",.0f"
    words = {math.inf: NOT_SETTLED}
    median, p10, p90 = (
        NO_MEASURE if math.isnan(value) else words.get(value, format(value, form))
        for value in row[[*PERCENTILES]]
    )
    return median if p10 == p90 else f"{median} ({p10} to {p90})"


def ratio_table(estimates: pd.DataFrame, scales: Mapping[str, Scale]) -> pd.DataFrame:
    """Return the mean errors as multiples of the least possible error, and what that is."""
    shown = estimates.apply(lambda row: f"{_ends(row, 'ratio'):.2f}", axis=1)
    table = _by_agent(estimates, shown)
    rows = [
        {"agent": "least possible (°C)"}
        | {
            name: f"{scale.least.value:.3f}" + "*" * (scale.least.kind == "reference")
            for name, scale in scales.items()
        },
        {"agent": "with preview (°C)"}
        | {name: f"{scale.preview.value:.3f}" for name, scale in scales.items()},
    ]
    return pd.concat([pd.DataFrame(rows), table], ignore_index=True)


def score_table(scores: pd.DataFrame) -> pd.DataFrame:
    """Return the scores: a row for each agent, the overall score first."""
    scenarios = [
        n for n in scores.columns if n not in ("agent", "score", "score_low", "score_high")
    ]
    cells = {
        "agent": scores["agent"].map(label),
        "score": scores.apply(lambda row: f"{_ends(row, 'score'):.3f}", axis=1),
    }
    return pd.DataFrame(cells | {name: scores[name].map("{:.2f}".format) for name in scenarios})


def paired_table(estimates: pd.DataFrame) -> pd.DataFrame:
    """Return differences to the reference: a row for each other agent."""
    others = estimates.dropna(subset=["difference"])

    def cell(row: pd.Series) -> str:
        better = f"{100 * row['improvement']:.0f} %"
        return f"{_ends(row, 'difference'):+.3f}; {better}"

    return _by_agent(others, others.apply(cell, axis=1))


def _ends(row: pd.Series, name: str) -> Estimate:
    """Return an estimate that stands in a row with its interval."""
    value, low, high = (float(row[n]) for n in (name, f"{name}_low", f"{name}_high"))
    return Estimate(value, low, high, 1)


def _by_agent(rows: pd.DataFrame, cells: pd.Series) -> pd.DataFrame:
    table = rows.assign(cell=cells).pivot_table(
        index="agent", columns="scenario", values="cell", aggfunc="first", sort=False
    )
    return table.fillna("").rename(index=label).reset_index().rename_axis(columns=None)


def metrics_table(summary: pd.DataFrame, scenarios: Mapping[str, Scenario]) -> pd.DataFrame:
    """Return all metrics: a row for each scenario and agent, a column for each metric."""
    rows = []
    in_order = summary.sort_values(
        "scenario", key=lambda names: names.map(list(scenarios).index), kind="stable"
    )
    for (scenario, agent), group in in_order.groupby(["scenario", "agent"], sort=False):
        noisy = scenarios[str(scenario)].parameters.range_of("noise_variance")[1] > 0.0
        cells = {
            METRICS[row["metric"]]: (
                "" if noisy and row["metric"] in STEP_METRICS else format_cell(row)
            )
            for _, row in group.iterrows()
        }
        rows.append({"scenario": scenario, "agent": label(str(agent))} | cells)
    return pd.DataFrame(rows)
