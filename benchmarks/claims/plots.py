"""Draw the tables of examined claims."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import numpy as np
import pandas as pd

from benchmarks.lib.drawing import COLOURS, colours, drawn
from benchmarks.lib.tables import groups
from benchmarks.loop.metrics import METRICS


def plot_convergence(times: pd.DataFrame, path: Path) -> None:
    """Draw the share of networks that have converged over time, a line for each set point."""
    with drawn(path, 9, 4) as figure:
        axes = figure.subplots()
        for name, colour in colours(list(times.columns)).items():
            finite = times[name].replace(math.inf, np.nan).dropna().sort_values()
            done = 100 * np.arange(1, len(finite) + 1) / len(times)
            axes.step(finite, done, where="post", color=colour, label=name)
        axes.axvline(150, color="0.4", linestyle=":", label="the paper's 150 samples")
        axes.set_xlim(left=0)
        axes.set_ylim(0, 100)
        axes.set_xlabel("samples since the start")
        axes.set_ylabel("weights have converged (% of draws)")
        axes.legend()


def plot_pi_gains(errors: pd.DataFrame, path: Path) -> None:
    """Draw the mean error of PI controllers over Kp, one line for each case."""
    with drawn(path, 9, 4) as figure:
        axes = figure.subplots()
        for (name, rows), colour in zip(groups(errors, "setpoint"), COLOURS, strict=False):
            axes.plot(rows["kp"], rows["mean_error"], ".-", color=colour, label=name)
        axes.set_ylim(bottom=0)
        axes.set_xlabel("Kp (t/h per °C), with the paper's Ki = 0.3")
        axes.set_ylabel(METRICS["mae"])
        axes.legend()


def plot_other_plants(cells: pd.DataFrame, path: Path) -> None:
    """Draw maps of the share of networks that settle over delay and gain, for each case."""
    cases, time_constants = cells["setpoint"].unique(), cells["time_constant"].unique()
    with drawn(path, 10, 2.8 * len(cases), grid=False) as figure:
        panels = figure.subplots(len(cases), len(time_constants), sharex=True, squeeze=False)
        for (i, case), (j, constant) in itertools.product(
            enumerate(cases), enumerate(time_constants)
        ):
            axes = panels[i, j]
            rows = cells[(cells["setpoint"] == case) & (cells["time_constant"] == constant)]
            grid = 100 * rows.pivot_table(index="gain", columns="delay", values="settled")
            image = axes.imshow(
                grid, cmap="cividis", vmin=0, vmax=100, aspect="auto", origin="lower"
            )
            axes.set_xticks(range(len(grid.columns)), grid.columns)
            axes.set_yticks(range(len(grid.index)), grid.index)
            axes.set_title(
                f"{case},\ntime constant x {constant:g}", loc="left", fontsize="medium"
            )
            for place in np.ndindex(grid.shape):
                value = grid.iloc[place]
                shade = "black" if value > 50 else "white"
                axes.text(
                    *reversed(place), f"{value:.0f}", ha="center", va="center", color=shade
                )
        for axes in panels[-1]:
            axes.set_xlabel("delay (samples)")
        for axes in panels[:, 0]:
            axes.set_ylabel("gain (of the paper's)")
        figure.colorbar(image, ax=panels, label="settled (% of draws)")


PLOTS = {
    "convergence": plot_convergence,
    "pi_gains": plot_pi_gains,
    "other_plants": plot_other_plants,
}
