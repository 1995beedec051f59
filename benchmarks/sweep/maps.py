"""Draw maps of where controllers work, from the runs of a sweep."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.lines import Line2D

from benchmarks.controllers.roster import label
from benchmarks.lib.drawing import drawn, panels
from benchmarks.lib.tables import groups
from mptc_gym import Parameters

_COLOURS: dict[str, Any] = {"cmap": "cividis_r", "norm": LogNorm(1.0, 4.0)}
_OFTEN = 0.5  # share of a plant's runs from which it is marked
_MARKS: dict[str, dict[str, Any]] = {
    "oscillates": {
        "marker": "o", "markersize": 3.5, "color": "white", "markeredgecolor": "black",
        "label": "oscillates",
    },
    "useless": {
        "marker": "X", "markersize": 8, "color": "red", "markeredgecolor": "white",
        "label": "no better than no control",
    },
}  # fmt: skip
_OF_A_GRID: tuple[dict[str, Any], ...] = (
    {
        "marker": "+", "color": "black", "markersize": 10, "markeredgewidth": 2,
        "label": "the paper's plant",
    },
    {
        "color": "black", "linestyle": ":",
        "label": "above: 5 °C needs a flow within the dead zone",
    },
)  # fmt: skip
_OF_PLANTS: tuple[dict[str, Any], ...] = (
    {"marker": "s", "color": "0.4", "label": "as it is"},
    {"marker": "^", "color": "0.4", "label": "drifts"},
)


def plot_maps(runs: pd.DataFrame, path: Path, *, grid: bool) -> None:
    """Draw a map of each controller's errors over delay and gain.

    On a grid, where only delay and gain differ, it shows the ratio to the limit; on plants that
    differ in everything, the mean error.
    """
    drift = runs.get("gain_drift", pd.Series(np.nan, runs.index))
    largest = runs["gain_factor"] * drift.fillna(1.0).clip(1.0)
    points = _by_plant(runs.assign(gain=largest, drifts=drift.notna()))
    names = [label(agent) for agent in points["agent"].unique()]
    with panels(path, names, (3.4, 3.2), 4, (1.0, 0.6), grid=not grid) as (figure, found):
        for axes, (_, rows) in zip(found, groups(points, "agent"), strict=True):
            for name, mark in _MARKS.items():
                marked = rows[rows[name] >= _OFTEN]
                axes.plot(marked["delay"], marked["gain"], linestyle="", **mark)
            image = _draw_grid(axes, rows) if grid else _draw_plants(axes, rows)
            axes.set_xlabel("delay (samples)")
            axes.set_ylabel(f"{'' if grid else 'largest '}gain (of the paper's)")
        text = "mean |e|, of the least possible" if grid else "mean |e| (°C)"
        bar = figure.colorbar(image, ax=found, label=text, extend="max")
        _tick(bar.set_ticks, [1, 1.25, 1.5, 2, 3, 4])
        bar.ax.minorticks_off()
        marks = [*(_OF_A_GRID if grid else _OF_PLANTS), *_MARKS.values()]
        handles = [Line2D([], [], **{"linestyle": "", **mark}) for mark in marks]
        figure.legend(handles=handles, loc="outside lower center", ncols=4)


def _by_plant(runs: pd.DataFrame) -> pd.DataFrame:
    """Return medians and shares of runs, one row for each controller and plant."""
    runs = runs.assign(**{name: runs[name].astype(float) for name in _MARKS})
    measures = dict.fromkeys(("mae", "ratio"), "median") | dict.fromkeys(_MARKS, "mean")
    firsts = dict.fromkeys(("delay", "gain", "drifts"), "first")
    by = runs.groupby(["agent", "plant"], sort=False)
    return by.agg(measures | firsts).reset_index()


def _draw_grid(axes: Axes, rows: pd.DataFrame) -> Any:
    nominal = Parameters()
    gain = abs(sum(nominal.b) / sum(nominal.a))
    dead_zone, _ = nominal.range_of("dead_zone")
    table = rows.pivot_table(index="gain", columns="delay", values="ratio")
    axes.plot(18, 1.0, "+", color="black", markersize=12, markeredgewidth=2)
    # Above this gain, the flow that 5 degC needs lies in the dead zone.
    axes.axhline(5.0 / (gain * dead_zone), color="black", linestyle=":")
    return axes.pcolormesh(table.columns, table.index, table, shading="nearest", **_COLOURS)


def _draw_plants(axes: Axes, rows: pd.DataFrame) -> Any:
    for drifts, marker in ((False, "s"), (True, "^")):
        some = rows[rows["drifts"] == drifts]
        image = axes.scatter(
            some["delay"], some["gain"], 34, some["mae"], marker=marker, **_COLOURS
        )
    return image


def plot_drift(runs: pd.DataFrame, pair: tuple[str, str], path: Path) -> None:
    """Draw the difference of two controllers' errors over the drift of the gain."""
    drifting = runs[runs["gain_drift"].notna()]
    late = drifting.pivot_table(index=["plant", "run"], columns="agent", values="late")
    if not set(pair) <= set(late.columns):
        return
    difference = (late[pair[0]] - late[pair[1]]).groupby("plant")
    plants = drifting.groupby("plant")[["gain_drift", "delay"]].first()
    with drawn(path, 7.5, 4.5) as figure:
        axes = figure.subplots()
        median = difference.median()
        spread = [median - difference.quantile(0.1), difference.quantile(0.9) - median]
        axes.errorbar(plants["gain_drift"], median, spread, fmt="none", ecolor="0.7", zorder=1)
        image = axes.scatter(
            plants["gain_drift"], median, 30, plants["delay"], cmap="cividis_r", zorder=2
        )
        axes.axhline(0.0, color="black", linewidth=1)
        axes.set_xscale("log")
        axes.set_yscale("symlog", linthresh=0.5)
        _tick(axes.set_xticks, [0.5, 0.7, 1.0, 1.4, 2.0])
        axes.set_xticks([], minor=True)
        _tick(axes.set_yticks, [-2, -1, -0.5, -0.25, 0, 0.25, 0.5, 1, 2])
        axes.set_xlabel("gain at the end, of that at the start")
        ours, theirs = map(label, pair)
        axes.set_ylabel(f"mean |e| of {ours} - that of {theirs} (°C)")
        axes.set_title(
            f"Second half of a run; below 0, {ours} is better.\n"
            "A point a plant: median and 10th to 90th percentile of its runs",
            loc="left",
            fontsize="medium",
        )
        figure.colorbar(image, label="delay (samples)")


def _tick(set_ticks: Any, ticks: Sequence[float]) -> None:
    set_ticks(ticks, labels=[f"{tick:g}" for tick in ticks])
