"""Pictures of a comparison, drawn from the tables that it writes."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.metrics import METRICS
from benchmarks.roster import label
from benchmarks.scenarios import Scenario
from benchmarks.storage import replacing
from mptc_gym import Parameters

# Okabe and Ito's colours, which colour-blind readers can tell apart.
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
STYLE = {
    "axes.grid": True,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "figure.constrained_layout.use": True,
    "figure.dpi": 110,
    "grid.alpha": 0.3,
    "legend.frameon": False,
}


def colours(agents: list[str]) -> dict[str, str]:
    """Give each agent a colour; the same agents in the same order get the same ones."""
    return {agent: _COLOURS[i % len(_COLOURS)] for i, agent in enumerate(agents)}


def plot_responses(responses: pd.DataFrame, scenario: Scenario, path: Path) -> None:
    """Draw set point, output and applied input of every agent over time.

    Parameters
    ----------
    responses
        Rows as `tables.summarise_responses` makes them, of all agents.
    scenario
        What was run.
    path
        The PNG file to write.
    """
    parameters = scenario.parameters
    palette = colours(list(responses["agent"].unique()))
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9, 6))
        above, below = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": [3, 2]})
        for agent, rows in responses.groupby("agent", sort=False):
            _band(above, rows, "output", palette[agent], label(agent))
            _band(below, rows, "applied", palette[agent], label(agent))
        minutes = rows["time_s"] / 60
        above.step(
            minutes, rows["setpoint"], "k--", linewidth=1, where="post", label="set point"
        )
        above.set_ylabel("temperature y (°C)")
        above.set_title(scenario.title, loc="left")
        above.legend(loc="upper right", ncols=len(palette) + 1)
        low, high = above.get_ylim()
        above.set_ylim(low, high + 0.15 * (high - low))  # room for the legend
        below.axhspan(
            -parameters.dead_zone, parameters.dead_zone, color="0.5", alpha=0.15, linewidth=0
        )
        below.text(
            1.005, 0.5, "dead\nzone", transform=below.transAxes, va="center", color="0.4"
        )
        for limit in (parameters.u_min, parameters.u_max):
            below.axhline(limit, color="0.4", linestyle=":", linewidth=1)
        below.set_ylabel("applied flow u_a (t/h)")
        below.set_xlabel("time (min)")
        below.set_xlim(0, minutes.max())
        save(figure, path)


def _band(axes: Axes, rows: pd.DataFrame, signal: str, colour: str, name: str) -> None:
    minutes = rows["time_s"] / 60
    step = "post" if signal == "applied" else None
    axes.fill_between(
        minutes, rows[f"{signal}_p10"], rows[f"{signal}_p90"], step=step,
        color=colour, alpha=0.2, linewidth=0,
    )  # fmt: skip
    drawstyle = "steps-post" if step else "default"
    axes.plot(
        minutes, rows[f"{signal}_median"], color=colour, linewidth=1.2, drawstyle=drawstyle,
        label=name,
    )  # fmt: skip


def plot_limits(estimates: pd.DataFrame, path: Path) -> None:
    """Draw the mean errors as points with 95 % intervals; each axis begins at the limit."""
    with mpl.rc_context(STYLE):
        figure, panels = _scenario_panels(estimates)
        shades = colours(list(estimates["agent"].unique()))
        by_scenario = estimates.groupby("scenario", sort=False)
        for axes, (_, rows) in zip(panels, by_scenario, strict=True):
            for place, (_, row) in enumerate(rows.iterrows()):
                ends = [[row["mean"] - row["mean_low"]], [row["mean_high"] - row["mean"]]]
                colour = shades[row["agent"]]
                axes.errorbar(row["mean"], place, xerr=ends, fmt="o", capsize=3, color=colour)
            axes.set_yticks(range(len(rows)), [label(agent) for agent in rows["agent"]])
            axes.invert_yaxis()
            limit, worst = rows["limit"].iloc[0], rows["mean_high"].max()
            # A little to the left of it, so that a point on the limit is whole.
            axes.axvline(limit, color="0.4", linewidth=1)
            axes.set_xlim(limit - 0.02 * (worst - limit), worst + 0.05 * (worst - limit) + 1e-3)
            axes.set_xlabel("mean |e| (°C), from the least possible on")
        save(figure, path)


def plot_runs(runs: pd.DataFrame, path: Path) -> None:
    """Draw the mean error of every single run, so that no failure is averaged away."""
    generator = np.random.default_rng(0)  # scatters points that would hide each other
    with mpl.rc_context(STYLE):
        figure, panels = _scenario_panels(runs)
        shades = colours(list(runs["agent"].unique()))
        for axes, (_, cases) in zip(panels, runs.groupby("scenario", sort=False), strict=True):
            agents = list(cases["agent"].unique())
            for place, agent in enumerate(agents):
                errors = cases.loc[cases["agent"] == agent, "mae"]
                around = place + generator.uniform(-0.3, 0.3, len(errors))
                axes.plot(errors, around, ".", markersize=3, alpha=0.4, color=shades[agent])
            axes.set_yticks(range(len(agents)), [label(agent) for agent in agents])
            axes.invert_yaxis()
            axes.set_xlim(left=0)
            axes.set_xlabel("mean |e| of a run (°C)")
        save(figure, path)


def _scenario_panels(rows: pd.DataFrame) -> tuple[Figure, list[Axes]]:
    names = rows["scenario"].unique()
    columns = min(3, len(names))
    height = 1.2 + 0.28 * rows["agent"].nunique()
    lines = math.ceil(len(names) / columns)
    figure = Figure(figsize=(4.2 * columns, height * lines))
    panels = list(figure.subplots(lines, columns, squeeze=False).flat)
    for axes, name in zip(panels, names, strict=False):
        axes.set_title(name, loc="left")
    for axes in panels[len(names) :]:
        axes.set_visible(False)
    return figure, panels[: len(names)]


def plot_learning(curves: pd.DataFrame, path: Path) -> None:
    """Draw PPO's learning curves: mean |e| over samples of experience, for each policy."""
    shown = {
        "training_mae": "training: random set points, exploring",
        "validation_mae": "validation: random set points with noise, held ones without",
        "square_mae": "square wave, no noise",
    }
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9, 4.5))
        axes = figure.subplots()
        for (column, name), colour in zip(shown.items(), _COLOURS, strict=False):
            for i, (_, curve) in enumerate(curves.groupby("policy")):
                axes.plot(
                    curve["steps"] / 1000, curve[column], color=colour, linewidth=0.8,
                    label=None if i else name,
                )  # fmt: skip
        axes.set_ylim(bottom=0)
        axes.set_xlim(left=0)
        axes.set_xlabel("samples of experience (thousands)")
        axes.set_ylabel(METRICS["mae"])
        axes.set_title("PPO's learning curves, one line a policy", loc="left")
        axes.legend()
        save(figure, path)


