"""Draw where controllers work, from the runs of a sweep."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.colors import LogNorm

from benchmarks.controllers.roster import label
from benchmarks.lib.drawing import drawn, panels
from benchmarks.lib.tables import groups
from benchmarks.loop.linear import nominal
from mptc_gym import Parameters

# Marker, size, colour and label of plants on which this happens in half the runs or more.
_MARKS = {
    "oscillates": ("o", 12, "white", "oscillates"),
    "useless": ("X", 64, "red", "no better than no control"),
}


def plot_maps(runs: pd.DataFrame, path: Path, *, grid: bool) -> None:
    """Draw a map of each controller's errors over delay and gain, the median of each plant.

    On a grid, where only delay and gain differ, it shows the ratio to the limit; on plants that
    differ in everything, the mean error.
    """
    drift = runs.get("gain_drift", pd.Series(np.nan, runs.index))
    largest = runs["gain_factor"] * drift.fillna(1.0).clip(1.0)
    runs = runs.assign(gain=largest, drifts=drift.notna())
    names = [label(agent) for agent in runs["agent"].unique()]
    with panels(path, names, (3.4, 3.2), 4, (1.0, 0.6), grid=not grid) as (figure, found):
        for axes, (_, cases) in zip(found, groups(runs, "agent"), strict=True):
            plants = cases.groupby("plant")
            where = plants[["delay", "gain", "drifts"]].first()
            errors = plants["ratio" if grid else "mae"].median()
            for drifts, of_kind in where.groupby("drifts"):
                image = axes.scatter(
                    of_kind["delay"], of_kind["gain"], 80 if grid else 34,
                    errors[of_kind.index], marker="^" if drifts else "s", cmap="cividis_r",
                    norm=LogNorm(1.0, 4.0), label="drifts" if drifts else "as it is",
                )  # fmt: skip
            for name, (marker, size, colour, text) in _MARKS.items():
                often = where[plants[name].mean() >= 0.5]
                axes.scatter(
                    often["delay"], often["gain"], size, marker=marker, color=colour,
                    edgecolor="black", linewidth=0.8, label=text,
                )  # fmt: skip
            if grid:
                axes.plot(18, 1.0, "k+", markersize=12, label="the paper's plant")
                # Both the set point and the dead zone are 5.
                edge = 1.0 / abs(nominal(Parameters()).gain)
                text = "above: 5 °C needs a flow within the dead zone"
                axes.axhline(edge, color="black", linestyle=":", label=text)
            axes.set_xlabel("delay (samples)")
            axes.set_ylabel(f"{'' if grid else 'largest '}gain (of the paper's)")
        text = "mean |e|, of the least possible" if grid else "mean |e| (°C)"
        bar = figure.colorbar(image, ax=found, label=text, extend="max", format="{x:g}")
        bar.set_ticks([1, 1.25, 1.5, 2, 3, 4])
        bar.ax.minorticks_off()
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=4)


def plot_drift(runs: pd.DataFrame, pair: tuple[str, str], path: Path) -> None:
    """Draw the difference of two controllers' errors over the drift of the gain."""
    drifting = runs[runs["gain_drift"].notna()]
    late = drifting.pivot_table(index=["plant", "run"], columns="agent", values="late")
    plants = drifting.groupby("plant")[["gain_drift", "delay"]].first()
    difference = (late[pair[0]] - late[pair[1]]).groupby("plant")
    median = difference.median()
    spread = [median - difference.quantile(0.1), difference.quantile(0.9) - median]
    ours, theirs = map(label, pair)
    with drawn(path, 7.5, 4.5) as figure:
        axes = figure.subplots()
        axes.errorbar(plants["gain_drift"], median, spread, fmt="none", ecolor="0.7", zorder=1)
        image = axes.scatter(
            plants["gain_drift"], median, 30, plants["delay"], cmap="cividis_r", zorder=2
        )
        axes.axhline(0.0, color="black", linewidth=1)
        axes.set_yscale("symlog", linthresh=0.5)
        ticks = [-2, -1, -0.5, -0.25, 0, 0.25, 0.5, 1, 2]
        axes.set_yticks(ticks, labels=[f"{tick:g}" for tick in ticks])
        axes.set_xlabel("gain at the end, of that at the start")
        axes.set_ylabel(f"mean |e| of {ours} - that of {theirs} (°C)")
        axes.set_title(
            f"Second half of a run; below 0, {ours} is better.\n"
            "A point a plant: median and 10th to 90th percentile of its runs",
            loc="left",
            fontsize="medium",
        )
        figure.colorbar(image, label="delay (samples)")
