"""From runs to tables: percentiles over runs, and how they are written."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.table import Table

from benchmarks.metrics import METRICS
from benchmarks.rollout import Trajectory
from benchmarks.roster import label
from benchmarks.scenarios import SCENARIOS, Scenario

NOT_SETTLED = "not settled"
PERCENTILES = {"median": 50, "p10": 10, "p90": 90}


def percentiles(values: NDArray[np.float64], method: str = "linear") -> dict[str, Any]:
    """Return median, 10th and 90th percentile along the last axis.

    Where a value is infinite ('not settled'), nothing can be interpolated; the next higher of
    the values is taken instead.
    """
    method = method if np.isfinite(values).all() else "higher"
    return {
        name: np.percentile(values, percentile, axis=-1, method=method)
        for name, percentile in PERCENTILES.items()
    }


def summarise(runs: pd.DataFrame) -> pd.DataFrame:
    """Return one row for each scenario, agent and metric: percentiles over the runs."""
    rows = []
    for (scenario, agent), group in runs.groupby(["scenario", "agent"], sort=False):
        for metric in METRICS:
            row = {"scenario": scenario, "agent": agent, "metric": metric, "runs": len(group)}
            rows.append(row | percentiles(group[metric].to_numpy()))
    return pd.DataFrame(rows)


def summarise_responses(trajectory: Trajectory, scenario: Scenario, agent: str) -> pd.DataFrame:
    """Return one row a sample: the set point, and percentiles of y and u_a over the runs."""
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


def format_value(metric: str, value: float) -> str:
    """Write one value of a metric as people read it."""
    if math.isinf(value):
        return NOT_SETTLED
    return f"{value:.3f}" if metric == "mae" else f"{value:,.0f}"


def format_cell(row: pd.Series) -> str:
    """Write the median and, where they differ, the 10th and 90th percentile."""
    median, p10, p90 = (format_value(row["metric"], row[name]) for name in PERCENTILES)
    return median if p10 == p90 else f"{median} ({p10} to {p90})"


def format_median(row: pd.Series) -> str:
    """Write the median alone."""
    return format_value(row["metric"], row["median"])


def mae_table(summary: pd.DataFrame) -> pd.DataFrame:
    """Return the mean absolute errors: a row for each agent, a column for each scenario."""
    rows = summary[summary["metric"] == "mae"]
    return _by_agent(rows, rows.apply(format_cell, axis=1))


def ratio_table(estimates: pd.DataFrame) -> pd.DataFrame:
    """Return the mean errors as multiples of the least possible, and what that is."""
    table = _by_agent(estimates, estimates.apply(_format_ends, axis=1, name="ratio"))
    limits = estimates.drop_duplicates("scenario").set_index("scenario")["limit"]
    least = {"agent": "least possible (°C)"} | limits.map("{:.3f}".format).to_dict()
    return pd.concat([pd.DataFrame([least]), table], ignore_index=True)


def paired_table(estimates: pd.DataFrame) -> pd.DataFrame:
    """Return differences to the reference: a row for each other agent."""
    others = estimates.dropna(subset=["difference"])

    def cell(row: pd.Series) -> str:
        better = f"{100 * row['improvement']:.0f} %"
        return f"{_format_ends(row, 'difference', '+.3f')}; {better}"

    return _by_agent(others, others.apply(cell, axis=1))


def _format_ends(row: pd.Series, name: str, form: str = ".2f") -> str:
    value, low, high = (format(row[n], form) for n in (name, f"{name}_low", f"{name}_high"))
    return value if low == high else f"{value} ({low} to {high})"


def _by_agent(rows: pd.DataFrame, cells: pd.Series) -> pd.DataFrame:
    table = rows.assign(cell=cells).pivot_table(
        index="agent", columns="scenario", values="cell", aggfunc="first", sort=False
    )
    return table.fillna("").rename(index=label).reset_index().rename_axis(columns=None)


def metrics_table(
    summary: pd.DataFrame, format_row: Callable[[pd.Series], str] = format_cell
) -> pd.DataFrame:
    """Return all other metrics: a row for each scenario and agent, a column for each metric."""
    rows = []
    others = summary[summary["metric"] != "mae"].sort_values(
        "scenario", key=lambda names: names.map(list(SCENARIOS).index), kind="stable"
    )
    for (scenario, agent), group in others.groupby(["scenario", "agent"], sort=False):
        cells = {METRICS[row["metric"]]: format_row(row) for _, row in group.iterrows()}
        rows.append({"scenario": scenario, "agent": label(agent)} | cells)
    return pd.DataFrame(rows)


def on_screen(table: pd.DataFrame) -> Table:
    """Return a table for the terminal."""
    screen = Table(box=SIMPLE_HEAD)
    for name in table.columns:
        is_name = name in ("scenario", "agent", "case")
        is_text = is_name or name in ("claim", "verdict")
        screen.add_column(name, justify="left" if is_text else "right", no_wrap=is_name)
    for row in table.itertuples(index=False):
        screen.add_row(*row)
    return screen
