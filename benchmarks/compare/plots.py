"""Draw the pictures of a comparison from the tables that it writes."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullLocator

from benchmarks.compare.estimates import Scale
from benchmarks.controllers.roster import label
from benchmarks.lib.drawing import colours, draw_actuator, drawn, panels
from benchmarks.lib.tables import groups
from benchmarks.loop.scenarios import Scenario


def plot_responses(responses: pd.DataFrame, scenario: Scenario, path: Path) -> None:
    """Draw set point, output and applied input of every agent over time.

    `responses` holds the rows of `comparison.summarise_responses` for all agents.
    """
    palette = colours(list(responses["agent"].unique()))
    with drawn(path, 9, 6) as figure:
        above, below = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": [3, 2]})
        for agent, rows in groups(responses, "agent"):
            minutes = rows["time_s"] / 60
            for axes, signal, held in ((above, "output", False), (below, "applied", True)):
                axes.fill_between(
                    minutes, rows[f"{signal}_p10"], rows[f"{signal}_p90"],
                    step="post" if held else None, color=palette[agent], alpha=0.2, linewidth=0,
                )  # fmt: skip
                axes.plot(
                    minutes, rows[f"{signal}_median"], color=palette[agent], linewidth=1.2,
                    drawstyle="steps-post" if held else "default", label=label(agent),
                )  # fmt: skip
        above.step(
            minutes, rows["setpoint"], "k--", linewidth=1, where="post", label="set point"
        )
        above.set_ylabel("temperature y (°C)")
        above.set_title(scenario.title, loc="left")
        figure.legend(*above.get_legend_handles_labels(), loc="outside lower center", ncols=4)
        draw_actuator(below, scenario.parameters)
        below.text(
            1.005, 0.5, "dead\nzone", transform=below.transAxes, va="center", color="0.4"
        )
        below.set_ylabel("applied flow u_a (t/h)")
        below.set_xlabel("time (min)")
        below.set_xlim(0, minutes.max())


def plot_bounds(estimates: pd.DataFrame, path: Path) -> None:
    """Draw mean errors with 95 % intervals; each axis begins at the least possible error."""
    with _scenario_panels(path, estimates) as (found, shades):
        for axes, rows in found:
            worst = max(mean.value for mean in rows["mean"])
            for place, row in enumerate(rows.to_dict("records")):
                mean, ends = row["mean"], None
                if math.isfinite(mean.high):
                    ends = [[mean.value - mean.low], [mean.high - mean.value]]
                    worst = max(worst, mean.high)
                colour = shades[row["agent"]]
                axes.errorbar(mean.value, place, xerr=ends, fmt="o", capsize=3, color=colour)
            _list_agents(axes, rows, "mean |e| (°C)")
            limit = rows["limit"].iloc[0]
            # Begin slightly to the left of the limit, so that a point on it is whole.
            axes.axvline(limit, color="0.4", linewidth=1)
            axes.set_xlim(limit - 0.02 * (worst - limit), worst + 0.05 * (worst - limit) + 1e-3)


def plot_runs(runs: pd.DataFrame, path: Path) -> None:
    """Draw the mean error of every run, so that no failure is averaged away."""
    generator = np.random.default_rng(0)  # jitters points that would overlap
    with _scenario_panels(path, runs) as (found, shades):
        for axes, cases in found:
            for place, (agent, rows) in enumerate(groups(cases, "agent")):
                around = place + generator.uniform(-0.3, 0.3, len(rows))
                axes.plot(
                    rows["mae"], around, ".", markersize=3, alpha=0.4, color=shades[agent]
                )
            _list_agents(axes, cases, "mean |e| of a run (°C)")
            axes.set_xlim(left=0)


def _list_agents(axes: Axes, rows: pd.DataFrame, measure: str) -> None:
    agents = rows["agent"].unique()
    axes.set_yticks(range(len(agents)), [label(agent) for agent in agents])
    axes.invert_yaxis()
    axes.set_xlabel(measure)


@contextmanager
def _scenario_panels(
    path: Path, table: pd.DataFrame, height: float | None = None
) -> Iterator[tuple[list[tuple[Axes, pd.DataFrame]], dict[str, str]]]:
    """Yield a panel and the rows of each scenario, and a colour for each agent.

    The legend holds the labels of all panels.
    """
    shades = colours(list(table["agent"].unique()))
    by_scenario = dict(groups(table, "scenario"))
    height = height or 1.2 + 0.28 * len(shades)
    with panels(path, list(by_scenario), (4.2, height), 3) as (figure, found):
        yield list(zip(found, by_scenario.values(), strict=True)), shades
        shown = [axes.get_legend_handles_labels() for axes in found]
        entries = {name: handle for pair in shown for handle, name in zip(*pair, strict=True)}
        if entries:
            figure.legend(entries.values(), entries, loc="outside lower center", ncols=5)


def plot_travel(summary: pd.DataFrame, scales: Mapping[str, Scale], path: Path) -> None:
    """Draw the error of every agent against its valve travel, a panel for each scenario.

    `summary` is what `report.summarise` returns. A valve that never moves is not drawn.
    """
    medians = summary.pivot_table(
        index=["scenario", "agent"], columns="metric", values="median", sort=False
    ).reset_index()
    line: dict[str, Any] = {"color": "0.4", "linewidth": 1}
    with _scenario_panels(path, medians, 3.0) as (found, shades):
        # Fewer marks than hues, so that agents of similar colour have different marks.
        marks = dict(zip(shades, itertools.cycle("osD^v"), strict=False))
        for axes, cases in found:
            rows = cases[cases["total_variation"] > 0.0]
            if rows.empty:
                continue
            travels, errors = rows["total_variation"], rows["mae"]
            for agent, travel, error in zip(rows["agent"], travels, errors, strict=True):
                axes.plot(travel, error, marks[agent], color=shades[agent], label=label(agent))
            scale = scales[rows["scenario"].iloc[0]]
            across = np.geomspace(0.7 * travels.min(), 1.4 * travels.max(), 200)
            if scale.frontier:
                least = np.interp(across, *np.transpose(scale.frontier[::-1]))
                axes.plot(across, least, **line, label="least possible for this travel")
            limit = scale.least.value
            axes.axhline(limit, linestyle="--", **line, label="least possible for any travel")
            axes.set_xscale("log")
            axes.set_xlim(across[0], across[-1])
            axes.set_ylim(0.9 * min(limit, errors.min()), 1.1 * errors.max())
            axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.xaxis.set_major_formatter("{x:g}")
            axes.xaxis.set_minor_locator(NullLocator())
            axes.set_xlabel("valve travel (t/h)")
            axes.set_ylabel("mean |e| (°C)")
