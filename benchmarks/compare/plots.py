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

from benchmarks.controllers.roster import GROUPS, ControllerSpec
from benchmarks.lib.pictures import DEAD_ZONE, LIMIT, SETPOINT, open_picture
from benchmarks.lib.statistics import Estimate
from benchmarks.loop.scenarios import Scenario
from mptc_gym import Parameters

SCORE_LABEL = (
    "score: 0 for an idle valve, 1 for the reference error\n"
    "marker and number: mean over all cases; tick: one case; open marker: learns in the run"
)
# A picture with more controllers than `MOST_PICTURED` would be too high.
MOST_PICTURED = 8
PAPER_CONTROLLERS = "nn", "pi"  # which case pictures compare

# The look of the band from the 10th to the 90th percentile of the runs.
BAND: Any = {"alpha": 0.3, "linewidth": 0}


def plot_scores(
    scores: Mapping[str, Estimate],
    estimates: pd.DataFrame,
    controllers: Mapping[str, ControllerSpec],
    path: Path,
) -> None:
    """Draw the scores of controllers: a row for each controller, on a common axis of scores.

    Controllers with equal prior knowledge stand together under a heading, those with the
    highest score first. Each row has a marker at the overall score of the controller, and a
    small tick at the controller's score in each scenario. Scores below 0 are drawn at 0.

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
    agents_of: dict[str, list[str]] = {group: [] for group in GROUPS}
    for agent in scores:
        agents_of[controllers[agent].group].append(agent)
    shown = {group: agents for group, agents in agents_of.items() if agents}
    # The agents of a group are in the order of `scores`, the best one first.
    best = [f"{group} {scores[agents[0]].value:.3f}" for group, agents in shown.items()]
    title = f"Best score by prior knowledge: {', '.join(best)}"
    cases = estimates["scenario"].nunique()
    labels = {}
    row = 0
    with open_picture(path, 1.4 + 0.24 * (len(scores) + len(shown)), title) as figure:
        axes = figure.subplots()
        for group, agents in shown.items():
            look = GROUPS[group]
            heading = (0.008, row)
            place: Any = {"xycoords": ("axes fraction", "data"), "va": "center"}
            axes.annotate(look.title, heading, color=look.colour, weight="bold", **place)
            row += 1
            for agent in agents:
                scores_of_runs = estimates.loc[estimates["agent"] == agent, "scores"]
                # Scores of the members' runs, an array for each case.
                of_cases = np.maximum([np.mean(values) for values in scores_of_runs], 0.0)
                line: Any = {"color": look.colour, "marker": "|", "ms": 8, "lw": 1.3}
                axes.plot(of_cases, np.full(len(of_cases), row), **line)
                face = "white" if controllers[agent].learns else look.colour
                mean: Any = {"color": look.colour, "marker": look.marker, "ms": 7}
                axes.plot(max(scores[agent].value, 0.0), row, markerfacecolor=face, **mean)
                axes.annotate(f"{scores[agent].value:.3f}", (1.01, row), **place)
                labels[row] = controllers[agent].label
                if len(of_cases) < cases:
                    labels[row] += f" ({len(of_cases)} of {cases} cases)"
                row += 1
        axes.set_yticks(list(labels), list(labels.values()))
        axes.set_ylim(row - 0.4, -0.6)  # The first group has the top rows.
        axes.grid(visible=False, axis="y")
        axes.set_xlabel(SCORE_LABEL)


def plot_responses(
    responses: pd.DataFrame,
    errors: pd.Series[float],
    scenario: Scenario,
    controllers: Mapping[str, ControllerSpec],
    path: Path,
) -> None:
    """Draw the temperature and the flow over time, in a row of panels for each controller.

    The controllers of the paper have the top rows, and the others follow in the order of their
    mean errors. The title compares those of the paper, or else the worst and the best.

    Parameters
    ----------
    responses : pandas.DataFrame
        The rows of all controllers, from the tables `cases.Result.responses`.
    errors : pandas.Series
        Mean error of each controller in the scenario, degC, by the name of the controller.
    scenario : Scenario
    controllers : mapping
        Record of each controller by name.
    path : Path
        The PNG file.
    """
    agents = pictured(errors, controllers)
    errors = errors[agents]
    title = scenario.title
    if len(agents) > 1:
        compared = [agent for agent in PAPER_CONTROLLERS if agent in agents]
        if len(compared) < 2:  # not both controllers of the paper are drawn
            compared = agents
        best = min(compared, key=errors.__getitem__)
        worst = max(compared, key=errors.__getitem__)
        title += (
            f": {controllers[worst].label} has {errors[worst] / errors[best]:.1f} times "
            f"the mean error of {controllers[best].label}"
        )
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
            colour = GROUPS[controllers[agent].group].colour
            label = controllers[agent].label
            temperature_axes.set_title(f"{label}: mean error {errors[agent]:.3f} °C")
            flow_axes.set_title(controllers[agent].prior_knowledge)
            _draw_temperature(temperature_axes, rows, colour)
            _draw_flow(flow_axes, rows, colour, scenario.parameters)
        for axes in grid[-1]:  # the bottom row, whose time axis all rows share
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


def pictured(errors: pd.Series[float], controllers: Mapping[str, ControllerSpec]) -> list[str]:
    """Return the names of the controllers to draw in a case, in the order of their rows.

    `errors` has the mean error of each controller. Of more than `MOST_PICTURED` controllers,
    only those of the paper, the best one that knows a step test, PPO and users' own are drawn.
    """
    agents = [str(agent) for agent in errors.sort_values(kind="stable").index]
    first = [agent for agent in PAPER_CONTROLLERS if agent in agents]
    others = [agent for agent in agents if agent not in first]
    if len(agents) > MOST_PICTURED:
        tested = [agent for agent in others if controllers[agent].group == "step test"]
        own = [agent for agent in others if controllers[agent].group == "own"]
        others = [*tested[:1], *(agent for agent in others if agent == "ppo"), *own]
    return first + others


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
    dead_zone = plant.lowest.dead_zone
    axes.axhspan(-dead_zone, dead_zone, **DEAD_ZONE)
    for limit in (plant.lowest.u_min, plant.lowest.u_max):  # which are never ranges
        axes.axhline(limit, **LIMIT)
    minutes = rows["time_s"].to_numpy() / 60.0
    flows = rows["applied_run"].to_numpy()
    # Jumps, such as those across the dead zone, are thin, so that they do not hide the flow.
    axes.step(minutes, flows, where="post", color=colour, linewidth=0.4)
    # Each flow holds until the next sample.
    axes.hlines(flows[:-1], minutes[:-1], minutes[1:], color=colour, linewidth=1.4)
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
