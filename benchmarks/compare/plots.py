"""Draw the pictures of a comparison from the tables that it writes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullLocator

from benchmarks.compare.estimates import Scale, Score
from benchmarks.controllers.roster import label, looks
from benchmarks.lib.drawing import (
    MULTIPLE,
    NEAREST,
    draw_actuator,
    draw_legend,
    drawn,
    panels,
    scale_by_excess,
)
from benchmarks.lib.tables import groups
from benchmarks.loop.scenarios import Scenario


def plot_scores(scores: Mapping[str, Score], path: Path) -> None:
    """Draw the score of every agent, sorted, and small marks for its scenarios."""
    style = looks([*scores])
    with drawn(path, 0.9 + 0.3 * len(scores), _finding(scores)) as figure:
        axes = figure.subplots()
        for place, (agent, (overall, by_scenario)) in enumerate(scores.items()):
            colour, marker = style[agent]
            axes.plot(
                [_away(score) for score in by_scenario.values()], [place] * len(by_scenario),
                "|", color=colour, alpha=0.5,
            )  # fmt: skip
            axes.plot(_away(overall.value), place, marker, color=colour, markersize=8)
            axes.annotate(
                f"{overall.value:.3f}",
                (1.01, place),
                xycoords=("axes fraction", "data"),
                va="center",
            )
        _list_agents(axes, [*scores])
        axes.set_xscale("log")
        axes.set_xlim(1.6, NEAREST / 1.3)
        shown = (1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002, NEAREST)
        axes.set_xticks(shown, [f"{1 - away:g}" for away in shown])
        axes.xaxis.set_minor_locator(NullLocator())
        axes.set_xlabel(
            "score: 0 without control, 1 at the least possible error (log scale of 1 - score)"
        )


def _away(score: float) -> float:
    """Return the distance of a score from 1, within the axis."""
    return min(max(1.0 - score, NEAREST), 1.5)


def _finding(scores: Mapping[str, Score]) -> str:
    first, *others = ((label(agent), overall.value) for agent, (overall, _) in scores.items())
    second = f", {others[0][0]} follows with {others[0][1]:.3f}" if others else ""
    return f"{first[0]} comes closest to the least possible error: {first[1]:.3f}{second}"


def plot_bounds(
    estimates: pd.DataFrame, runs: pd.DataFrame, agents: Sequence[str], path: Path
) -> None:
    """Draw mean errors as multiples of the least possible, with intervals and worst runs."""
    style = looks(agents)
    worst = runs.groupby(["scenario", "agent"])["mae"].max()
    best = estimates.assign(value=[mean.value for mean in estimates["mean"]])
    best = best.loc[best.groupby("scenario", sort=False)["value"].idxmin(), "agent"]
    name, count = best.mode()[0], (best == best.mode()[0]).sum()
    title = f"{label(name)} has the least mean error in {count} of {len(best)} cases"
    scenarios = dict(groups(estimates, "scenario"))
    height = 0.8 + 0.17 * len(agents)
    with panels(path, [*scenarios], height, 2, title) as (figure, found, free):
        for i, (axes, (scenario, rows)) in enumerate(
            zip(found, scenarios.items(), strict=True)
        ):
            ends = [NEAREST]
            for row in rows.to_dict("records"):
                place = agents.index(row["agent"])
                colour, marker = style[row["agent"]]
                ratio, end = row["ratio"], worst[scenario, row["agent"]] / row["limit"]
                low, mean, high, end = (
                    max(each - 1.0, NEAREST)
                    for each in (ratio.low, ratio.value, ratio.high, end)
                )
                ends += [mean, end]
                axes.plot([mean, end], [place] * 2, color=colour, alpha=0.4, linewidth=1)
                if math.isfinite(high):
                    axes.plot([low, high], [place] * 2, color=colour, linewidth=3)
                axes.plot(mean, place, marker, color=colour, markersize=5)
            _list_agents(axes, agents)
            axes.tick_params(labelleft=i % 2 == 0)
            scale_by_excess(axes, "x", min(ends), max(ends))
        for axes in found[-2:]:  # the lowest of each column
            axes.set_xlabel(MULTIPLE)
        grey: Any = {"color": "0.4"}
        draw_legend(
            figure,
            free,
            {
                "mean error of all runs": Line2D([], [], marker="o", linestyle="", **grey),
                "its 95 % interval": Line2D([], [], linewidth=3, **grey),
                "to the worst run": Line2D([], [], linewidth=1, alpha=0.4, **grey),
            },
        )


def _list_agents(axes: Axes, agents: Sequence[str]) -> None:
    axes.set_yticks(range(len(agents)), [label(agent) for agent in agents])
    axes.set_ylim(len(agents) - 0.5, -0.5)


def plot_travel(
    summary: pd.DataFrame,
    scales: Mapping[str, Scale],
    scores: Mapping[str, Score],
    path: Path,
) -> None:
    """Draw the error of every agent against its valve travel, a panel for each scenario.

    `summary` is what `report.summarise` returns. A valve that never moves is not drawn.
    """
    medians = summary.pivot_table(
        index=["scenario", "agent"], columns="metric", values="median", sort=False
    ).reset_index()
    style, cases = looks([*scores]), dict(groups(medians, "scenario"))
    medians = medians[medians["total_variation"] > 0.0]
    travels = medians.groupby("agent")["total_variation"].mean()
    enough = max(overall.value for overall, _ in scores.values()) - 0.02
    calm = [agent for agent in travels.index if scores[agent][0].value >= enough]
    title = ""
    if calm:
        least = str(travels[calm].idxmin())
        title = (
            f"Of those within 0.02 of the best score, {label(least)} moves the valve least: "
            f"{travels[least]:,.0f} t/h a run"
        )
    with panels(path, [*cases], 2.4, 2, title) as (figure, found, free):
        entries: dict[str, Any] = {}
        for axes, (scenario, rows) in zip(found, cases.items(), strict=True):
            rows = rows[rows["total_variation"] > 0.0]
            if rows.empty:
                continue
            scale, travel = scales[scenario], rows["total_variation"]
            errors = (rows["mae"] / scale.least.value - 1.0).clip(NEAREST)
            for agent, x, y in zip(rows["agent"], travel, errors, strict=True):
                colour, marker = style[agent]
                (entries[label(agent)],) = axes.plot(x, y, marker, color=colour)
            across = np.geomspace(0.7 * travel.min(), 1.4 * travel.max(), 200)
            scale_by_excess(axes, "y", errors.min(), errors.max())
            axes.set_xscale("log")
            axes.set_xlim(across[0], across[-1])
            axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
            axes.xaxis.set_major_formatter("{x:g}")
            axes.xaxis.set_minor_locator(NullLocator())
        for axes in found[::2]:
            axes.set_ylabel(MULTIPLE)
        for axes in found[-2:]:  # the lowest of each column
            axes.set_xlabel("valve travel of the median run (t/h, log)")
        draw_legend(figure, free, entries)


def plot_responses(
    responses: pd.DataFrame, errors: Mapping[str, float], scenario: Scenario, path: Path
) -> None:
    """Draw output and applied input over time, a row of panels for every agent, best first.

    `responses` holds the rows of `comparison.summarise_responses` for all agents, `errors`
    their mean errors.
    """
    agents = sorted(responses["agent"].unique(), key=errors.__getitem__)
    style, best = looks(agents), agents[0]
    title = f"{scenario.title}: {label(best)} errs least of these"
    height = 1.0 + 1.05 * len(agents)
    with drawn(path, height, title) as figure:
        figure.set_layout_engine("none")  # which would take most of the time
        place = {"left": 0.09, "right": 0.98, "wspace": 0.14, "hspace": 0.5}
        place |= {"bottom": 0.55 / height, "top": 1 - 0.7 / height}
        rows_of = figure.subplots(
            len(agents), 2, sharex=True, sharey="col", squeeze=False, gridspec_kw=place
        )
        for (left, right), agent in zip(rows_of, agents, strict=True):
            rows, (colour, _) = responses[responses["agent"] == agent], style[agent]
            minutes = rows["time_s"] / 60
            left.step(minutes, rows["setpoint"], "k--", linewidth=0.8, where="post")
            left.fill_between(
                minutes, rows["output_p10"], rows["output_p90"], color=colour, alpha=0.3,
                linewidth=0,
            )  # fmt: skip
            left.plot(minutes, rows["output_median"], color=colour, linewidth=1.2)
            left.set_title(f"{label(agent)}: {errors[agent]:.3f} °C")
            draw_actuator(right, scenario.parameters)
            right.step(minutes, rows["applied_median"], color=colour, linewidth=1, where="post")
        left.set_xlim(0, minutes.max())
        rows_of[0, 1].set_title("applied flow (t/h); grey: dead zone")
        figure.supylabel("temperature (°C)", fontsize="medium")
        figure.supxlabel(
            "time (min); lines: medians, bands: 10th to 90th percentile", fontsize="medium"
        )
