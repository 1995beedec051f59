"""Draw the pictures of a comparison from the tables that it writes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullLocator

from benchmarks.controllers.roster import label, looks
from benchmarks.lib.report import MULTIPLE, NEAREST, drawn, panels, scale_by_excess
from benchmarks.lib.statistics import Estimate, written
from benchmarks.loop.scenarios import Scenario

FARTHEST = 1.5  # distance of a score from 1 at which the axis ends
HELD = 15  # minutes that are shown of a held set point without load


def plot_scores(scores: Mapping[str, Estimate], estimates: pd.DataFrame, path: Path) -> None:
    """Draw the score of every controller, sorted, and small marks for its cases."""
    style = looks([*scores])
    with drawn(path, 1.2 + 0.3 * len(scores), "Scores, the best first") as figure:
        axes = figure.subplots()
        for place, (agent, score) in enumerate(scores.items()):
            of_cases = estimates.loc[estimates["agent"] == agent, "scores"].map(np.mean)
            mean, *cases = np.clip(1.0 - np.array([score.value, *of_cases]), NEAREST, FARTHEST)
            axes.plot(cases, [place] * len(cases), "|", color=style[agent][0], alpha=0.5)
            _mark(axes, mean, place, style[agent], mean == 1.0 - score.value)
            text = written(score.value, ".3f")
            axes.annotate(text, (1.01, place), xycoords=("axes fraction", "data"), va="center")
        axes.set_yticks(range(len(scores)), [label(agent) for agent in scores])
        axes.set(ylim=(len(scores) - 0.5, -0.5), xscale="log")
        axes.set_xlim(1.1 * FARTHEST, NEAREST / 1.3)
        shown = (1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002, NEAREST)
        axes.set_xticks(shown, [f"{1 - away:g}" for away in shown])
        axes.xaxis.set_minor_locator(NullLocator())
        axes.set_xlabel(
            "score: 0 without control, 1 at the least possible error (log scale of 1 - score)\n"
            "a tick is one case; hollow: at the edge or beyond"
        )


def _mark(axes: Axes, x: float, y: float, look: tuple[str, str], inside: bool) -> None:
    """Draw a marker, hollow where it stands at an edge for what is beyond."""
    face = look[0] if inside else "white"
    axes.plot(x, y, look[1], color=look[0], markerfacecolor=face, markersize=5)


def plot_travel(
    runs: pd.DataFrame, estimates: pd.DataFrame, agents: Sequence[str], path: Path
) -> None:
    """Draw the median error and travel of every valve that moves, a panel for each case."""
    measures = runs.groupby(["scenario", "agent"], sort=False)[["mae", "total_variation"]]
    medians = measures.median().query("total_variation > 0").reset_index()
    if medians.empty:
        return
    limits = estimates.groupby("scenario")["limit"].first()
    style, cases = looks(agents), [*medians["scenario"].unique()]
    with panels(path, cases, 2.4, 2, "Mean error and valve travel") as (figure, found):
        for axes, case in zip(found, cases, strict=True):
            rows = medians[medians["scenario"] == case]
            travel, excess = rows["total_variation"], rows["mae"] / limits[case] - 1.0
            for agent, x, y in zip(rows["agent"], travel, excess, strict=True):
                _mark(axes, x, max(y, NEAREST), style[agent], y >= NEAREST)
            scale_by_excess(axes, "y", *excess.clip(NEAREST).agg(["min", "max"]))
            axes.set(xscale="log", xlim=(0.7 * travel.min(), 1.4 * travel.max()))
            axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
            axes.xaxis.set_major_formatter("{x:g}")
            axes.xaxis.set_minor_locator(NullLocator())
        for axes in found[::2]:
            axes.set_ylabel(MULTIPLE)
        for axes in found[-2:]:  # the lowest of each column
            axes.set_xlabel("valve travel of the median run (t/h, log)")
        entries = {
            label(agent): Line2D([], [], color=colour, marker=marker, linestyle="")
            for agent, (colour, marker) in style.items()
        }
        figure.legend(entries.values(), entries, loc="outside lower center", ncols=4)


def plot_responses(
    responses: pd.DataFrame, errors: pd.Series[float], scenario: Scenario, path: Path
) -> None:
    """Draw output and applied input over time, a row for every controller, the best first.

    Where the set point is held, the error is drawn in place of the output, and of a run without
    load only the beginning.
    """
    shown, plant = responses["agent"].unique(), scenario.parameters
    agents = [*errors[shown].sort_values(kind="stable").index]
    held = responses["setpoint"].nunique() == 1
    if held:
        if not plant.is_disturbed:
            responses = responses[responses["time_s"] <= 60 * HELD]
        below = responses.filter(like="output_").rsub(responses["setpoint"], axis="index")
        responses = responses.assign(setpoint=0.0, **below)
    height, style = 1.0 + 1.05 * len(agents), looks(agents)
    with drawn(path, height, scenario.title) as figure:
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
            band = minutes, rows["output_p10"], rows["output_p90"]
            left.fill_between(*band, color=colour, alpha=0.3, linewidth=0)
            left.plot(minutes, rows["output_median"], color=colour, linewidth=1.2)
            left.set_title(f"{label(agent)}: {errors[agent]:.3f} °C")
            # Where they are drawn: the least dead zone and the widest limits.
            zone, _ = plant.range_of("dead_zone")
            right.axhspan(-zone, zone, color="0.5", alpha=0.15, linewidth=0)
            for limit in (plant.range_of("u_min")[0], plant.range_of("u_max")[1]):
                right.axhline(limit, color="0.4", linestyle=":", linewidth=1)
            right.step(minutes, rows["applied_median"], color=colour, linewidth=1, where="post")
        left.set_xlim(0, minutes.max())
        if held and plant.is_disturbed:
            left.set_ylim(-2.0, 2.0)  # of the loads; the first step is beyond
        rows_of[0, 1].set_title("applied flow (t/h); grey: dead zone")
        figure.supylabel("error (°C)" if held else "temperature (°C)", fontsize="medium")
        shown_as = "lines: medians, bands: 10th to 90th percentile"
        if plant.setpoint == "random":
            shown_as = "the first run; the errors are means of all"
        figure.supxlabel(f"time (min); {shown_as}", fontsize="medium")
