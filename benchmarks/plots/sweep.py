"""Draw the results of a sweep, which runs controllers on many plants.

If the plants differ only in delay and gain, the picture has maps of the error ratio over delay
and gain. Otherwise, the picture has a curve of the sorted error ratios for each controller. An
error ratio is a mean error divided by the least possible mean error.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from benchmarks.controllers.roster import label, looks
from benchmarks.lib.pictures import (
    RATIO_LABEL,
    excess,
    open_picture,
    percent,
    scale_by_ratio,
)
from mptc_gym import Parameters

NEAR_RATIO = 1.05  # largest error ratio that counts as near the least possible error
# A plant has a mark in the map if the loop oscillates, or control is no better than an idle
# valve, in at least this share of the runs.
MARKED_SHARE = 0.5
MOST_COLUMNS = 3  # number of maps in a row
RATIO_CLASSES = 1.0, 1.02, 1.05, 1.1, 1.2, 1.5, 2.0  # error ratios at which the colour changes
COLOUR_MAP = "viridis_r"  # light for small error ratios, dark for large ones
NO_RATIO_COLOUR = "0.85"  # colour of a plant without a least possible error
# The mark of a plant on which the loop oscillates.
OSCILLATION_MARK: Any = {
    "color": "white",
    "marker": "o",
    "mec": "black",
    "ms": 3,
    "linestyle": "",
}
USELESS_COLOUR = "#E31A1C"  # colour of a plant on which control is no better than an idle valve
# The mark of the nominal plant.
NOMINAL_MARK: Any = {"color": "black", "marker": "+", "ms": 12, "mew": 1.8, "linestyle": ""}


def draw(runs: pd.DataFrame, path: Path, nominal: Parameters) -> None:
    """Draw the error ratio of each controller on each plant, as maps or as sorted curves.

    An error ratio is the mean error of a controller on a plant divided by the least possible
    error. Maps are drawn if the plants differ only in delay and gain.

    Parameters
    ----------
    runs : pandas.DataFrame
        Table with a row for each run, as `benchmarks.sweep.table` returns it. The table has a
        column "dead_zone" if the plants differ not only in delay and gain.
    path : Path
        The PNG file.
    nominal : Parameters
        The nominal plant, of which all other plants are variations.
    """
    plants = plant_medians(runs)
    if "dead_zone" in runs:
        draw_sorted(plants, path)
    else:
        draw_map(plants, path, nominal)


def plant_medians(runs: pd.DataFrame) -> pd.DataFrame:
    """Return a table with a row for each controller and plant, the best controller first.

    The columns are `agent` (the controller), `plant`, `delay` (samples), `gain_factor`, `ratio`
    (the median error ratio of the runs), `oscillates` (the share of the runs that oscillate)
    and `useless` (the share of the runs whose error is at least the error of an idle valve).
    `runs` is a table with a row for each run, as `benchmarks.sweep.table` returns it.
    """
    groups = runs.groupby(["agent", "plant"], sort=False)
    plants = groups[["delay", "gain_factor"]].first()
    plants["ratio"] = groups["ratio"].median()
    plants[["oscillates", "useless"]] = groups[["oscillates", "useless"]].mean()
    plants = plants.reset_index()
    medians = plants.groupby("agent")["ratio"].median()
    return plants.sort_values("agent", key=lambda names: names.map(medians), kind="stable")


def draw_sorted(plants: pd.DataFrame, path: Path) -> None:
    """For each controller, draw a curve of its error ratios on all plants, sorted by size.

    Plants whose least possible error is unknown have no error ratio, and are left out of the
    curves.
    """
    plants = plants.dropna(subset=["ratio"])
    styles = looks(list(plants["agent"].unique()))
    with open_picture(path, 4.6, sorted_finding(plants)) as figure:
        axes = figure.subplots()
        for agent, (colour, marker) in styles.items():
            ratios = np.sort(plants.loc[plants["agent"] == agent, "ratio"])
            shares = 100.0 * (np.arange(len(ratios)) + 1.0) / len(ratios)
            look: Any = {"color": colour, "marker": marker, "ms": 5, "markevery": 0.1}
            axes.plot(shares, excess(ratios), label=label(agent), linewidth=1.3, **look)
        if styles:
            scale_by_ratio(axes, plants["ratio"])
            # The legend has the order of the curves: the worst controller is uppermost.
            figure.legend(loc="outside right center", reverse=True)
        axes.set_xlim(0.0, 100.0)
        axes.set_xlabel("share of the plants (%), sorted by the error ratio of each controller")
        axes.set_ylabel(RATIO_LABEL)


def sorted_finding(plants: pd.DataFrame) -> str:
    """Return the title of the curves: a sentence on 90th percentiles of the error ratios.

    The sentence names the two controllers with the smallest 90th percentiles over the plants,
    and the controller with the largest 90th percentile.
    """
    ratios = plants.groupby("agent")["ratio"].quantile(0.9).sort_values()
    if ratios.empty:
        return "No plant has a least possible error"
    texts = [f"{ratio:.2f} for {label(str(agent))}" for agent, ratio in ratios.items()]
    *smallest, largest = texts
    finding = "On nine plants out of ten, the error ratio is at most "
    if smallest:
        finding += f"{', '.join(smallest[:2])} and "
    return finding + largest


def draw_map(plants: pd.DataFrame, path: Path, nominal: Parameters) -> None:
    """Draw maps of the error ratio over delay and gain, one map for each controller.

    `plants` is the table that `plant_medians` returns. Each map has a mark at the nominal
    plant.
    """
    agents = list(plants["agent"].unique())
    columns = min(MOST_COLUMNS, len(agents))
    rows = math.ceil(len(agents) / columns)
    classes = BoundaryNorm(RATIO_CLASSES, ncolors=256, extend="max")
    # If delay or gain of the nominal plant has a range, the mark is at the middle of the range.
    nominal_delay = np.mean(nominal.range_of("delay"))
    nominal_gain = np.mean(nominal.range_of("gain_factor"))
    height = 1.5 + 1.9 * rows  # inches: title, legend and colour bar, and the rows
    with open_picture(path, height, map_finding(plants)) as figure:
        panels = figure.subplots(rows, columns, squeeze=False).ravel()
        for axes in panels[len(agents) :]:
            axes.set_axis_off()
        for number, agent in enumerate(agents):
            axes = panels[number]
            axes.set_title(label(agent))
            _draw_controller(axes, plants[plants["agent"] == agent], classes)
            axes.plot(nominal_delay, nominal_gain, **NOMINAL_MARK)
            if number % columns == 0:
                axes.set_ylabel("gain factor")
            if number >= len(agents) - columns:  # no panel below this one
                axes.set_xlabel("delay (samples)")
        marks = _legend_of_map(plants)
        figure.legend(
            list(marks.values()), list(marks), loc="outside lower center", ncols=MOST_COLUMNS
        )
        bar = figure.colorbar(
            ScalarMappable(classes, COLOUR_MAP),
            ax=list(panels),
            location="bottom",
            aspect=60,
        )
        bar.set_label("error ratio: mean error / least possible error")
        bar.set_ticks(RATIO_CLASSES, labels=[f"{ratio:g}" for ratio in RATIO_CLASSES])


def map_finding(plants: pd.DataFrame) -> str:
    """Return the title of the maps: a sentence on plants with nearly the least possible error.

    The sentence compares the shares of the plants on which each controller has an error ratio
    of at most `NEAR_RATIO`: the two largest shares, and an upper limit of all smaller shares.
    """
    bounded = plants.dropna(subset=["ratio"])  # plants with a least possible error
    is_near = bounded["ratio"] <= NEAR_RATIO
    shares = is_near.groupby(bounded["agent"]).mean()
    shares = shares.sort_values(ascending=False, kind="stable")
    if shares.empty:
        return "Where each controller oscillates"
    names = [label(str(agent)) for agent in shares.index]
    percentages = [percent(share) for share in shares]
    finding = (
        f"{names[0]} is within {percent(NEAR_RATIO - 1.0)} of the least possible error on "
        f"{percentages[0]} of the plants"
    )
    if len(names) > 1:
        finding += f", {names[1]} on {percentages[1]}"
    if len(names) > 2:
        finding += f", and every other controller on at most {percentages[2]}"
    return finding


def _draw_controller(axes: Axes, plants: pd.DataFrame, classes: BoundaryNorm) -> None:
    """Draw one controller's map: a cell for each plant, with marks where control fails.

    `plants` are the controller's rows of the table that `plant_medians` returns, and `classes`
    assigns a colour to each range of error ratios.
    """
    cells = plants.pivot(index="gain_factor", columns="delay", values=["ratio", "useless"])
    ratios = cells["ratio"]
    useless = cells["useless"].where(cells["useless"] >= MARKED_SHARE)  # NaN is transparent
    axes.set_facecolor(NO_RATIO_COLOUR)
    axes.grid(visible=False)
    axes.pcolormesh(ratios.columns, ratios.index, ratios, norm=classes, cmap=COLOUR_MAP)
    axes.pcolormesh(
        ratios.columns, ratios.index, useless, cmap=ListedColormap([USELESS_COLOUR])
    )
    marked = plants[(plants["oscillates"] >= MARKED_SHARE) & (plants["useless"] < MARKED_SHARE)]
    axes.plot(marked["delay"], marked["gain_factor"], **OSCILLATION_MARK)


def _legend_of_map(plants: pd.DataFrame) -> dict[str, Artist]:
    """Return the legend of the maps: matplotlib's lines and patches, by their texts.

    The legend always has the mark of the nominal plant. The legend has an entry for
    oscillation, for control that is no better than an idle valve, and for an unknown least
    possible error only if this occurs on a plant.
    """
    entries: dict[str, Artist] = {"the nominal plant": Line2D([], [], **NOMINAL_MARK)}
    if (plants["oscillates"] >= MARKED_SHARE).any():
        entries["oscillation in most runs"] = Line2D([], [], **OSCILLATION_MARK)
    if (plants["useless"] >= MARKED_SHARE).any():
        entries["no better than an idle valve in most runs"] = Patch(color=USELESS_COLOUR)
    if plants["ratio"].isna().any():
        entries["least possible error unknown"] = Patch(color=NO_RATIO_COLOUR)
    return entries
