"""Pictures of a comparison, drawn from the tables that it writes."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

from benchmarks.controllers.roster import label
from benchmarks.lib.drawing import COLOURS, colours, drawn
from benchmarks.lib.tables import groups
from benchmarks.loop.metrics import METRICS
from benchmarks.loop.scenarios import Scenario


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
    with drawn(path, 9, 6) as figure:
        above, below = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": [3, 2]})
        for agent, rows in groups(responses, "agent"):
            _band(above, rows, "output", palette[agent], label(agent))
            _band(below, rows, "applied", palette[agent], label(agent))
        minutes = rows["time_s"] / 60
        above.step(
            minutes, rows["setpoint"], "k--", linewidth=1, where="post", label="set point"
        )
        above.set_ylabel("temperature y (°C)")
        above.set_title(scenario.title, loc="left")
        figure.legend(*above.get_legend_handles_labels(), loc="outside lower center", ncols=4)
        # Of drawn actuators, what none of them lets pass, and what none of them exceeds.
        zone, _ = parameters.range_of("dead_zone")
        below.axhspan(-zone, zone, color="0.5", alpha=0.15, linewidth=0)
        below.text(
            1.005, 0.5, "dead\nzone", transform=below.transAxes, va="center", color="0.4"
        )
        for limit in (parameters.range_of("u_min")[0], parameters.range_of("u_max")[1]):
            below.axhline(limit, color="0.4", linestyle=":", linewidth=1)
        below.set_ylabel("applied flow u_a (t/h)")
        below.set_xlabel("time (min)")
        below.set_xlim(0, minutes.max())


def _band(axes: Axes, rows: pd.DataFrame, signal: str, colour: str, name: str) -> None:
    minutes = rows["time_s"] / 60
    step: Literal["post"] | None = "post" if signal == "applied" else None
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
    with _scenario_panels(path, estimates) as (_, panels):
        shades = colours(list(estimates["agent"].unique()))
        for axes, (_, rows) in zip(panels, groups(estimates, "scenario"), strict=True):
            for place, (_, row) in enumerate(rows.iterrows()):
                low, high = row["mean"] - row["mean_low"], row["mean_high"] - row["mean"]
                ends = [[low], [high]] if math.isfinite(high) else None
                colour = shades[row["agent"]]
                axes.errorbar(row["mean"], place, xerr=ends, fmt="o", capsize=3, color=colour)
            axes.set_yticks(range(len(rows)), [label(agent) for agent in rows["agent"]])
            axes.invert_yaxis()
            highest = rows[["mean", "mean_high"]].to_numpy()
            # The end of an interval may be infinite.
            limit, worst = rows["limit"].iloc[0], highest[np.isfinite(highest)].max()
            # A little to the left of it, so that a point on the limit is whole.
            axes.axvline(limit, color="0.4", linewidth=1)
            axes.set_xlim(limit - 0.02 * (worst - limit), worst + 0.05 * (worst - limit) + 1e-3)
            axes.set_xlabel("mean |e| (°C)")


def plot_runs(runs: pd.DataFrame, path: Path) -> None:
    """Draw the mean error of every single run, so that no failure is averaged away."""
    generator = np.random.default_rng(0)  # scatters points that would hide each other
    with _scenario_panels(path, runs) as (_, panels):
        shades = colours(list(runs["agent"].unique()))
        for axes, (_, cases) in zip(panels, groups(runs, "scenario"), strict=True):
            agents = list(cases["agent"].unique())
            for place, agent in enumerate(agents):
                errors = cases.loc[cases["agent"] == agent, "mae"]
                around = place + generator.uniform(-0.3, 0.3, len(errors))
                axes.plot(errors, around, ".", markersize=3, alpha=0.4, color=shades[agent])
            axes.set_yticks(range(len(agents)), [label(agent) for agent in agents])
            axes.invert_yaxis()
            axes.set_xlim(left=0)
            axes.set_xlabel("mean |e| of a run (°C)")


@contextmanager
def _scenario_panels(
    path: Path, rows: pd.DataFrame, height: float | None = None
) -> Iterator[tuple[Figure, list[Axes]]]:
    """Give a figure with a panel for each scenario, and write it."""
    names = rows["scenario"].unique()
    columns = min(3, len(names))
    height = height or 1.2 + 0.28 * rows["agent"].nunique()
    lines = math.ceil(len(names) / columns)
    with drawn(path, 4.2 * columns, height * lines) as figure:
        panels = list(figure.subplots(lines, columns, squeeze=False).flat)
        for axes, name in zip(panels, names, strict=False):
            axes.set_title(name, loc="left")
        for axes in panels[len(names) :]:
            axes.set_visible(False)
        yield figure, panels[: len(names)]


def plot_travel(
    summary: pd.DataFrame,
    limits: Mapping[str, float],
    frontiers: Mapping[str, Sequence[tuple[float, float]]],
    path: Path,
) -> None:
    """Draw the error of every agent against its valve travel, a panel for each scenario.

    Parameters
    ----------
    summary
        Rows as `tables.summarise` makes them.
    limits
        The least possible error of each scenario, degC.
    frontiers
        The least possible error for a given travel: t/h and degC, by descending travel.
    path
        The PNG file to write.
    """
    medians = summary.pivot_table(
        index=["scenario", "agent"], columns="metric", values="median", sort=False
    ).reset_index()
    with _scenario_panels(path, medians, 3.0) as (figure, panels):
        agents = list(medians["agent"].unique())
        shades = colours(agents)
        # Not as many as hues, so that two of like colour have other marks.
        marks = dict(zip(agents, itertools.cycle("osD^v"), strict=False))
        for axes, (name, rows) in zip(panels, groups(medians, "scenario"), strict=True):
            # A valve that never moves has no place on this axis.
            moving = rows[rows["total_variation"] > 0.0]
            for _, row in moving.iterrows():
                agent = row["agent"]
                axes.plot(
                    row["total_variation"], row["mae"], marks[agent], color=shades[agent],
                    label=label(agent),
                )  # fmt: skip
            limit, travels = limits[name], moving["total_variation"]
            if moving.empty:
                continue
            across = np.geomspace(0.7 * travels.min(), 1.4 * travels.max(), 200)
            if frontiers[name]:
                travel, error = np.transpose(frontiers[name][::-1])
                axes.plot(
                    across, np.interp(across, travel, error), color="0.4", linewidth=1,
                    label="least possible for this travel",
                )  # fmt: skip
            axes.axhline(
                limit, color="0.4", linewidth=1, linestyle="--",
                label="least possible for any travel",
            )  # fmt: skip
            axes.set_xscale("log")
            axes.set_xlim(across[0], across[-1])
            axes.set_ylim(0.9 * min(limit, moving["mae"].min()), 1.1 * moving["mae"].max())
            axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.xaxis.set_major_formatter("{x:g}")
            axes.xaxis.set_minor_locator(NullLocator())
            axes.set_xlabel("valve travel (t/h)")
            axes.set_ylabel("mean |e| (°C)")
        shown = [axes.get_legend_handles_labels() for axes in panels]
        # Each once, although not every panel has all.
        entries = {name: handle for pair in shown for handle, name in zip(*pair, strict=True)}
        figure.legend(entries.values(), entries, loc="outside lower center", ncols=5)


def plot_learning(curves: pd.DataFrame, path: Path) -> None:
    """Draw learning curves: mean |e| over samples of experience, a panel for each agent."""
    shown = {
        "training_mae": "training: random set points, exploring",
        "validation_mae": "validation: set points of its own",
        "square_mae": "square wave, no noise",
    }
    agents = list(curves["agent"].unique())
    with drawn(path, 9, 4.5 * len(agents)) as figure:
        panels = figure.subplots(len(agents), 1, squeeze=False)[:, 0]
        for axes, agent in zip(panels, agents, strict=True):
            policies = curves[curves["agent"] == agent].dropna(axis=1, how="all")
            for (column, name), colour in zip(shown.items(), COLOURS, strict=False):
                for i, (_, curve) in enumerate(policies.groupby("policy")):
                    if column in curve:
                        axes.plot(
                            curve["steps"] / 1000, curve[column], color=colour,
                            linewidth=0.8, label=None if i else name,
                        )  # fmt: skip
            axes.set_ylim(bottom=0)
            axes.set_xlim(left=0)
            axes.set_xlabel("samples of experience (thousands)")
            axes.set_ylabel(METRICS["mae"])
            axes.set_title(f"{label(agent)}: a line a policy", loc="left")
        handles, names = panels[0].get_legend_handles_labels()
        figure.legend(handles, names, loc="outside lower center", ncols=3)
