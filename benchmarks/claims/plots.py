"""Draw the tables of examined claims."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from benchmarks.claims.runs import FIGURES
from benchmarks.lib.drawing import COLOURS, colours, draw_actuator, draw_legend, drawn, panels
from benchmarks.lib.tables import groups
from benchmarks.loop.metrics import METRICS
from mptc_gym import Parameters


def plot_convergence(times: pd.DataFrame, path: Path) -> None:
    """Draw the share of networks that have converged over time, a line for each set point."""
    shares = ", ".join(
        f"{100 * (each <= 150).mean():.0f} % ({name})" for name, each in times.items()
    )
    title = f"Weights that have converged within the paper's 150 samples: {shares}"
    with drawn(path, 3.6, title) as figure:
        axes = figure.subplots()
        for name, colour in colours(list(times.columns)).items():
            finite = times[name].replace(math.inf, np.nan).dropna().sort_values()
            done = 100 * np.arange(1, len(finite) + 1) / len(times)
            axes.step(finite, done, where="post", color=colour, label=name)
        axes.axvline(150, color="0.4", linestyle=":", label="the paper's 150 samples")
        axes.set_xlim(left=0)
        axes.set_ylim(0, 100)
        axes.set_xlabel("samples since the start")
        axes.set_ylabel("weights have converged (% of runs)")
        axes.legend()


def plot_pi_gains(errors: pd.DataFrame, path: Path) -> None:
    """Draw the mean error of PI controllers over Kp, one line for each case."""
    least = errors.groupby("setpoint", sort=False)["mean_error"].min()
    each = ", ".join(f"{error:.2f} °C ({name})" for name, error in least.items())
    title = f"With the paper's Ki no Kp brings the mean error below {each}"
    with drawn(path, 3.6, title) as figure:
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
    share = (cells["settled"] >= 0.9).mean()
    title = f"At least 90 % of the networks settle on {100 * share:.0f} % of the plants"
    with drawn(path, 2.3 * len(cases), title, grid=False) as figure:
        maps = figure.subplots(len(cases), len(time_constants), sharex=True, squeeze=False)
        for (i, case), (j, constant) in itertools.product(
            enumerate(cases), enumerate(time_constants)
        ):
            axes = maps[i, j]
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
        for axes in maps[-1]:
            axes.set_xlabel("delay (samples)")
        for axes in maps[:, 0]:
            axes.set_ylabel("gain (of the paper's)")
        figure.colorbar(image, ax=maps, label="settled (% of runs)")


SIGNALS = {
    "output": ("temperature y (°C)", COLOURS[0]),
    "command": ("command u (t/h)", COLOURS[2]),
    "noise": ("noise n (°C)", COLOURS[3]),
}


def plot_figures(curves: pd.DataFrame, path: Path) -> None:
    """Draw counterparts of Figs 5 to 12: a typical run, and the spread of all runs."""
    signals = [
        (f"Fig. {number}: {case.title}", signal, case)
        for case in FIGURES
        for number, signals in case.figures.items()
        for signal in signals
    ]
    title = "The network settles without noise; the paper's PI oscillates"
    with panels(path, [each[0] for each in signals], 1.7, 2, title) as (sheet, found, free):
        entries: dict[str, Any] = {}
        for axes, (_, signal, case) in zip(found, signals, strict=True):
            of_case = curves[curves["case"] == case.title]
            _draw_signal(axes, signal, of_case, Parameters(**case.arguments))
            handles, names = axes.get_legend_handles_labels()
            entries = dict(zip(names, handles, strict=True)) | entries
        for axes in found[-2:]:  # the lowest of each column
            axes.set_xlabel("time (min)")
        draw_legend(sheet, free, entries)


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
    axes.set_xlim(0, minutes.max())
    axes.set_ylabel(name)


PLOTS = {
    "convergence": plot_convergence,
    "figures": plot_figures,
    "pi_gains": plot_pi_gains,
    "other_plants": plot_other_plants,
}
