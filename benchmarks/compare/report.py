"""Write the report of a comparison, with the most interesting tables and pictures first."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.compare.comparison import Case, Scale, Score, estimate, ranked, summarise
from benchmarks.controllers.roster import Controller, label
from benchmarks.lib.command import FanOut
from benchmarks.lib.report import Best, Section, provenance_line, write_report
from benchmarks.lib.statistics import Estimate, groups, written
from benchmarks.lib.storage import write_csv
from benchmarks.loop.rollout import CHANGE, START
from benchmarks.loop.scenarios import Scenario

SCORE = "Mean over the cases, 95 % interval; travel of the valve in the median run."
BOUND = (
    "Least possible without foresight; where marked *, if each change of the set point finds "
    "the plant settled: a controller that knows the timetable can do better, but none comes "
    "below the least with foresight."
)
PAIRED = "Below 0 a controller is better; in % the share of runs in which it is."
COSTS = (
    "What it is told; what was searched or trained beforehand; the processor time of its runs."
)
PARTS = {
    "mae_start": f"first {START} samples",
    "mae_changes": f"{CHANGE} samples after later changes",
    "mae_steady": "the rest",
    "mae": "together",
}


def write(
    cases: Sequence[Case],
    scenarios: Mapping[str, Scenario],
    scales: Mapping[str, Scale],
    controllers: Mapping[str, Controller],
    folder: Path,
    made: Mapping[str, Any],
) -> list[Section]:
    """Write the numbers, pictures and report of finished cases, and return the sections.

    A case without a scale is in the numbers only.
    """
    runs = pd.concat([case.runs for case in cases], ignore_index=True)
    summary = summarise(runs)
    write_numbers(folder / "runs.csv", runs)
    write_numbers(folder / "summary.csv", summary)
    for name in scenarios:
        if found := [case.responses for case in cases if case.scenario == name]:
            write_numbers(folder / f"{name}.csv", pd.concat(found, ignore_index=True))
    scales = {name: scales[name] for name in scenarios if name in scales}
    runs = runs[runs["scenario"].isin([*scales])]
    if runs.empty:
        return []
    reference = str(runs["agent"].iloc[0])
    estimates = pd.concat(
        [estimate(rows, scales[name], reference) for name, rows in groups(runs, "scenario")],
        ignore_index=True,
    )
    write_numbers(folder / "estimates.csv", estimates)
    scores = ranked(runs, scales)
    titles = {name: scenarios[name].title for name in scales}
    paired = f"Difference to {label(reference)} (°C), 95 % interval"
    sections = [
        Section(
            "Score: 0 without control, 1 at the least possible error",
            [SCORE],
            score_table(runs, scores, [*scales]),
            {"scores.png": "The score of each controller, and a tick for each case"},
        ),
        Section(
            "Mean error as a multiple of the least possible, with its 95 % interval",
            [BOUND],
            ratio_table(estimates, scales, [*scores]),
            {"bounds.png": "The mean error of each controller in each case"},
        ),
        Section(
            "Error against valve travel",
            ["Down and left is better."],
            pictures={"travel.png": "The mean error over valve travel, a panel for each case"},
        ),
        Section(paired, [PAIRED], paired_table(estimates)),
        Section(
            "Where the error arises: `hard`",
            ["Contributions to the mean error, °C: means of all runs."],
            parts_table(runs[runs["scenario"] == "hard"]),
        ),
        Section("What each controller costs", [COSTS], costs_table(cases, controllers)),
        Section(
            "Cases",
            table=pd.DataFrame(titles.items(), columns=["case", "what it is"]),
            pictures={f"{name}.png": f"Responses: {title}" for name, title in titles.items()},
        ),
    ]
    sections = [each for each in sections if each.table is None or len(each.table)]
    tasks = _pictures(cases, scenarios, scales, controllers, summary, estimates, scores)
    draw = {name: partial(task, folder / name) for name, task in tasks.items()}
    for name in draw:
        (folder / name).unlink(missing_ok=True)  # of an earlier run
    try:
        # In this process: others would spend more time on loading Matplotlib than on drawing.
        FanOut(jobs=1).run(draw, "pictures")
    finally:  # with the pictures that there are
        made_by = provenance_line("compare", made)
        write_report(folder, "Comparison of controllers", sections, made_by)
    return sections


def _pictures(
    cases: Sequence[Case],
    scenarios: Mapping[str, Scenario],
    scales: Mapping[str, Scale],
    controllers: Mapping[str, Controller],
    summary: pd.DataFrame,
    estimates: pd.DataFrame,
    scores: Mapping[str, Score],
) -> dict[str, Any]:
    """Return functions that draw into a file, by the names of the pictures."""
    from benchmarks.compare import plots  # here, so that only drawing loads Matplotlib

    told = [name for name, each in controllers.items() if each.told]
    worst = {(each.scenario, each.agent): float(each.runs["mae"].max()) for each in cases}
    draw: dict[str, Any] = {
        "scores.png": partial(plots.plot_scores, scores, told),
        "bounds.png": partial(plots.plot_bounds, estimates, worst, [*scores], told),
        "travel.png": partial(plots.plot_travel, summary, scales, scores),
    }
    shown = [name for name, each in controllers.items() if each.drawn] or [*controllers]
    for name in scales:
        if own := [each for each in cases if each.scenario == name and each.agent in shown]:
            errors = {each.agent: float(each.runs["mae"].mean()) for each in own}
            rows = pd.concat([each.responses for each in own], ignore_index=True)
            draw[f"{name}.png"] = partial(plots.plot_responses, rows, errors, scenarios[name])
    return draw


def write_numbers(path: Path, table: pd.DataFrame) -> None:
    """Write a table of numbers, texts and estimates as CSV.

    An estimate becomes three columns: its value and the ends of its interval. Infinite values,
    which apart from these ends are settling times, are written in words.
    """
    columns: dict[Any, Any] = {}
    for name, cells in table.items():
        columns[name] = cells
        if any(isinstance(cell, Estimate) for cell in cells):
            for end, suffix in (("value", ""), ("low", "_low"), ("high", "_high")):
                columns[f"{name}{suffix}"] = [getattr(cell, end, math.nan) for cell in cells]
    flat = pd.DataFrame(columns)
    write_csv(path, flat.astype(object).where(flat != math.inf, "not settled"))


def score_table(
    runs: pd.DataFrame, scores: Mapping[str, Score], names: Sequence[str]
) -> pd.DataFrame:
    """Return the scores and the mean travel of the median runs, the best in bold."""
    travels = runs.groupby(["agent", "scenario"])["total_variation"].median()
    rows = [
        {
            "controller": label(agent),
            "score": f"{overall:.3f}",
            "travel (t/h)": f"{travels[agent].mean():,.0f}",
            **{name: written(by_case[name], ".2f") for name in names if name in by_case},
        }
        for agent, (overall, by_case) in scores.items()
    ]
    rows[0] = {name: Best(cell) for name, cell in rows[0].items()}
    return pd.DataFrame(rows).fillna("")  # after an interruption, with gaps


def ratio_table(
    estimates: pd.DataFrame, scales: Mapping[str, Scale], agents: Sequence[str]
) -> pd.DataFrame:
    """Return the least possible and the mean errors as multiples; the least are in bold."""
    bounds = [{"controller": "least possible (°C)"}, {"controller": "with foresight (°C)"}]
    for name, scale in scales.items():
        mark = "*" * (scale.least.kind == "reference")
        bounds[0][name] = f"{scale.least.value:.3f}{mark}"
        bounds[1][name] = f"{scale.preview.value:.3f}"
    values = estimates["ratio"].map(lambda ratio: ratio.value)
    least = values == values.groupby(estimates["scenario"]).transform("min")
    cells = estimates["ratio"].map("{:.2f}".format).where(~least, lambda all_: all_.map(Best))
    table = _by_agent(estimates, cells, agents)
    return pd.concat([pd.DataFrame(bounds), table], ignore_index=True)


def paired_table(estimates: pd.DataFrame) -> pd.DataFrame:
    """Return differences from the reference, one row for each other agent."""
    if "difference" not in estimates:
        return pd.DataFrame()
    others = estimates.dropna(subset=["difference"])
    pairs = zip(others["difference"], others["improvement"], strict=True)
    cells = [f"{mean:+.3f}; {100 * better.value:.0f} %" for mean, better in pairs]
    return _by_agent(others, cells, [*others["agent"].unique()])


def _by_agent(rows: pd.DataFrame, cells: Any, agents: Sequence[str]) -> pd.DataFrame:
    table = rows.assign(cell=cells).pivot_table(
        index="agent", columns="scenario", values="cell", aggfunc="first", sort=False
    )
    table = table.loc[[*agents]].fillna("").rename(index=label)
    return table.rename_axis(index="controller", columns=None).reset_index()


def parts_table(runs: pd.DataFrame) -> pd.DataFrame:
    """Return the mean error of a case and its parts, the least first."""
    means = runs.groupby("agent")[[*PARTS]].mean().sort_values("mae").map("{:.3f}".format)
    return means.rename(index=label, columns=PARTS).rename_axis("controller").reset_index()


def costs_table(cases: Sequence[Case], controllers: Mapping[str, Controller]) -> pd.DataFrame:
    """Return what each controller is told, what it took before, and its runs."""
    rows = []
    for name, controller in controllers.items():
        own = [case for case in cases if case.agent == name]
        about = own[0].policies if own else []
        training = [each["cpu_seconds"] for each in about if "cpu_seconds" in each]
        said = dict(about[0]) if about else {}  # of a user's own; the roster's is in its record
        rows.append(
            {
                "controller": label(name),
                "prior knowledge": controller.knows or said.get("knows", ""),
                "searched or trained": controller.searched or said.get("searched", ""),
                "training (s)": f"{np.median(training):.0f}" if training else "",
                "runs (s)": f"{sum(case.seconds for case in own):.1f}",
            }
        )
    return pd.DataFrame(rows)
