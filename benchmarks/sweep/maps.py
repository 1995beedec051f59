"""Maps of where controllers work, drawn from the runs of a sweep."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from benchmarks.controllers.roster import label
from benchmarks.lib.drawing import drawn
from mptc_gym import Parameters

_COLUMNS = 4
_COLOURS: dict[str, Any] = {"cmap": "cividis_r", "norm": LogNorm(1.0, 4.0)}
_OFTEN = 0.5  # a plant is marked from this share of its runs on
_MARKS = {
    name: Line2D(
        [],
        [],
        linestyle="",
        marker=marker,
        markersize=size,
        color=colour,
        markeredgecolor=edge,
        label=text,
    )
    for name, marker, size, colour, edge, text in (
        ("oscillates", "o", 3.5, "white", "black", "oscillates"),
        ("useless", "X", 8, "red", "white", "no better than no control"),
    )
}


def plot_grid(runs: pd.DataFrame, path: Path) -> None:
    """Draw the ratio to the limit over delay and gain, a map for each controller.

    Parameters
    ----------
    runs
        One row for each run of a sweep over a grid.
    path
        The PNG file to write.
    """
    points = _by_plant(runs, ["delay", "gain_factor"])
    nominal = Parameters()
    gain = abs(sum(nominal.b) / sum(nominal.a))
    dead_zone, _ = nominal.range_of("dead_zone")
    with _panels(path, points, grid=False) as (figure, panels):
        for axes, (_, rows) in zip(panels, points.groupby("agent", sort=False), strict=False):
            table = rows.pivot_table(index="gain_factor", columns="delay", values="ratio")
            image = axes.pcolormesh(
                table.columns, table.index, table, shading="nearest", **_COLOURS
            )
            for name, mark in _MARKS.items():
                marked = rows[rows[name] >= _OFTEN]
                _scatter(axes, mark, marked["delay"], marked["gain_factor"])
            axes.plot(18, 1.0, "+", color="black", markersize=12, markeredgewidth=2)
            # From here on, the flow that 5 degC needs lies in the dead zone.
            axes.axhline(5.0 / (gain * dead_zone), color="black", linestyle=":")
            axes.set_xlabel("delay (samples)")
            axes.set_ylabel("gain (of the paper's)")
        plant = Line2D([], [], marker="+", linestyle="", color="black", markersize=10,
                       markeredgewidth=2, label="the paper's plant")  # fmt: skip
        line = Line2D([], [], color="black", linestyle=":",
                      label="above: 5 °C needs a flow within the dead zone")  # fmt: skip
        _finish(figure, panels, image, "mean |e|, of the least possible", [plant, line])


def plot_plants(runs: pd.DataFrame, path: Path) -> None:
    """Draw the mean error on plants that differ in everything, over delay and gain.

    Parameters
    ----------
    runs
        One row for each run of a sweep over a random design.
    path
        The PNG file to write.
    """
    runs = runs.assign(largest=runs["gain_factor"] * runs["gain_drift"].fillna(1.0).clip(1.0))
    points = _by_plant(runs, ["delay", "largest", "gain_drift"])
    with _panels(path, points) as (figure, panels):
        for axes, (_, rows) in zip(panels, points.groupby("agent", sort=False), strict=False):
            for drifts, marker in ((False, "s"), (True, "^")):
                some = rows[rows["gain_drift"].notna() == drifts]
                image = axes.scatter(
                    some["delay"], some["largest"], 34, some["mae"], marker=marker, **_COLOURS
                )
            for name, mark in _MARKS.items():
                marked = rows[rows[name] >= _OFTEN]
                _scatter(axes, mark, marked["delay"], marked["largest"])
            axes.set_xlabel("delay (samples)")
            axes.set_ylabel("largest gain (of the paper's)")
        kinds = [
            Line2D([], [], marker=marker, linestyle="", color="0.4", label=text)
            for marker, text in (("s", "as it is"), ("^", "drifts"))
        ]
        _finish(figure, panels, image, "mean |e| (°C)", kinds)


def plot_drift(runs: pd.DataFrame, pair: tuple[str, str], path: Path) -> None:
    """Draw how much smaller the error of one controller is, over the drift of the gain.

    Parameters
    ----------
    runs
        One row for each run of a sweep over a random design.
    pair
        Names of the two.
    path
        The PNG file to write.
    """
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
        axes.set_xticks([0.5, 0.7, 1.0, 1.4, 2.0], ["0.5", "0.7", "1", "1.4", "2"])
        axes.set_xticks([], minor=True)
        axes.set_yscale("symlog", linthresh=0.5)
        ticks = [-2, -1, -0.5, -0.25, 0, 0.25, 0.5, 1, 2]
        axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
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


def _by_plant(runs: pd.DataFrame, plant: list[str]) -> pd.DataFrame:
    """Return one row for each controller and plant: medians, and shares of runs."""
    runs = runs.assign(**{name: runs[name].astype(float) for name in _MARKS})
    measures = dict.fromkeys(("mae", "ratio"), "median") | dict.fromkeys(_MARKS, "mean")
    firsts = dict.fromkeys(plant, "first")
    by = runs.groupby(["agent", "plant"], sort=False)
    return by.agg(measures | firsts).reset_index()


@contextmanager
def _panels(
    path: Path, points: pd.DataFrame, *, grid: bool = True
) -> Iterator[tuple[Figure, list[Axes]]]:
    """Give a figure with a panel for each controller, and write it."""
    agents = points["agent"].unique()
    rows = math.ceil(len(agents) / _COLUMNS)
    columns = min(_COLUMNS, len(agents))
    with drawn(path, 3.4 * columns + 1, 3.2 * rows + 0.6, grid=grid) as figure:
        panels = list(figure.subplots(rows, columns, squeeze=False).flat)
        for axes, agent in zip(panels, agents, strict=False):
            axes.set_title(label(agent), loc="left")
        for axes in panels[len(agents) :]:
            axes.set_axis_off()
        yield figure, panels[: len(agents)]


def _scatter(axes: Axes, mark: Line2D, x: pd.Series, y: pd.Series) -> None:
    axes.plot(
        x, y, linestyle="", marker=mark.get_marker(), color=mark.get_color(),
        markeredgecolor=mark.get_markeredgecolor(), markersize=mark.get_markersize(),
    )  # fmt: skip


def _finish(
    figure: Figure, panels: list[Axes], image: Any, text: str, handles: list[Line2D]
) -> None:
    ticks = [1, 1.25, 1.5, 2, 3, 4]
    bar = figure.colorbar(image, ax=panels, label=text, extend="max", ticks=ticks)
    bar.ax.set_yticklabels([f"{tick:g}" for tick in ticks])
    bar.ax.minorticks_off()
    figure.legend(handles=[*handles, *_MARKS.values()], loc="outside lower center", ncols=4)
