"""The report of a comparison: its tables and pictures, those of most interest first."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import pandas as pd

from benchmarks.compare import tables
from benchmarks.compare.comparison import TWICE, Comparison
from benchmarks.compare.estimates import estimate, scale_of, scores, standing, verdict
from benchmarks.compare.record import Record
from benchmarks.controllers.records import RosterEntry
from benchmarks.controllers.roster import label
from benchmarks.lib.fan_out import FanOut
from benchmarks.lib.report import Section, provenance_line, write_report
from benchmarks.lib.storage import NotWrittenError


def write(
    comparison: Comparison,
    entries: Mapping[str, RosterEntry],
    record: Record,
    fan_out: FanOut,
    *,
    complete: bool,
) -> list[Section]:
    """Write the report of all that has finished, with its tables and pictures, and return it.

    The fan-out makes the estimates and draws the pictures; one that cannot be drawn is a
    sentence in the report. Nothing is written as long as nothing has finished. `complete` says
    whether all has.
    """
    if not comparison.cases:
        return []
    runs, names, agents = comparison.runs, comparison.names, comparison.agents
    record.write_runs(runs, complete=False)
    for name in names:  # after an interruption not all may be known
        if name not in comparison.scales:
            scale = scale_of(comparison.scenarios[name], comparison.count)
            comparison.scales[name] = scale
    scales = {name: comparison.scales[name] for name in names}
    of_scenarios = {
        name: partial(estimate, runs[runs["scenario"] == name], scales, agents[0])
        for name in names
    }
    of_agents = {
        agent: partial(scores, runs[runs["agent"] == agent], scales) for agent in agents
    }
    made = dict(fan_out.stream(of_scenarios | of_agents))
    estimates = pd.concat([made[name] for name in names], ignore_index=True)
    scored = pd.concat([made[agent] for agent in agents], ignore_index=True)
    summary = tables.summarise(runs)
    record.write_table("summary.csv", summary)
    record.write_table("estimates.csv", estimates)

    limits = {name: scale.least.value for name, scale in scales.items()}
    frontiers = {name: comparison.frontiers.get(name, []) for name in names}
    pictures: dict[str, tuple[Any, ...]] = {
        "travel.png": ("travel", summary, limits, frontiers),
        "limits.png": ("limits", estimates),
        "runs.png": ("runs", runs),
    }
    drawn = [agent for agent in agents if entries[agent].drawn] or agents
    for name in names:
        rows = comparison.responses(name)
        record.write_table(f"{name}.csv", rows)
        rows = rows[rows["agent"].isin(drawn)]
        pictures[f"{name}.png"] = ("responses", rows, comparison.scenarios[name])
    curves = [
        pd.DataFrame(member.curve).assign(agent=name, policy=number)
        for name, members in comparison.controllers.items()
        for number, member in enumerate(members)
        if member.curve
    ]
    if curves:
        learning = pd.concat(curves, ignore_index=True)
        record.write_table("learning.csv", learning)
        pictures["learning.png"] = ("learning", learning)
    draw = {name: partial(_draw, *what, record.path(name)) for name, what in pictures.items()}
    faults = dict(fan_out.stream(draw))

    sections = [
        _with_pictures(section, faults)
        for section in _sections(comparison, entries, summary, estimates, scored)
    ]
    for page in ("report.md", "report.html"):
        record.path(page)
    title = "Comparison of controllers"
    write_report(record.folder, title, sections, provenance_line("compare", record.origin))
    record.write_runs(runs, complete=complete)
    return sections


def _draw(kind: str, *arguments: Any) -> str:
    """Draw a picture, and return what went wrong: it costs no report."""
    from benchmarks.compare import plots  # here: Matplotlib is loaded where pictures are drawn

    try:
        getattr(plots, f"plot_{kind}")(*arguments)
    except NotWrittenError:
        raise
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return ""


def _with_pictures(section: Section, faults: Mapping[str, str]) -> Section:
    """Return a section whose pictures that are not there are sentences."""
    missing = [name for name in section.pictures if faults[name]]
    sentences = [f"{name} could not be drawn ({faults[name]})." for name in missing]
    pictures = [name for name in section.pictures if name not in missing]
    return replace(section, text=[*section.text, *sentences], pictures=pictures)


def _sections(
    comparison: Comparison,
    entries: Mapping[str, RosterEntry],
    summary: pd.DataFrame,
    estimates: pd.DataFrame,
    scored: pd.DataFrame,
) -> list[Section]:
    """Return the report, the parts of most interest first."""
    names, reference = comparison.names, comparison.agents[0]
    scales = {name: comparison.scales[name] for name in names}
    titles = [(name, comparison.scenarios[name].title) for name in names]
    sections = [
        Section("", [standing(comparison.runs, scales, scored)]),
        Section(
            "Score: 0 for leaving the valve alone, 1 for the least possible error",
            [
                "The first column is the interquartile mean over all scenarios and runs, with "
                "its 95 % interval; the others are means. Below 0, doing nothing is better. "
                "The valve travel above is that of the median run, as a mean over the "
                "scenarios.",
                f"The picture: {titles[0][1]}. A line is the median over all runs at each "
                "sample, a band the 10th to 90th percentile. The grey band is the dead zone.",
            ],
            tables.score_table(scored),
            [f"{names[0]}.png"],
        ),
        Section(
            "Mean absolute error as a multiple of the least possible error, with its 95 % "
            "interval",
            [
                verdict(estimates),
                "The least possible error marked * supposes that each change of the set point "
                "finds the plant settled and is not foreseen; of random set points it supposes "
                "that their law is known. With preview of the whole set point, no controller "
                "that reads the transmitter, and not the true output, does better than the "
                "second row says.",
                "A point is the mean over all runs, a bar its 95 % interval. Each axis begins "
                "at the least possible error, the vertical line.",
            ],
            tables.ratio_table(estimates, scales),
            ["limits.png"],
        ),
        Section(
            "Error against valve travel",
            [
                "A point is the median run of a controller: its error against the distance "
                "that it moves the valve. Down and left is better. The line is the least "
                "possible error for a given travel, the dashed one for any travel."
            ],
            pictures=["travel.png"],
        ),
        Section(
            "What each controller costs",
            [
                "First and second run: mean error on the square wave, the second time with "
                "what was learnt the first time. Most controllers learn nothing in a run, and "
                "do the same twice. Training: of one policy, the median. Runs: all scenarios, "
                "including what is measured."
            ],
            _costs(comparison, entries),
        ),
        Section(
            "Every run",
            ["A point is one run: so unlucky initial weights and unlucky trainings show."],
            pictures=["runs.png"],
        ),
        Section(
            f"All measures: median (10th to 90th percentile) of {comparison.count} runs",
            [
                "The noise is the same for all. Overshoot and settling time are left out where "
                "there is noise: it crosses every band."
            ],
            tables.metrics_table(summary, comparison.scenarios),
        ),
        Section(
            "Scenarios",
            table=pd.DataFrame(titles, columns=["scenario", "what it is"]),
            pictures=[f"{name}.png" for name in names[1:]],
        ),
    ]
    if any(member.curve for each in comparison.controllers.values() for member in each):
        sections.append(Section("Training", pictures=["learning.png"]))
    if len(comparison.agents) > 1:
        title = f"Difference to {label(reference)} (°C), 95 % interval"
        text = ["And the share of runs in which the error is smaller, in the same noise."]
        sections.insert(4, Section(title, text, tables.paired_table(estimates)))
    return sections


def _costs(comparison: Comparison, entries: Mapping[str, RosterEntry]) -> pd.DataFrame:
    rows = []
    for name in comparison.agents:
        members = comparison.controllers[name]
        cost = members[0].cost or entries[name].cost
        cases = [case for (_, agent), case in comparison.cases.items() if agent == name]
        curves = [member.curve for member in members if member.curve]
        training = pd.Series([curve[-1]["seconds"] for curve in curves]).median()
        twice = comparison.cases.get((TWICE, name))
        rows.append(
            {
                "agent": entries[name].label,
                "prior knowledge": cost.prior_knowledge,
                "parameters": cost.parameters,
                "samples before": cost.samples,
                "training (s)": "" if pd.isna(training) else f"{training:.0f}",
                "runs (s)": f"{sum(case.seconds for case in cases):.1f}",
                "first run": f"{twice.runs['mae'].mean():.3f}" if twice else "",
                "second run": f"{twice.again:.3f}" if twice else "",
            }
        )
    return pd.DataFrame(rows)
