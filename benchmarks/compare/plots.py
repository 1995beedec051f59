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

from benchmarks.compare.comparison import Scale, Score
from benchmarks.controllers.roster import label, looks
from benchmarks.lib.report import (
    MULTIPLE,
    NEAREST,
    draw_actuator,
    draw_legend,
    drawn,
    panels,
    scale_by_excess,
)
from benchmarks.lib.statistics import groups, written
from benchmarks.loop.scenarios import Scenario

FARTHEST = 1.5  # distance of a score from 1 at which the axis ends
NEAR = 0.02  # of the best score, for the least valve travel
HELD = 15  # minutes that are shown of a held set point without load
GREY: Any = {"color": "0.4"}
EDGE = "at the edge or beyond"


def plot_scores(scores: Mapping[str, Score], told: Sequence[str], path: Path) -> None:
    """Draw the score of every agent, sorted, and small marks for its cases.

    The title names the best of those that are not `told` the whole plant.
    """
    style = looks([*scores])
    with drawn(path, 1.2 + 0.3 * len(scores), closest(scores, told)) as figure:
        axes = figure.subplots()
        for place, (agent, (overall, by_case)) in enumerate(scores.items()):
            away = np.clip([1.0 - score for score in by_case.values()], NEAREST, FARTHEST)
            axes.plot(away, [place] * len(away), "|", color=style[agent][0], alpha=0.5)
            _mark(axes, 1.0 - overall.value, place, style[agent], across=True)
            text = written(overall.value, ".3f")
            axes.annotate(text, (1.01, place), xycoords=("axes fraction", "data"), va="center")
        _list_agents(axes, [*scores])
        axes.set_xscale("log")
        axes.set_xlim(1.1 * FARTHEST, NEAREST / 1.3)
        shown = (1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002, NEAREST)
        axes.set_xticks(shown, [f"{1 - away:g}" for away in shown])
        axes.xaxis.set_minor_locator(NullLocator())
        axes.set_xlabel(
            "score: 0 without control, 1 at the least possible error (log scale of 1 - score)\n"
            f"a tick is one case; hollow: {EDGE}"
        )


def closest(scores: Mapping[str, Score], told: Sequence[str]) -> str:
    """Return which controller has the best score of those that are not told the plant."""
    said = {
        agent: f"{label(agent)}: {overall.value:.3f}" for agent, (overall, _) in scores.items()
    }
    best = next((agent for agent in said if agent not in told), None)
    if best is None:
        return f"Score of {next(iter(said.values()))}, told the plant"
    others = [said[agent] for agent in said if agent in told]
    more = f" ({', '.join(others)}, told the plant)" if others else ""
    among = "Closest to the least possible error is " if len(said) > 1 else "Score of "
    return f"{among}{said[best]}{more}"


def _mark(
    axes: Axes, x: float, y: float, look: tuple[str, str], *, across: bool, size: int = 6
) -> None:
    """Draw a marker, hollow at an edge of the axis (`across` or up) that it would be beyond."""
    value = x if across else y
    inside = min(max(value, NEAREST), FARTHEST if size == 6 and across else math.inf)
    place = (inside, y) if across else (x, inside)
    face = look[0] if inside == value else "white"
    axes.plot(*place, look[1], color=look[0], markerfacecolor=face, markersize=size)


def plot_bounds(
    estimates: pd.DataFrame,
    worst: Mapping[tuple[str, str], float],
    agents: Sequence[str],
    told: Sequence[str],
    path: Path,
) -> None:
    """Draw mean errors as multiples of the least possible, with intervals and worst runs."""
    style, cases = looks(agents), dict(groups(estimates, "scenario"))
    height = 0.8 + 0.17 * len(agents)
    with panels(path, [*cases], height, 2, least(estimates, told)) as (figure, found, free):
        for i, (axes, (case, rows)) in enumerate(zip(found, cases.items(), strict=True)):
            farthest = NEAREST
            for row in rows.to_dict("records"):
                place, look, ratio = (
                    agents.index(row["agent"]),
                    style[row["agent"]],
                    row["ratio"],
                )
                ends = worst[case, row["agent"]] / row["limit"], ratio.low, ratio.high
                end, low, high = (max(each - 1.0, NEAREST) for each in ends)
                mean = max(ratio.value - 1.0, NEAREST)
                axes.plot([mean, end], [place] * 2, color=look[0], alpha=0.4, linewidth=1)
                if math.isfinite(high):
                    axes.plot([low, high], [place] * 2, color=look[0], linewidth=3)
                _mark(axes, ratio.value - 1.0, place, look, across=True, size=5)
                farthest = max(farthest, mean, end)
            _list_agents(axes, agents)
            axes.tick_params(labelleft=i % 2 == 0)
            scale_by_excess(axes, "x", NEAREST, farthest)
        for axes in found[-2:]:  # the lowest of each column
            axes.set_xlabel(MULTIPLE)
        entries = {
            "mean error of all runs": Line2D([], [], marker="o", linestyle="", **GREY),
            EDGE: Line2D([], [], marker="o", linestyle="", markerfacecolor="white", **GREY),
            "95 % interval of the mean": Line2D([], [], linewidth=3, **GREY),
            "to the worst run": Line2D([], [], linewidth=1, alpha=0.4, **GREY),
        }
        draw_legend(figure, free, entries)


