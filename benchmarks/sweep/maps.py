"""Draw where controllers work, from the runs of a sweep."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.colors import LogNorm

from benchmarks.controllers.roster import label
from benchmarks.lib.drawing import MULTIPLE, draw_legend, drawn, panels, scale_by_excess
from benchmarks.lib.tables import groups
from benchmarks.loop.linear import nominal
from mptc_gym import Parameters

# Marker, size, colour and label of plants on which this happens in half the runs or more.
_MARKS = {
    "oscillates": ("o", 12, "white", "oscillates"),
    "useless": ("X", 64, "red", "no better than no control"),
}


def plot_maps(runs: pd.DataFrame, path: Path, centre: Parameters | None) -> None:
    """Draw a map of each controller's errors over delay and gain, the median of each plant.

    Errors are multiples of the least possible. `centre` is the plant around which the others
    are, if they are a grid: then only delay and gain differ, and the map marks it.
    """
    grid = centre is not None
    drift = runs.get("gain_drift", pd.Series(np.nan, runs.index))
    largest = runs["gain_factor"] * drift.fillna(1.0).clip(1.0)
    runs = runs.assign(gain=largest, drifts=drift.notna())
    names = [label(agent) for agent in runs["agent"].unique()]
    ratios = runs.groupby(["agent", "plant"], sort=False)["ratio"].median()
    best = str(ratios.groupby("agent").median().idxmin())
    title = (
        f"{label(best)} comes closest to the least possible error: "
        f"{ratios[best].median():.2f} times in the median plant"
    )
    with panels(path, names, 2.3, 3, title, grid=not grid) as (figure, found, free):
        for axes, (_, cases) in zip(found, groups(runs, "agent"), strict=True):
            plants = cases.groupby("plant")
            where = plants[["delay", "gain", "drifts"]].first()
            excess = plants["ratio"].median().sub(1.0).clip(0.01)
            for drifts, of_kind in where.groupby("drifts"):
                image = axes.scatter(
                    of_kind["delay"], of_kind["gain"], 26 if grid else 14,
                    excess[of_kind.index], marker="^" if drifts else "s", cmap="cividis_r",
                    norm=LogNorm(0.01, 3.0), label="drifts" if drifts else "as it is",
                )  # fmt: skip
            for name, (marker, size, colour, text) in _MARKS.items():
                often = where[plants[name].mean() >= 0.5]
                axes.scatter(
                    often["delay"], often["gain"], size, marker=marker, color=colour,
                    edgecolor="black", linewidth=0.8, label=text,
                )  # fmt: skip
            if centre is not None:
                delay, factor, zone = (
                    sum(centre.range_of(name)) / 2.0
                    for name in ("delay", "gain_factor", "dead_zone")
                )
                text = "the paper's plant" if centre == Parameters() else "the nominal plant"
                axes.plot(delay, factor, "k+", markersize=12, label=text)
                # The gain at which the least effective flow makes a set point.
                degrees = centre.setpoint_amplitude
                edge = factor * degrees / max(zone * abs(nominal(centre).gain), 1e-9)
                text = f"above: {degrees:g} °C is within the dead zone"
                if edge <= where["gain"].max():
                    axes.axhline(edge, color="black", linestyle=":", label=text)
        for axes in found[-3:]:
            axes.set_xlabel("delay (samples)")
        figure.supylabel("gain factor" if grid else "largest gain factor", fontsize="medium")
        bar = figure.colorbar(
            image, ax=found, label=MULTIPLE, extend="both", location="bottom", aspect=60,
        )  # fmt: skip
        scale_by_excess(bar.ax, "x", 0.013, 3.0 / 1.3)
        draw_legend(
            figure, free, dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
        )


def plot_drift(runs: pd.DataFrame, pair: tuple[str, str], path: Path) -> None:
    """Draw the difference of two controllers' errors over the drift of the gain."""
    drifting = runs[runs["gain_drift"].notna()]
    late = drifting.pivot_table(index=["plant", "run"], columns="agent", values="late")
    plants = drifting.groupby("plant")[["gain_drift", "delay"]].first()
    difference = (late[pair[0]] - late[pair[1]]).groupby("plant")
    median = difference.median()
    spread = [median - difference.quantile(0.1), difference.quantile(0.9) - median]
    ours, theirs = map(label, pair)
    better = (median < 0.0).sum()
    title = f"{ours} is better than {theirs} on {better} of {len(median)} plants that drift"
    with drawn(path, 4.2, title) as figure:
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
        axes.set_ylabel(
            f"mean |e| of {ours} - that of {theirs}\n(°C, linear within ±0.5, then log)"
        )
        axes.set_title(
            "Second half of a run; a point a plant: median, 10th to 90th percentile of its runs"
        )
        figure.colorbar(image, label="delay (samples)")
