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
HELD = 15  # minutes shown of a constant set point without load


def plot_scores(scores: Mapping[str, Estimate], estimates: pd.DataFrame, path: Path) -> None:
    """Draw the score of every controller, sorted, and small marks for its cases."""
    style = looks([*scores])
    with drawn(path, 1.2 + 0.3 * len(scores), "Scores, the best first") as figure:
        axes = figure.subplots()
        for place, (agent, score) in enumerate(scores.items()):
            colour, _ = style[agent]
            case_scores = estimates.loc[estimates["agent"] == agent, "scores"].map(np.mean)
            distances = np.clip(1.0 - case_scores.to_numpy(), NEAREST, FARTHEST)
            axes.plot(distances, [place] * len(distances), "|", color=colour, alpha=0.5)
            distance = float(np.clip(1.0 - score.value, NEAREST, FARTHEST))
            _mark(axes, distance, place, style[agent], distance == 1.0 - score.value)
            text = written(score.value, ".3f")
            axes.annotate(text, (1.01, place), xycoords=("axes fraction", "data"), va="center")
        axes.set_yticks(range(len(scores)), [label(agent) for agent in scores])
        axes.set(ylim=(len(scores) - 0.5, -0.5), xscale="log")
        axes.set_xlim(1.1 * FARTHEST, NEAREST / 1.3)
        ticks = (1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002, NEAREST)
        axes.set_xticks(ticks, [f"{1 - distance:g}" for distance in ticks])
        axes.xaxis.set_minor_locator(NullLocator())
        axes.set_xlabel(
            "score: 0 without control, 1 at the least possible error (log scale of 1 - score)\n"
            "a tick is one case; hollow: at the edge or beyond"
        )


def _mark(axes: Axes, x: float, y: float, look: tuple[str, str], inside: bool) -> None:
    """Draw a marker of a colour and a shape; hollow at an edge, for a value beyond it."""
    colour, marker = look
    face = colour if inside else "white"
    axes.plot(x, y, marker, color=colour, markerfacecolor=face, markersize=5)


def plot_travel(
    runs: pd.DataFrame, estimates: pd.DataFrame, agents: Sequence[str], path: Path
) -> None:
    """Draw the median error and travel of every valve that moves, a panel for each case."""
    measures = runs.groupby(["scenario", "agent"], sort=False)[["mae", "total_variation"]]
    medians = measures.median().query("total_variation > 0").reset_index()
    if medians.empty:
        return
    limits = estimates.groupby("scenario")["limit"].first()
    style = looks(agents)
    cases = [*medians["scenario"].unique()]
    with panels(path, cases, 2.4, 2, "Mean error and valve travel") as (figure, all_axes):
        for axes, case in zip(all_axes, cases, strict=True):
            rows = medians[medians["scenario"] == case]
            travel = rows["total_variation"]
            excess = rows["mae"] / limits[case] - 1.0
            for agent, x, y in zip(rows["agent"], travel, excess, strict=True):
                _mark(axes, x, max(y, NEAREST), style[agent], y >= NEAREST)
            scale_by_excess(axes, "y", *excess.clip(NEAREST).agg(["min", "max"]))
            axes.set(xscale="log", xlim=(0.7 * travel.min(), 1.4 * travel.max()))
            axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
            axes.xaxis.set_major_formatter("{x:g}")
            axes.xaxis.set_minor_locator(NullLocator())
        for axes in all_axes[::2]:  # the left column
            axes.set_ylabel(MULTIPLE)
        for axes in all_axes[-2:]:  # the lowest of each column
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
    plant = scenario.parameters
    agents = [*errors[responses["agent"].unique()].sort_values(kind="stable").index]
    held = responses["setpoint"].nunique() == 1
    if held:
        if not plant.is_disturbed:
            responses = responses[responses["time_s"] <= 60 * HELD]
        output_errors = responses.filter(like="output_").rsub(
            responses["setpoint"], axis="index"
        )
        responses = responses.assign(setpoint=0.0, **output_errors)
    height = 1.0 + 1.05 * len(agents)
    style = looks(agents)
    with drawn(path, height, scenario.title) as figure:
        figure.set_layout_engine("none")  # which would take most of the time
        margins = {"left": 0.09, "right": 0.98, "wspace": 0.14, "hspace": 0.5}
        margins |= {"bottom": 0.55 / height, "top": 1 - 0.7 / height}
        all_axes = figure.subplots(
            len(agents), 2, sharex=True, sharey="col", squeeze=False, gridspec_kw=margins
        )
        for (output_axes, flow_axes), agent in zip(all_axes, agents, strict=True):
            rows = responses[responses["agent"] == agent]
            minutes = rows["time_s"] / 60
            colour, _ = style[agent]
            output_axes.step(minutes, rows["setpoint"], "k--", linewidth=0.8, where="post")
            band = minutes, rows["output_p10"], rows["output_p90"]
            output_axes.fill_between(*band, color=colour, alpha=0.3, linewidth=0)
            output_axes.plot(minutes, rows["output_median"], color=colour, linewidth=1.2)
            output_axes.set_title(f"{label(agent)}: {errors[agent]:.3f} °C")
            # If these are ranges: the smallest dead zone and the widest limits.
            dead_zone, _ = plant.range_of("dead_zone")
            flow_axes.axhspan(-dead_zone, dead_zone, color="0.5", alpha=0.15, linewidth=0)
            for limit in (plant.range_of("u_min")[0], plant.range_of("u_max")[1]):
                flow_axes.axhline(limit, color="0.4", linestyle=":", linewidth=1)
            flow_axes.step(
                minutes, rows["applied_median"], color=colour, linewidth=1, where="post"
            )
        # All axes of a column share their limits.
        first_output_axes, first_flow_axes = all_axes[0]
        first_output_axes.set_xlim(0, responses["time_s"].max() / 60)
        if held and plant.is_disturbed:
            # The range of the errors by the load; that of the first step is larger.
            first_output_axes.set_ylim(-2.0, 2.0)
        first_flow_axes.set_title("applied flow (t/h); grey: dead zone")
        figure.supylabel("error (°C)" if held else "temperature (°C)", fontsize="medium")
        shown_as = "lines: medians, bands: 10th to 90th percentile"
        if plant.setpoint == "random":
            shown_as = "the first run; the errors are means of all"
        figure.supxlabel(f"time (min); {shown_as}", fontsize="medium")