def least(estimates: pd.DataFrame, told: Sequence[str]) -> str:
    """Return which controller most often has the least error, of those not told the plant."""
    means = estimates.assign(value=[mean.value for mean in estimates["mean"]])
    others = means[~means["agent"].isin(told)]
    means = means if others.empty else others
    aside = ", " + ", ".join(map(label, told)) + " aside" if len(means) < len(estimates) else ""
    best = means.loc[means.groupby("scenario", sort=False)["value"].idxmin(), "agent"]
    name = best.mode()[0]
    count = (best == name).sum()
    where = "every case" if count == len(best) else f"{count} of {len(best)} cases"
    return f"{label(name)} has the least mean error in {where}{aside}"


def _list_agents(axes: Axes, agents: Sequence[str]) -> None:
    axes.set_yticks(range(len(agents)), [label(agent) for agent in agents])
    axes.set_ylim(len(agents) - 0.5, -0.5)


def plot_travel(
    summary: pd.DataFrame,
    scales: Mapping[str, Scale],
    scores: Mapping[str, Score],
    path: Path,
) -> None:
    """Draw the error of every agent against its valve travel, a panel for each case.

    `summary` is what `comparison.summarise` returns. A valve that never moves is not drawn.
    """
    medians = summary.pivot_table(
        index=["scenario", "agent"], columns="metric", values="median", sort=False
    ).reset_index()
    medians = medians[(medians["total_variation"] > 0.0) & medians["scenario"].isin([*scales])]
    if medians.empty:
        return
    style, cases = looks([*scores]), dict(groups(medians, "scenario"))
    title = calmest(medians.groupby("agent")["total_variation"].mean(), scores)
    with panels(path, [*cases], 2.4, 2, title) as (figure, found, free):
        for axes, (case, rows) in zip(found, cases.items(), strict=True):
            travel = rows["total_variation"]
            excess = rows["mae"] / scales[case].least.value - 1.0
            for agent, x, y in zip(rows["agent"], travel, excess, strict=True):
                _mark(axes, x, y, style[agent], across=False)
            scale_by_excess(axes, "y", *excess.clip(NEAREST).agg(["min", "max"]))
            axes.set_xscale("log")
            axes.set_xlim(0.7 * travel.min(), 1.4 * travel.max())
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
        draw_legend(figure, free, entries)


def calmest(travels: Any, scores: Mapping[str, Score]) -> str:
    """Return which controller near the best score moves the valve least, "" if none moves."""
    best = max(overall.value for overall, _ in scores.values())
    near = [agent for agent in travels.index if scores[agent][0].value >= best - NEAR]
    if not near:
        return ""
    calm = str(travels[near].idxmin())
    if len(near) == 1:
        return f"{label(calm)} alone is near the best score: {travels[calm]:,.0f} t/h a run"
    return (
        f"Of {len(near)} controllers within {NEAR} of the best score, {label(calm)} moves the "
        f"valve least: {travels[calm]:,.0f} t/h a run"
    )


def plot_responses(
    responses: pd.DataFrame, errors: Mapping[str, float], scenario: Scenario, path: Path
) -> None:
    """Draw output and applied input over time, a row of panels for every agent, best first.

    Where the set point is held, the error is drawn in place of the output, and of a run without
    load only the beginning. `responses` holds the rows of all agents, `errors` their mean
    errors.
    """
    agents, plant = sorted(errors, key=errors.__getitem__), scenario.parameters
    held = responses["setpoint"].nunique() == 1
    if held:
        if not plant.is_disturbed:
            responses = responses[responses["time_s"] <= 60 * HELD]
        low, high = (responses["setpoint"] - responses[f"output_{p}"] for p in ("p90", "p10"))
        middle = responses["setpoint"] - responses["output_median"]
        errors_of: dict[str, Any] = {"setpoint": 0.0, "output_p10": low, "output_p90": high}
        responses = responses.assign(output_median=middle, **errors_of)
    height = 1.0 + 1.05 * len(agents)
    title = f"{scenario.title}: {label(agents[0])} errs least"
    with drawn(path, height, title) as figure:
        figure.set_layout_engine("none")  # which would take most of the time
        place = {"left": 0.09, "right": 0.98, "wspace": 0.14, "hspace": 0.5}
        place |= {"bottom": 0.55 / height, "top": 1 - 0.7 / height}
        rows_of = figure.subplots(
            len(agents), 2, sharex=True, sharey="col", squeeze=False, gridspec_kw=place
        )
        for (left, right), agent in zip(rows_of, agents, strict=True):
            rows, (colour, _) = responses[responses["agent"] == agent], looks(agents)[agent]
            minutes = rows["time_s"] / 60
            left.step(minutes, rows["setpoint"], "k--", linewidth=0.8, where="post")
            band = minutes, rows["output_p10"], rows["output_p90"]
            left.fill_between(*band, color=colour, alpha=0.3, linewidth=0)
            left.plot(minutes, rows["output_median"], color=colour, linewidth=1.2)
            left.set_title(f"{label(agent)}: {errors[agent]:.3f} °C")
            draw_actuator(right, plant)
            right.step(minutes, rows["applied_median"], color=colour, linewidth=1, where="post")
        left.set_xlim(0, minutes.max())
        if held and plant.is_disturbed:
            left.set_ylim(-2.0, 2.0)  # of the loads; the first step is beyond
        rows_of[0, 1].set_title("applied flow (t/h); grey: dead zone")
        figure.supylabel("error (°C)" if held else "temperature (°C)", fontsize="medium")
        shown = "lines: medians, bands: 10th to 90th percentile"
        if plant.setpoint == "random":
            shown = "the first run; the errors are means of all"
        figure.supxlabel(f"time (min); {shown}", fontsize="medium")
