"""Draw the pictures of a comparison from the tables that it writes.

The title of each picture states what its data show.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator, NullLocator
from numpy.typing import ArrayLike, NDArray

from benchmarks.controllers.roster import label, looks
from benchmarks.lib.pictures import (
    DEAD_ZONE,
    LIMIT,
    RATIO_LABEL,
    SETPOINT,
    excess,
    open_panels,
    open_picture,
    percent,
    scale_by_ratio,
)
from benchmarks.lib.statistics import Estimate, written
from benchmarks.loop.scenarios import Scenario
from mptc_gym import Parameters

# Scores between which the axis of scores reaches. Others are drawn at its ends.
LOWEST_SCORE = -0.5
HIGHEST_SCORE = 0.999
SCORE_TICKS = LOWEST_SCORE, 0.0, 0.5, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995, 0.998, HIGHEST_SCORE
SCORE_LABEL = (
    "score: 0 = idle valve, 1 = lowest achievable error (axis logarithmic in 1 minus the score)"
)

BAND: Any = {"alpha": 0.3, "linewidth": 0}  # how the range of most runs is drawn

MARKER_SIZES = {"*": 8.0, "D": 5.0}  # points, so that they look as large as others of 6 points
NEARLY_BEST = 1.05  # An error counts as nearly the smallest of a case up to this multiple.


def plot_scores(scores: Mapping[str, Estimate], estimates: pd.DataFrame, path: Path) -> None:
    """Draw the score of each controller, in the given order, and its score in each case.

    Parameters
    ----------
    scores : mapping
        The mean score over all cases for each controller, the best first.
    estimates : pandas.DataFrame
        A row for each case and controller, as `comparison.estimate` returns it.
    path : Path
        The PNG file.
    """
    marks = marks_of([*scores])
    shown = [score.value for score in scores.values()]
    with open_picture(path, 1.3 + 0.3 * len(scores), scores_finding(scores)) as figure:
        axes = figure.subplots()
        for row, (agent, score) in enumerate(scores.items()):
            mark = marks[agent]
            of_runs = estimates.loc[estimates["agent"] == agent, "scores"]
            cases = [float(np.mean(values)) for values in of_runs]
            shown += cases
            height = np.full(len(cases), row)
            axes.plot(distance(cases), height, "|", color=mark["color"], ms=9, mew=1.4)
            axes.plot(distance(score.value), row, **mark)
            place = (1.01, row)  # right of the axes
            text = written(score.value, ".3f")
            axes.annotate(text, place, xycoords=("axes fraction", "data"), va="center")
        axes.set_yticks(range(len(scores)), [label(agent) for agent in scores])
        axes.set_ylim(len(scores) - 0.5, -0.5)
        _scale_by_score(axes, shown)
        caption = SCORE_LABEL
        if estimates["scenario"].nunique() > 1:
            caption += "\nlarge marker and number: mean over the cases; small tick: one case"
        axes.set_xlabel(caption)


def scores_finding(scores: Mapping[str, Estimate]) -> str:
    """Return a sentence that says who scores highest and lowest."""
    names = [label(agent) for agent in scores]
    values = [written(score.value, ".3f") for score in scores.values()]
    first = f"{names[0]} scores highest with {values[0]}"
    last = f"{names[-1]} scores lowest with {values[-1]}"
    if len(scores) == 1:
        return f"{names[0]} scores {values[0]}"
    if len(scores) == 2:
        return f"{first}; {last}"
    return f"{first}, {names[1]} follows with {values[1]}; {last}"


def marks_of(agents: Sequence[str]) -> dict[str, Any]:
    """Return how the marker of each controller is drawn: arguments of `Axes.plot`."""
    marks = {}
    for agent, (colour, marker) in looks(agents).items():
        size = MARKER_SIZES.get(marker, 6.0)
        marks[agent] = {"color": colour, "marker": marker, "ms": size, "linestyle": ""}
    return marks


def distance(scores: ArrayLike) -> NDArray[np.float64]:
    """Return 1 minus each score, of scores moved to the nearest end of the axis."""
    return 1.0 - np.clip(scores, LOWEST_SCORE, HIGHEST_SCORE)


def _scale_by_score(axes: Axes, shown: Sequence[float]) -> None:
    """Make the x axis, of `distance(scores)`, logarithmic, with scores as its ticks."""
    labels = [f"{score:g}" for score in SCORE_TICKS]
    if min(shown) < LOWEST_SCORE:
        labels[0] = f"< {labels[0]}"
    if max(shown) > HIGHEST_SCORE:
        labels[-1] = f"> {labels[-1]}"
    start = 1.15 * float(distance(min(0.0, *shown)))
    end = float(distance(HIGHEST_SCORE)) / 1.3
    axes.set_xscale("log")
    axes.set_xticks(distance(SCORE_TICKS), labels)
    axes.set_xlim(start, end)
    axes.xaxis.set_minor_locator(NullLocator())


def plot_travel(
    runs: pd.DataFrame, estimates: pd.DataFrame, agents: Sequence[str], path: Path
) -> None:
    """Draw the mean error and the mean valve travel of each controller that moves the valve.

    Parameters
    ----------
    runs : pandas.DataFrame
        A row for each run, with `scenario`, `agent`, `mae` and `total_variation`.
    estimates : pandas.DataFrame
        A row for each case and controller; `limit` is the lowest achievable error of the case.
    agents : sequence of str
        The controllers in the order of the legend.
    path : Path
        The PNG file. None is written if no controller moves the valve.
    """
    means = travel_means(runs, estimates)
    if means.empty:
        return
    marks = marks_of([agent for agent in agents if agent in set(means["agent"])])
    cases = [str(case) for case in means["scenario"].unique()]
    with open_panels(path, cases, 2.4, 2, travel_finding(means)) as panels:
        for axes, case in zip(panels.axes, cases, strict=True):
            rows = means[means["scenario"] == case]
            for agent, travel, ratio in zip(
                rows["agent"], rows["travel"], rows["ratio"], strict=True
            ):
                axes.plot(travel, excess(ratio), **marks[agent])
            scale_by_ratio(axes, "y", rows["ratio"])
            _scale_by_travel(axes, rows["travel"])
        entries: dict[str, Artist] = {}
        for agent, mark in marks.items():
            entries[label(agent)] = Line2D([], [], **mark)
        panels.label_edges("valve travel of a run (t/h, logarithmic axis)", RATIO_LABEL)
        panels.add_legend(entries, columns=4)


def travel_means(runs: pd.DataFrame, estimates: pd.DataFrame) -> pd.DataFrame:
    """Return the means over the runs of each case and controller that moves the valve.

    The columns are `scenario`, `agent`, `ratio` (the mean error divided by the lowest
    achievable one) and `travel` (t/h).
    """
    means = runs.groupby(["scenario", "agent"], sort=False)[["mae", "total_variation"]].mean()
    means = means.reset_index().rename(columns={"total_variation": "travel"})
    limits = estimates.groupby("scenario")["limit"].first()
    means["ratio"] = means["mae"] / means["scenario"].map(limits)
    return means[means["travel"] > 0.0]


def travel_finding(means: pd.DataFrame) -> str:
    """Return a sentence that says whose error is small with little valve travel.

    `means` are those of `travel_means`. In each case, it looks for the controller that moves
    the valve least among those with nearly the smallest error.
    """
    if means["agent"].nunique() == 1:
        return f"Mean error and valve travel of {label(means['agent'].iloc[0])}"
    sparing = []
    for _, rows in means.groupby("scenario", sort=False):
        good = rows[rows["mae"] <= NEARLY_BEST * rows["mae"].min()]
        sparing.append(good.sort_values("travel")["agent"].iloc[0])
    counts = pd.Series(sparing).value_counts(sort=True)
    where = ""
    if len(sparing) > 1:
        where = f" in {counts.iloc[0]} of {len(sparing)} cases"
    return (
        f"Among the controllers with an error within {percent(NEARLY_BEST - 1.0)} of the "
        f"smallest, {label(counts.index[0])} moves the valve least{where}"
    )


def _scale_by_travel(axes: Axes, travels: pd.Series[float]) -> None:
    """Make the x axis, of valve travel in t/h, logarithmic."""
    axes.set(xscale="log", xlim=(0.7 * travels.min(), 1.4 * travels.max()))
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_locator(NullLocator())


def plot_responses(
    responses: pd.DataFrame, errors: pd.Series[float], scenario: Scenario, path: Path
) -> None:
    """Draw temperature and flow over a whole run, a row for each controller, the best first.

    Parameters
    ----------
    responses : pandas.DataFrame
        A row for each controller and sample, as `comparison.run_case` returns it.
    errors : pandas.Series
        Mean error of each controller, degC.
    scenario : Scenario
        The case.
    path : Path
        The PNG file.
    """
    agents = errors[responses["agent"].unique()].sort_values(kind="stable").index
    styles = looks([*agents])
    title = f"{scenario.title}: {responses_finding(errors[agents])}"
    with open_picture(path, 1.2 + 1.25 * len(agents), title) as figure:
        grid = figure.subplots(len(agents), 2, sharex=True, sharey="col", squeeze=False)
        for (left, right), agent in zip(grid, agents, strict=True):
            rows = responses[responses["agent"] == agent]
            colour, _ = styles[agent]
            left.set_title(f"{label(agent)}: mean error {errors[agent]:.3f} °C")
            _draw_temperature(left, rows, colour)
            _draw_flow(right, rows, colour, scenario.parameters)
        for axes in grid[-1]:
            axes.set_xlabel("time (min)")
            axes.set_xlim(0.0, responses["time_s"].max() / 60.0)
        entries = _legend_of_responses(responses, scenario.parameters)
        figure.legend(
            list(entries.values()), list(entries), loc="outside lower center", ncols=4
        )


def responses_finding(errors: pd.Series[float]) -> str:
    """Return a sentence on the smallest and the largest of some errors, in rising order."""
    best = str(errors.index[0])
    worst = str(errors.index[-1])
    if best == worst:
        return f"the mean error of {label(best)} is {errors[best]:.3f} °C"
    multiple = errors[worst] / errors[best]
    return f"the mean error of {label(worst)} is {multiple:.1f} times that of {label(best)}"


def _draw_temperature(axes: Axes, rows: pd.DataFrame, colour: str) -> None:
    """Draw the set point, the first run, and where most of the runs are."""
    minutes = rows["time_s"] / 60.0
    axes.fill_between(minutes, rows["output_p10"], rows["output_p90"], color=colour, **BAND)
    axes.plot(minutes, rows["output_run"], color=colour, linewidth=1.2)
    axes.step(minutes, rows["setpoint"], where="post", **SETPOINT)
    axes.set_ylabel("temperature\n(°C)")


def _draw_flow(axes: Axes, rows: pd.DataFrame, colour: str, plant: Parameters) -> None:
    """Draw the applied flow of the first run, with the dead zone and the limits of the flow.

    Where these are randomised, the smallest dead zone and the widest limits are drawn.
    """
    dead_zone = plant.range_of("dead_zone")[0]
    axes.axhspan(-dead_zone, dead_zone, **DEAD_ZONE)
    for limit in (plant.range_of("u_min")[0], plant.range_of("u_max")[1]):
        axes.axhline(limit, **LIMIT)
    minutes = rows["time_s"] / 60.0
    axes.step(minutes, rows["applied_run"], where="post", color=colour, linewidth=1.0)
    axes.set_ylabel("applied flow\n(t/h)")


def _legend_of_responses(responses: pd.DataFrame, plant: Parameters) -> dict[str, Any]:
    """Return what stands for the lines and areas that are drawn of a case, by its text."""
    is_spread = bool((responses["output_p90"] > responses["output_p10"]).any())
    run = Line2D([], [], color="black", linewidth=1.2)
    band = Patch(color="black", **BAND)
    entries: dict[str, Any] = {"set point": Line2D([], [], **SETPOINT)}
    if is_spread:
        entries["first run; 10th to 90th percentile of all"] = (band, run)
    elif plant.setpoint == "random":
        entries["first run"] = run
    smallest = "smallest " if "dead_zone" in plant.ranges else ""
    entries[f"{smallest}dead zone"] = Patch(**DEAD_ZONE)
    widest = "widest " if {"u_min", "u_max"} & set(plant.ranges) else ""
    entries[f"{widest}limits"] = Line2D([], [], **LIMIT)
    return entries
