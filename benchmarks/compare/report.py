"""Write the report of a comparison, with the most interesting tables and pictures first."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.compare.comparison import (
    Case,
    Scale,
    Score,
    estimate,
    ranked,
    summarise,
)
from benchmarks.controllers.roster import Controller, label
from benchmarks.lib.fan_out import FanOut
from benchmarks.lib.report import Best, Section, provenance_line, write_report
from benchmarks.lib.statistics import PERCENTILES, Estimate, groups, written
from benchmarks.lib.storage import write_csv
from benchmarks.loop.metrics import METRICS
from benchmarks.loop.scenarios import Scenario

NOT_SETTLED = "not settled"
NO_MEASURE = "not measured"
STEP_METRICS = ("overshoot", "settling_time")  # meaningless in noise


def write(
    cases: Sequence[Case],
    scenarios: Mapping[str, Scenario],
    scales: Mapping[str, Scale],
    controllers: Mapping[str, Controller],
    folder: Path,
    made: Mapping[str, Any],
    jobs: int | None = 1,
) -> list[Section]:
    """Write the numbers, pictures and report of finished cases, and return the sections.

    So many pictures are drawn at once. A case without a scale is in the numbers only.
    """
    runs = pd.concat([case.runs for case in cases], ignore_index=True)
    summary = summarise(runs)
    write_numbers(folder / "runs.csv", runs)
    write_numbers(folder / "summary.csv", summary)
    for name in scenarios:
        responses = [case.responses for case in cases if case.scenario == name]
        if responses:
            write_numbers(folder / f"{name}.csv", pd.concat(responses, ignore_index=True))
    runs = runs[runs["scenario"].isin([*scales])]
    if runs.empty:
        return []
    scales = {name: scales[name] for name in scenarios if name in set(runs["scenario"])}
    reference = str(runs["agent"].iloc[0])
    estimates = pd.concat(
        [estimate(rows, scales[name], reference) for name, rows in groups(runs, "scenario")],
        ignore_index=True,
    )
    write_numbers(folder / "estimates.csv", estimates)
    scores = ranked(runs, scales)
    sections = [
        *_comparisons(runs, estimates, scores, scales),
        Section(
            "What each controller costs",
            ["What it is told; what was searched or trained beforehand; its runs here."],
            _costs(cases, controllers),
        ),
        Section(
            f"All measures: median (10th to 90th percentile) of {runs['seed'].nunique()} runs",
            table=metrics_table(summary, scenarios),
        ),
        Section(
            "Cases",
            table=pd.DataFrame(
                [(name, scenarios[name].title) for name in scales],
                columns=["case", "what it is"],
            ),
            pictures={f"{name}.png": f"Responses: {scenarios[name].title}" for name in scales},
        ),
    ]
    tasks = _pictures(
        cases, scenarios, scales, controllers, folder, (estimates, runs, summary, scores)
    )
    faults = FanOut(jobs=jobs).run(tasks, "pictures")
    sections = [_without(faults, section) for section in sections]
    write_report(
        folder, "Comparison of controllers", sections, provenance_line("compare", made)
    )
    return sections


def _pictures(
    cases: Sequence[Case],
    scenarios: Mapping[str, Scenario],
    scales: Mapping[str, Scale],
    controllers: Mapping[str, Controller],
    folder: Path,
    tables: tuple[pd.DataFrame, pd.DataFrame, pd.DataFrame, Mapping[str, Score]],
) -> dict[str, Callable[[], str]]:
    """Return tasks that draw, by the names of the pictures."""
    from benchmarks.compare import plots  # here, so that only drawing loads Matplotlib

    estimates, runs, summary, scores = tables
    told = [name for name, each in controllers.items() if each.told]
    draw: dict[str, Callable[[Path], None]] = {
        "scores.png": partial(plots.plot_scores, scores, told),
        "bounds.png": partial(plots.plot_bounds, estimates, runs, [*scores], told),
        "travel.png": partial(plots.plot_travel, summary, scales, scores),
    }
    shown = [name for name, each in controllers.items() if each.drawn] or [*controllers]
    for name in scales:
        drawn = [each for each in cases if each.scenario == name and each.agent in shown]
        if drawn:
            errors = {each.agent: float(each.runs["mae"].mean()) for each in drawn}
            responses = pd.concat([each.responses for each in drawn], ignore_index=True)
            draw[f"{name}.png"] = partial(
                plots.plot_responses, responses, errors, scenarios[name]
            )
    return {name: partial(_draw, draw[name], folder / name) for name in draw}


def _draw(draw: Callable[[Path], None], path: Path) -> str:
    """Draw a picture and return any error as text, so that the report is still written."""
    try:
        draw(path)
    except (ValueError, ArithmeticError) as error:  # what a plant gives may fit no axis
        return f"{path.name} could not be drawn ({type(error).__name__}: {error})."
    return ""


def _without(faults: Mapping[str, str], section: Section) -> Section:
    """Return a section with the pictures that were drawn, and what is wrong with the others."""
    drawn = {name: alt for name, alt in section.pictures.items() if faults.get(name) == ""}
    said = [faults[name] for name in section.pictures if faults.get(name)]
    return replace(section, text=[*section.text, *said], pictures=drawn)


def _comparisons(
    runs: pd.DataFrame,
    estimates: pd.DataFrame,
    scores: Mapping[str, Score],
    scales: Mapping[str, Scale],
) -> list[Section]:
    """Return the sections that compare: scores, multiples, travel, paired differences."""
    reference = str(runs["agent"].iloc[0])
    sections = [
        Section(
            "Score: 0 without control, 1 at the least possible error",
            ["Mean over the cases, 95 % interval; travel of the valve in the median run."],
            score_table(runs, scores, [*scales]),
            {"scores.png": "The score of each controller, and a tick for each case"},
        ),
        Section(
            "Mean error as a multiple of the least possible, with its 95 % interval",
            [
                "Least possible without foresight; where marked *, if each change of the set "
                "point finds the plant settled: a controller that knows the timetable can do "
                "better, but none comes below the least with foresight."
            ],
            ratio_table(estimates, scales, [*scores]),
            {"bounds.png": "Mean error of each controller in each case"},
        ),
        Section(
            "Error against valve travel",
            ["Down and left is better."],
            pictures={"travel.png": "Mean error over valve travel, a panel for each case"},
        ),
    ]
    if runs["agent"].nunique() > 1:
        title = f"Difference to {label(reference)} (°C), 95 % interval"
        text = "Below 0 a controller is better; in % the share of runs in which it is."
        sections.append(Section(title, [text], paired_table(estimates)))
    return sections


def _costs(cases: Sequence[Case], controllers: Mapping[str, Controller]) -> pd.DataFrame:
    """Return what each controller is told, what it took before, and its runs."""
    rows = []
    for name, controller in controllers.items():
        own = [case for case in cases if case.agent == name]
        training = (
            [each["cpu_seconds"] for each in own[0].policies if "cpu_seconds" in each]
            if own
            else []
        )
        rows.append(
            {
                "controller": label(name),
                "prior knowledge": controller.knows,
                "searched or trained": controller.searched,
                "training (s)": f"{np.median(training):.0f}" if training else "",
                "runs (s)": f"{sum(case.seconds for case in own):.1f}",
            }
        )
    return pd.DataFrame(rows)


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
    write_csv(path, flat.astype(object).where(flat != math.inf, NOT_SETTLED))


def score_table(
    runs: pd.DataFrame, scores: Mapping[str, Score], names: Sequence[str]
) -> pd.DataFrame:
    """Return the scores and the mean travel of the median runs, the best in bold."""
    travels = runs.groupby(["agent", "scenario"])["total_variation"].median()
    rows = [
        {"controller": label(agent), "score": f"{overall:.3f}"}
        | {"travel (t/h)": f"{travels[agent].mean():,.0f}"}
        | {scenario: written(mean, ".2f") for scenario, mean in means.items()}
        for agent, (overall, means) in scores.items()
    ]
    rows[0] = {name: Best(cell) for name, cell in rows[0].items()}
    # After an interruption, with gaps.
    columns = ["controller", "score", "travel (t/h)", *names]
    return pd.DataFrame(rows, columns=columns).fillna("")


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


def metrics_table(summary: pd.DataFrame, scenarios: Mapping[str, Scenario]) -> pd.DataFrame:
    """Return all metrics, one row for each case and agent, one column for each metric."""
    rows = []
    for name, of_case in groups(summary, "scenario"):
        noisy = scenarios[name].parameters.range_of("noise_variance")[1] > 0.0
        for agent, group in groups(of_case, "agent"):
            cells = {
                METRICS[row["metric"]]: (
                    "" if noisy and row["metric"] in STEP_METRICS else _median(row)
                )
                for row in group.to_dict("records")
            }
            rows.append({"case": name, "controller": label(agent)} | cells)
    return pd.DataFrame(rows)


def _median(row: Mapping[Any, Any]) -> str:
    """Format the median and, where they differ, the 10th and 90th percentiles."""
    form = ".3f" if row["metric"] == "mae" else ",.0f"
    words = {math.inf: NOT_SETTLED}
    median, p10, p90 = (
        NO_MEASURE if math.isnan(row[name]) else words.get(row[name], format(row[name], form))
        for name in PERCENTILES
    )
    return median if p10 == p90 else f"{median} ({p10} to {p90})"