@dataclass(frozen=True)
class Panel:
    """One of the paper's figures, as `plot_figures` draws it.

    Attributes
    ----------
    title
        Its heading.
    curves
        What `figures.summarise` returns.
    signals
        What to draw of it, each on axes of its own: "output", "command" or "noise".
    parameters
        The plant's: dead zone and limits are drawn behind the command.
    """

    title: str
    curves: pd.DataFrame
    signals: tuple[str, ...]
    parameters: Parameters


_SIGNALS = {
    "output": ("temperature y (°C)", _COLOURS[0]),
    "command": ("command u (t/h)", _COLOURS[2]),
    "noise": ("noise n (°C)", _COLOURS[3]),
}


def plot_figures(panels: Sequence[Panel], path: Path) -> None:
    """Draw figures of the paper: one, or a sheet of several in two columns."""
    axes_of = [(panel, signal) for panel in panels for signal in panel.signals]
    columns = min(2, len(panels))
    rows = math.ceil(len(axes_of) / columns)
    with mpl.rc_context(STYLE):
        size = (8, 3 * rows) if columns == 1 else (13, 2.4 * rows)
        figure = Figure(figsize=size)
        grid = figure.subplots(rows, columns, sharex=True, squeeze=False)
        for axes, (panel, signal) in zip(grid.flat, axes_of, strict=False):
            _draw_signal(axes, panel, signal)
        used, unused = grid.flat[: len(axes_of)], grid.flat[len(axes_of) :]
        for axes in used[-columns:]:  # the lowest of each column
            axes.tick_params(labelbottom=True)
            axes.set_xlabel("time (min)")
        for axes in unused:
            axes.set_visible(False)
        save(figure, path)


def _draw_signal(axes: Axes, panel: Panel, signal: str) -> None:
    curves, parameters = panel.curves, panel.parameters
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
        zone = parameters.dead_zone
        axes.axhspan(-zone, zone, color="0.5", alpha=0.15, linewidth=0, label="dead zone")
        for limit in (parameters.u_min, parameters.u_max):
            axes.axhline(limit, color="0.4", linestyle=":", linewidth=1)
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.2 * (high - low))  # room for the legend
    axes.set_xlim(0, minutes.max())
    axes.set_ylabel(name)
    axes.set_title(panel.title, loc="left", fontsize="medium")
    axes.legend(loc="upper right", ncols=3, fontsize="small")


def plot_convergence(times: pd.DataFrame, path: Path) -> None:
    """Draw which share of the networks has converged by when, one line for each set point."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9, 4))
        axes = figure.subplots()
        for name, colour in colours(list(times)).items():
            finite = times[name].replace(math.inf, np.nan).dropna().sort_values()
            done = 100 * np.arange(1, len(finite) + 1) / len(times)
            axes.step(finite, done, where="post", color=colour, label=name)
        axes.axvline(150, color="0.4", linestyle=":", label="the paper's 150 samples")
        axes.set_xlim(left=0)
        axes.set_ylim(0, 100)
        axes.set_xlabel("samples since the start")
        axes.set_ylabel("weights have converged (% of draws)")
        axes.legend()
        save(figure, path)


def plot_pi_gains(errors: pd.DataFrame, path: Path) -> None:
    """Draw the mean error of PI controllers over Kp, one line for each case."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9, 4))
        axes = figure.subplots()
        for (name, rows), colour in zip(
            errors.groupby("setpoint", sort=False), _COLOURS, strict=False
        ):
            axes.plot(rows["kp"], rows["mean_error"], ".-", color=colour, label=name)
        axes.set_ylim(bottom=0)
        axes.set_xlabel("Kp (t/h per °C), with the paper's Ki = 0.3")
        axes.set_ylabel(METRICS["mae"])
        axes.legend()
        save(figure, path)


def plot_other_plants(cells: pd.DataFrame, path: Path) -> None:
    """Draw maps of the share of networks that settle: over delay and gain, for each case."""
    cases, time_constants = cells["setpoint"].unique(), cells["time_constant"].unique()
    with mpl.rc_context(STYLE | {"axes.grid": False}):
        figure = Figure(figsize=(10, 2.8 * len(cases)))
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
        save(figure, path)


CLAIMS = {
    "convergence": plot_convergence,
    "pi_gains": plot_pi_gains,
    "other_plants": plot_other_plants,
}


def save(figure: Figure, path: Path) -> None:
    """Write a figure, whole or not at all."""
    with replacing(path) as partial:
        figure.savefig(partial)
