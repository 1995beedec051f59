"""Draw the tables of examined claims."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from benchmarks.claims.runs import FIGURES
from benchmarks.lib.drawing import COLOURS, colours, draw_actuator, drawn
from benchmarks.lib.tables import groups
from benchmarks.loop.metrics import METRICS
from mptc_gym import Parameters


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


SIGNALS = {
    "output": ("temperature y (°C)", COLOURS[0]),
    "command": ("command u (t/h)", COLOURS[2]),
    "noise": ("noise n (°C)", COLOURS[3]),
}


def plot_figures(curves: pd.DataFrame, path: Path) -> None:
    """Draw counterparts of Figs 5 to 12: a typical run, and the spread of all runs."""
    panels = [
        (f"Fig. {number}: {case.title}", signal, case)
        for case in FIGURES
        for number, signals in case.figures.items()
        for signal in signals
    ]
    with drawn(path, 13, 2.4 * math.ceil(len(panels) / 2)) as sheet:
        grid = sheet.subplots(math.ceil(len(panels) / 2), 2, sharex=True, squeeze=False)
        for axes, (title, signal, case) in zip(grid.flat, panels, strict=False):
            of_case = curves[curves["case"] == case.title]
            _draw_signal(axes, signal, of_case, Parameters(**case.arguments))
            axes.set_title(title, loc="left", fontsize="medium")
        for axes in grid.flat[: len(panels)][-2:]:  # the lowest of each column
            axes.tick_params(labelbottom=True)
            axes.set_xlabel("time (min)")
        for axes in grid.flat[len(panels) :]:
            axes.set_visible(False)


def _draw_signal(axes: Axes, signal: str, curves: pd.DataFrame, plant: Parameters) -> None:
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
    axes.legend(loc="upper right", ncols=3, fontsize="small")


PLOTS = {
    "convergence": plot_convergence,
    "figures": plot_figures,
    "pi_gains": plot_pi_gains,
    "other_plants": plot_other_plants,
}
