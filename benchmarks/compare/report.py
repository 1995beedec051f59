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

from benchmarks.compare.comparison import Comparison
from benchmarks.compare.estimates import Scale, Score, estimate, ranked, scale_of
from benchmarks.controllers.roster import ROSTER, label
from benchmarks.lib.fan_out import FanOut
from benchmarks.lib.report import Best, Section, write_report
from benchmarks.lib.statistics import Estimate, written
from benchmarks.lib.tables import PERCENTILES, groups, percentiles, write_csv
from benchmarks.loop.metrics import METRICS
from benchmarks.loop.scenarios import Scenario

NOT_SETTLED = "not settled"
NO_MEASURE = "not measured"
STEP_METRICS = ("overshoot", "settling_time")  # meaningless in noise


def write(
    comparison: Comparison, folder: Path, made_by: str, jobs: int | None = 1
) -> list[Section]:
    """Write the report of all finished cases, with tables and pictures, and return it.

    So many pictures are drawn at once.
    """
    from benchmarks.compare import plots  # here, so that only drawing loads Matplotlib

    runs, names, agents = comparison.runs, comparison.names, comparison.agents
    scales = {  # after an interruption, some may be missing
        name: comparison.scales.get(name)
        or scale_of(comparison.scenarios[name], comparison.count)
        for name in names
    }
    estimates = pd.concat(
        [estimate(cases, scales[name], agents[0]) for name, cases in groups(runs, "scenario")],
        ignore_index=True,
    )
    summary = summarise(runs)
    write_numbers(folder / "summary.csv", summary)
    write_numbers(folder / "estimates.csv", estimates)

    scores = ranked(runs, scales)
    pictures: dict[str, Callable[[Path], None]] = {
        "scores.png": partial(plots.plot_scores, scores),
        "bounds.png": partial(plots.plot_bounds, estimates, runs, [*scores]),
        "travel.png": partial(plots.plot_travel, summary, scales, scores),
    }
    drawn = [agent for agent in agents if agent not in ROSTER or ROSTER[agent].drawn] or agents
    for name, cases in groups(estimates, "scenario"):
        responses = pd.concat(
            [case.responses for case in comparison.finished if case.scenario == name],
            ignore_index=True,
        )
        write_numbers(folder / f"{name}.csv", responses)
        errors = {
            agent: mean.value for agent, mean in zip(cases["agent"], cases["mean"], strict=True)
        }
        pictures[f"{name}.png"] = partial(
            plots.plot_responses,
            responses[responses["agent"].isin(drawn)],
            errors,
            comparison.scenarios[name],
        )
    tasks = {name: partial(_draw, draw, folder / name) for name, draw in pictures.items()}
    faults = FanOut(jobs=jobs).run(tasks, "pictures")
    sections = [
        replace(
            section,
            text=[*section.text, *filter(None, map(faults.get, section.pictures))],
            pictures={
                name: shown for name, shown in section.pictures.items() if not faults[name]
            },
        )
        for section in _sections(comparison, scales, summary, estimates, scores)
    ]
    write_report(folder, "Comparison of controllers", sections, made_by)
    return sections


def _draw(draw: Callable[[Path], None], path: Path) -> str:
    """Draw a picture and return any error as text, so that the report is still written."""
    try:
        draw(path)
    except (ValueError, ArithmeticError) as error:  # what a plant gives may fit no axis
        return f"{path.name} could not be drawn ({type(error).__name__}: {error})."
    return ""


def _sections(
    comparison: Comparison,
    scales: Mapping[str, Scale],
    summary: pd.DataFrame,
    estimates: pd.DataFrame,
    scores: Mapping[str, Score],
) -> list[Section]:
    """Return the sections of the report, the most interesting ones first."""
    names, (reference, *others) = comparison.names, comparison.agents
    titles = [(name, comparison.scenarios[name].title) for name in names]
    paired = Section(
        f"Difference to {label(reference)} (°C), 95 % interval",
        ["Below 0 a controller is better; in % the share of runs in which it is."],
        paired_table(estimates) if others else None,
    )
    return [
        Section(
            "Score: 0 without control, 1 at the least possible error",
            ["Mean over the cases, 95 % interval; travel of the valve in the median run."],
            score_table(comparison.runs, scores, names),
            pictures={"scores.png": "Scores, a tick for each case"},
        ),
        Section(
            "Mean error as a multiple of the least possible, with its 95 % interval",
            [
                "Least possible without foresight; where marked *, if each change of the set "
                "point finds the plant settled: a controller that knows the timetable can do "
                "better, but none comes below the least with foresight."
            ],
            ratio_table(estimates, scales, [*scores]),
            pictures={"bounds.png": "Mean errors as multiples of the least possible"},
        ),
        Section(
            "Error against valve travel",
            pictures={"travel.png": "Error against valve travel; down and left is better"},
        ),
        *([paired] if others else []),
        Section(
            "What each controller costs",
            [
                "Search: its trials, all their samples, and minutes of one core. Training: the "
                "median policy. Runs: all cases, including measuring."
            ],
            _costs(comparison),
        ),
        Section(
            f"All measures: median (10th to 90th percentile) of {comparison.count} runs",
            table=metrics_table(summary, comparison.scenarios),
        ),
        Section(
            "Cases",
            table=pd.DataFrame(titles, columns=["case", "what it is"]),
            pictures={f"{name}.png": f"Responses, {title}" for name, title in titles},
        ),
    ]


def _costs(comparison: Comparison) -> pd.DataFrame:
    rows = []
    for name in comparison.agents:
        members = comparison.controllers[name]
        cost = members[0].cost
        seconds = [member.provenance.get("cpu_seconds") for member in members]
        training = [each for each in seconds if each is not None]
        runs = [case.seconds for case in comparison.finished if case.agent == name]
        rows.append(
            {
                "controller": label(name),
                "prior knowledge": cost.prior_knowledge,
                "parameters": cost.parameters,
                "search for its settings": cost.search,
                "samples before": cost.samples,
                "training (s)": f"{np.median(training):.0f}" if training else "",
                "runs (s)": f"{sum(runs):.1f}",
            }
        )
    return pd.DataFrame(rows)


def summarise(runs: pd.DataFrame) -> pd.DataFrame:
    """Return percentiles over the runs, one row for each scenario, agent and metric."""
    return pd.DataFrame(
        [
            {"scenario": scenario, "agent": agent, "metric": metric, "runs": len(group)}
            | percentiles(group[metric].to_numpy())
            for (scenario, agent), group in runs.groupby(["scenario", "agent"], sort=False)
            for metric in METRICS
        ]
    )


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
    """Return all metrics, one row for each scenario and agent, one column for each metric."""
    rows = []
    for name, scenario in scenarios.items():
        noisy = scenario.parameters.range_of("noise_variance")[1] > 0.0
        for agent, group in groups(summary[summary["scenario"] == name], "agent"):
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
