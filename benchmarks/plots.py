"""Pictures of a comparison, drawn from the tables that it writes."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.metrics import METRICS
from benchmarks.roster import label
from benchmarks.scenarios import Scenario
from benchmarks.storage import replacing

# Okabe and Ito's colours, which colour-blind readers can tell apart.
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#F0E442")
_STYLE = {
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
    with mpl.rc_context(_STYLE):
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
        _save(figure, path)


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


def plot_mae(summary: pd.DataFrame, path: Path) -> None:
    """Draw the mean absolute error as bars: the median, with the 10th to 90th percentile."""
    rows = summary[summary["metric"] == "mae"]
    scenarios, agents = list(rows["scenario"].unique()), list(rows["agent"].unique())
    width = 0.8 / len(agents)
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(9, 4.5))
        axes = figure.subplots()
        for i, (agent, colour) in enumerate(colours(agents).items()):
            bars = rows[rows["agent"] == agent]
            places = [scenarios.index(s) + (i + 0.5) * width - 0.4 for s in bars["scenario"]]
            whiskers = [bars["median"] - bars["p10"], bars["p90"] - bars["median"]]
            axes.bar(
                places, bars["median"], 0.92 * width, yerr=whiskers, color=colour, capsize=3,
                label=label(agent), error_kw={"linewidth": 1},
            )  # fmt: skip
        axes.set_xticks(range(len(scenarios)), [s.replace("-", "\n", 1) for s in scenarios])
        axes.set_ylabel(METRICS["mae"])
        axes.set_title("Median over runs, 10th to 90th percentile", loc="left")
        axes.grid(visible=False, axis="x")
        axes.legend()
        _save(figure, path)


def plot_learning(curves: pd.DataFrame, path: Path) -> None:
    """Draw PPO's learning curves: mean |e| over samples of experience, for each candidate."""
    shown = {
        "training_mae": "training: random set points, noise, exploring",
        "validation_mae": "validation: random set points, half of them with noise",
        "square_mae": "square wave, no noise",
    }
    chosen = curves.loc[curves["validation_mae"].idxmin()]
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(9, 4.5))
        axes = figure.subplots()
        for (column, name), colour in zip(shown.items(), _COLOURS, strict=False):
            for candidate, curve in curves.groupby("candidate"):
                is_chosen = candidate == chosen["candidate"]
                axes.plot(
                    curve["steps"] / 1000, curve[column], color=colour,
                    linewidth=1.5 if is_chosen else 0.7, alpha=1.0 if is_chosen else 0.5,
                    label=name if is_chosen else None,
                )  # fmt: skip
        axes.axvline(
            chosen["steps"] / 1000, color="0.4", linestyle=":", label="policy that is used"
        )
        axes.set_ylim(bottom=0)
        axes.set_xlim(left=0)
        axes.set_xlabel("samples of experience (thousands)")
        axes.set_ylabel(METRICS["mae"])
        axes.set_title("PPO's learning curves", loc="left")
        axes.legend()
        _save(figure, path)


def _save(figure: Figure, path: Path) -> None:
    with replacing(path) as partial:
        figure.savefig(partial)
