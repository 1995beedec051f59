"""Summarise runs in tables, and format and write them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.compare.estimates import Scale, Score
from benchmarks.controllers.roster import label
from benchmarks.lib.statistics import Estimate
from benchmarks.lib.tables import PERCENTILES, groups, percentiles, write_csv
from benchmarks.loop.metrics import METRICS
from benchmarks.loop.rollout import Trajectory
from benchmarks.loop.scenarios import Scenario

NOT_SETTLED = "not settled"
NO_MEASURE = "not measured"
STEP_METRICS = ("overshoot", "settling_time")  # meaningless in noise


def summarise(runs: pd.DataFrame) -> pd.DataFrame:
    """Return percentiles over the runs, one row for each scenario, agent and metric."""
    return pd.DataFrame(
        [
            {"scenario": scenario, "agent": agent, "metric": metric, "runs": len(group)}
            | percentiles(group[metric].to_numpy())
            for (scenario, agent), group in runs.groupby(["scenario", "agent"], sort=False)
            for metric in METRICS
        ]
    )


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


def write(path: Path, table: pd.DataFrame) -> None:
    """Write a table of numbers, texts and estimates as CSV.

    An estimate becomes three columns: its value and the ends of its interval. Infinite values,
    which apart from these ends are settling times, are written in words.
    """
    columns: dict[Any, Any] = {}
    for name, cells in table.items():
        columns[name] = cells
        if any(isinstance(cell, Estimate) for cell in cells):
            for end, suffix in (("value", ""), ("low", "_low"), ("high", "_high")):
                columns[f"{name}{suffix}"] = [getattr(cell, end, math.nan) for cell in cells]
    flat = pd.DataFrame(columns)
    write_csv(path, flat.astype(object).where(flat != math.inf, NOT_SETTLED))


def ratio_table(estimates: pd.DataFrame, scales: Mapping[str, Scale]) -> pd.DataFrame:
    """Return the least possible errors, and the mean errors as multiples of them."""
    bounds = [{"agent": "least possible (°C)"}, {"agent": "with preview (°C)"}]
    for name, scale in scales.items():
        mark = "*" * (scale.least.kind == "reference")
        bounds[0][name] = f"{scale.least.value:.3f}{mark}"
        bounds[1][name] = f"{scale.preview.value:.3f}"
    table = _by_agent(estimates, estimates["ratio"].map("{:.2f}".format))
    return pd.concat([pd.DataFrame(bounds), table], ignore_index=True)


def score_table(scores: Mapping[str, Score]) -> pd.DataFrame:
    """Return the scores, one row for each agent, the overall score first."""
    rows = [
        {"agent": label(agent), "score": f"{overall:.3f}"}
        | {scenario: f"{mean:.2f}" for scenario, mean in means.items()}
        for agent, (overall, means) in scores.items()
    ]
    return pd.DataFrame(rows).fillna("")  # after an interruption, not all have run


def paired_table(estimates: pd.DataFrame) -> pd.DataFrame:
    """Return differences from the reference, one row for each other agent."""
    others = estimates.dropna(subset=["difference"])
    pairs = zip(others["difference"], others["improvement"], strict=True)
    return _by_agent(
        others, [f"{mean:+.3f}; {100 * better.value:.0f} %" for mean, better in pairs]
    )


def _by_agent(rows: pd.DataFrame, cells: Any) -> pd.DataFrame:
    table = rows.assign(cell=cells).pivot_table(
        index="agent", columns="scenario", values="cell", aggfunc="first", sort=False
    )
    return table.fillna("").rename(index=label).reset_index().rename_axis(columns=None)


def metrics_table(summary: pd.DataFrame, scenarios: Mapping[str, Scenario]) -> pd.DataFrame:
    """Return all metrics, one row for each scenario and agent, one column for each metric."""
    rows = []
    for name, scenario in scenarios.items():
        noisy = scenario.parameters.range_of("noise_variance")[1] > 0.0
        for agent, group in groups(summary[summary["scenario"] == name], "agent"):
            cells = {
                METRICS[row["metric"]]: (
                    "" if noisy and row["metric"] in STEP_METRICS else _median(row)
                )
                for row in group.to_dict("records")
            }
            rows.append({"scenario": name, "agent": label(agent)} | cells)
    return pd.DataFrame(rows)


def _median(row: Mapping[Any, Any]) -> str:
    """Format the median and, where they differ, the 10th and 90th percentiles."""
    form = ".3f" if row["metric"] == "mae" else ",.0f"
    words = {math.inf: NOT_SETTLED}
    median, p10, p90 = (
        NO_MEASURE if math.isnan(row[name]) else words.get(row[name], format(row[name], form))
        for name in PERCENTILES
    )
    return median if p10 == p90 else f"{median} ({p10} to {p90})"
