"""Draw the pictures of a comparison of controllers.

A score is 0 for an idle valve and 1 for the reference error.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import NullLocator
from numpy.typing import ArrayLike, NDArray

from benchmarks.controllers.roster import ControllerSpec
from benchmarks.lib.pictures import DEAD_ZONE, LIMIT, SETPOINT, open_picture
from benchmarks.lib.statistics import Estimate
from benchmarks.loop.scenarios import Scenario
from mptc_gym import Parameters

# Ticks of the axis of scores. The axis is logarithmic in 1 minus the score, so that a score of
# 1 would lie at infinity. A score beyond an end of the axis is drawn at the end.
SCORE_TICKS = 0.0, 0.5, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995, 0.998, 0.999
SCORE_LABEL = (
    "score: 0 for an idle valve, 1 for the reference error\n"
    "(axis logarithmic in 1 minus the score, to show small differences near 1)\n"
    "large marker and number: mean over all cases; small tick: one case"
)

# The look of the band from the 10th to the 90th percentile of the runs.
BAND: Any = {"alpha": 0.3, "linewidth": 0}


def plot_scores(
    scores: Mapping[str, Estimate],
    estimates: pd.DataFrame,
    controllers: Mapping[str, ControllerSpec],
    path: Path,
) -> None:
    """Draw the scores of controllers: a row for each controller, on a common axis of scores.

    Each row has a large marker at the overall score of the controller, and a small tick at the
    controller's score in each scenario.

    Parameters
    ----------
    scores : mapping
        Overall score of each controller by name, the highest score first.
    estimates : pandas.DataFrame
        The table that `estimates.estimate` returns.
    controllers : mapping
        Record of each controller by name.
    path : Path
        The PNG file.
    """
    best, *_ = scores
    title = f"{controllers[best].label} has the highest score, {scores[best].value:.3f}"
    cases = estimates["scenario"].nunique()
    labels = []
    height = 1.5 + 0.3 * len(scores)  # inches: title and axis, and the rows
    with open_picture(path, height, title) as figure:
        axes = figure.subplots()
        for row, (agent, score) in enumerate(scores.items()):
            colour, marker = controllers[agent].look
            scores_of_runs = estimates.loc[estimates["agent"] == agent, "scores"]
            scenario_scores = [float(np.mean(values)) for values in scores_of_runs]
            labels.append(controllers[agent].label)
            if len(scenario_scores) < cases:
                labels[row] += f"\n({len(scenario_scores)} of {cases} cases)"
            rows = np.full(len(scenario_scores), row)
            tick: Any = {"color": colour, "marker": "|", "ms": 9, "mew": 1.4, "ls": ""}
            axes.plot(distance(scenario_scores), rows, **tick)
            axes.plot(distance(score.value), row, color=colour, marker=marker, ms=6.5)
            right_of_axes = (1.01, row)
            text = f"{score.value:.3f}"
            axes.annotate(text, right_of_axes, xycoords=("axes fraction", "data"), va="center")
        axes.set_yticks(range(len(scores)), labels)
        axes.set_ylim(len(scores) - 0.5, -0.5)  # The first controller has the top row.
        axes.set_xscale("log")
        lowest, *others, highest = [f"{tick:g}" for tick in SCORE_TICKS]
        tick_labels = [f"≤ {lowest}", *others, f"≥ {highest}"]
        axes.set_xticks(distance(SCORE_TICKS), tick_labels)
        axes.set_xlim(1.15, 0.00087)
        axes.xaxis.set_minor_locator(NullLocator())
        axes.set_xlabel(SCORE_LABEL)


def distance(scores: ArrayLike) -> NDArray[np.float64]:
    """Return 1 minus each score, for a logarithmic axis from the first to the last tick."""
    return 1.0 - np.clip(scores, SCORE_TICKS[0], SCORE_TICKS[-1])


def plot_responses(
    responses: pd.DataFrame,
    errors: pd.Series[float],
    scenario: Scenario,
    controllers: Mapping[str, ControllerSpec],
    path: Path,
) -> None:
    """Draw the temperature and the flow over time, in a row of panels for each controller.

    The controller with the smallest mean error has the top row.

    Parameters
    ----------
    responses : pandas.DataFrame
        The rows of all controllers to draw, from the tables `runs.Result.responses`.
    errors : pandas.Series
        Mean error of each controller in the scenario, degC, by the name of the controller.
    scenario : Scenario
    controllers : mapping
        Record of each controller by name.
    path : Path
        The PNG file.
    """
    errors_drawn = errors[responses["agent"].unique()].sort_values(kind="stable")
    agents = list(errors_drawn.index)
    title = scenario.title
    if len(agents) > 1:
        best = controllers[agents[0]].label
        worst = controllers[agents[-1]].label
        ratio = errors_drawn.iloc[-1] / errors_drawn.iloc[0]
        title += f": {worst} has {ratio:.1f} times the mean error of {best}"
    height = 1.4 + 1.25 * len(agents)  # inches: title and legend, and the rows
    with open_picture(path, height, title) as figure:
        # Matplotlib would need more time to place the panels than to draw them.
        figure.set_layout_engine("none")
        heading = 0.4 + 0.16 * len(figure.get_suptitle().splitlines())  # inches
        edges = {
            "left": 0.11, "right": 0.98, "bottom": 0.8 / height, "top": 1.0 - heading / height
        }  # fmt: skip
        grid = figure.subplots(
            len(agents),
            2,
            sharex=True,
            sharey="col",
            squeeze=False,
            gridspec_kw={**edges, "hspace": 0.4, "wspace": 0.3},
        )
        for (temperature_axes, flow_axes), agent in zip(grid, agents, strict=True):
            rows = responses[responses["agent"] == agent]
            colour, _ = controllers[agent].look
            label = controllers[agent].label
            temperature_axes.set_title(f"{label}: mean error {errors[agent]:.3f} °C")
            _draw_temperature(temperature_axes, rows, colour)
            _draw_flow(flow_axes, rows, colour, scenario.parameters)
        for axes in grid[-1]:
            axes.set_xlabel("time (min)")
            axes.set_xlim(0.0, responses["time_s"].max() / 60.0)
        entries = _legend_of_responses(scenario.parameters)
        figure.legend(
            list(entries.values()),
            list(entries),
            loc="lower center",
            ncols=4,
            columnspacing=1.5,
        )


def _draw_temperature(axes: Axes, rows: pd.DataFrame, colour: str) -> None:
    """Draw the set point, the temperature of the first run, and the 10th to 90th percentile.

    `rows` are the rows of one controller in the argument `responses` of `plot_responses`.
    """
    minutes = rows["time_s"] / 60.0
    axes.fill_between(minutes, rows["output_p10"], rows["output_p90"], color=colour, **BAND)
    axes.plot(minutes, rows["output_run"], color=colour, linewidth=1.2)
    axes.step(minutes, rows["setpoint"], where="post", **SETPOINT)
    axes.set_ylabel("temperature\n(°C)")


def _draw_flow(axes: Axes, rows: pd.DataFrame, colour: str, plant: Parameters) -> None:
    """Draw the applied flow of the first run, the dead zone, and the limits of the flow.

    `rows` are the rows of one controller in the argument `responses` of `plot_responses`. If
    the dead zone of the plant is a range of values, the picture shows the smallest value.
    """
    dead_zone = plant.range_of("dead_zone")[0]
    axes.axhspan(-dead_zone, dead_zone, **DEAD_ZONE)
    for limit in (plant.range_of("u_min")[0], plant.range_of("u_max")[0]):
        axes.axhline(limit, **LIMIT)
    minutes = rows["time_s"] / 60.0
    axes.step(minutes, rows["applied_run"], where="post", color=colour, linewidth=1.0)
    axes.set_ylabel("applied flow\n(t/h)")


def _legend_of_responses(plant: Parameters) -> dict[str, Any]:
    """Return the legend of `plot_responses`: matplotlib's lines and patches, by their texts."""
    run = Line2D([], [], color="black", linewidth=1.2)
    band = Patch(color="black", **BAND)
    smallest = "smallest " if "dead_zone" in plant.ranges else ""
    return {
        "set point": Line2D([], [], **SETPOINT),
        "line: first run; band: 10th to 90th percentile": (band, run),
        f"{smallest}dead zone": Patch(**DEAD_ZONE),
        "flow limits": Line2D([], [], **LIMIT),
    }
