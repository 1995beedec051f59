"""Draw counterparts of the paper's figures: a typical run, and the spread of all runs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import pandas as pd
from matplotlib.axes import Axes

from benchmarks.lib.drawing import COLOURS, draw_actuator, drawn
from mptc_gym import Parameters

SIGNALS = {
    "output": ("temperature y (°C)", COLOURS[0]),
    "command": ("command u (t/h)", COLOURS[2]),
    "noise": ("noise n (°C)", COLOURS[3]),
}


class Panel(NamedTuple):
    """One signal of a figure."""

    title: str
    signal: str
    curves: pd.DataFrame
    plant: Parameters


def plot(panels: Sequence[Panel], path: Path, columns: int = 1) -> None:
    """Draw the counterpart of one figure, or a sheet of all."""
    rows = math.ceil(len(panels) / columns)
    size = (8, 3 * rows) if columns == 1 else (13, 2.4 * rows)
    with drawn(path, *size) as sheet:
        grid = sheet.subplots(rows, columns, sharex=True, squeeze=False)
        for axes, panel in zip(grid.flat, panels, strict=False):
            _draw(axes, *panel)
        for axes in grid.flat[: len(panels)][-columns:]:  # the lowest of each column
            axes.tick_params(labelbottom=True)
            axes.set_xlabel("time (min)")
        for axes in grid.flat[len(panels) :]:
            axes.set_visible(False)


def _draw(axes: Axes, title: str, signal: str, curves: pd.DataFrame, plant: Parameters) -> None:
    minutes = curves["time_s"] / 60
    name, colour = SIGNALS[signal]
    axes.fill_between(
        minutes, curves[f"{signal}_p10"], curves[f"{signal}_p90"], color=colour, alpha=0.25,
        linewidth=0, label="10th to 90th percentile",
    )  # fmt: skip
    typical = curves[f"{signal}_typical"]
    axes.plot(minutes, typical, color=colour, linewidth=1, label="a typical run")
    if signal == "output":
        axes.step(
            minutes, curves["setpoint"], "k--", linewidth=1, where="post", label="set point"
        )
    if signal == "command":
        draw_actuator(axes, plant)
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.2 * (high - low))  # room for the legend
    axes.set_xlim(0, minutes.max())
    axes.set_ylabel(name)
    axes.set_title(title, loc="left", fontsize="medium")
    axes.legend(loc="upper right", ncols=3, fontsize="small")
