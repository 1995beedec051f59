"""Counterparts of the paper's figures, drawn from the curves of a typical run."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd
from matplotlib.axes import Axes

from benchmarks.figures.cases import Figure
from benchmarks.lib.drawing import COLOURS, draw_actuator, drawn

_SIGNALS = {
    "output": ("temperature y (°C)", COLOURS[0]),
    "command": ("command u (t/h)", COLOURS[2]),
    "noise": ("noise n (°C)", COLOURS[3]),
}


def plot_figures(
    figures: Sequence[Figure], curves: Mapping[str, pd.DataFrame], path: Path
) -> None:
    """Draw figures of the paper: one, or a sheet of several in two columns.

    Each signal of a figure has axes of its own. The curves are those of `summarise`, by case.
    """
    axes_of = [(figure, signal) for figure in figures for signal in figure.signals]
    columns = min(2, len(figures))
    rows = math.ceil(len(axes_of) / columns)
    size = (8, 3 * rows) if columns == 1 else (13, 2.4 * rows)
    with drawn(path, *size) as sheet:
        grid = sheet.subplots(rows, columns, sharex=True, squeeze=False)
        for axes, (figure, signal) in zip(grid.flat, axes_of, strict=False):
            _draw_signal(axes, figure, signal, curves[figure.case])
        for axes in grid.flat[: len(axes_of)][-columns:]:  # the lowest of each column
            axes.tick_params(labelbottom=True)
            axes.set_xlabel("time (min)")
        for axes in grid.flat[len(axes_of) :]:
            axes.set_visible(False)


def _draw_signal(axes: Axes, figure: Figure, signal: str, curves: pd.DataFrame) -> None:
    minutes = curves["time_s"] / 60
    name, colour = _SIGNALS[signal]
    axes.fill_between(
        minutes, curves[f"{signal}_p10"], curves[f"{signal}_p90"], color=colour, alpha=0.25,
        linewidth=0, label="10th to 90th percentile",
    )  # fmt: skip
    axes.plot(
        minutes, curves[f"{signal}_typical"], color=colour, linewidth=1, label="a typical run"
    )
    if signal == "output":
        axes.step(
            minutes, curves["setpoint"], "k--", linewidth=1, where="post", label="set point"
        )
    if signal == "command":
        draw_actuator(axes, figure.parameters)
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.2 * (high - low))  # room for the legend
    axes.set_xlim(0, minutes.max())
    axes.set_ylabel(name)
    axes.set_title(figure.title, loc="left", fontsize="medium")
    axes.legend(loc="upper right", ncols=3, fontsize="small")
