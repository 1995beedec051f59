"""Write the tables, pictures and report of a comparison of controllers in scenarios."""

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.bounds.reference import Reference
from benchmarks.compare import plots
from benchmarks.compare.cases import Result
from benchmarks.compare.estimates import estimate, ranked, summarise, write_table
from benchmarks.controllers.roster import ControllerSpec
from benchmarks.lib.command import CommandError
from benchmarks.lib.sections import Section, write_report
from benchmarks.lib.statistics import Estimate
from benchmarks.loop.runs import is_random
from benchmarks.loop.scenarios import Scenario

SCORE_TEXT = (
    "The error of a run is the mean of |e| over the samples, where e is the set point minus "
    "the temperature. The reference error is the mean error of an ideal controller that knows "
    "the plant and the present load, but not the future. The column of a case has the ratio: "
    "the mean error divided by the reference error. The score says which share of the way from "
    "the error of an idle valve, which keeps the flow at 0 t/h, to the reference error a "
    "controller covers, as a mean over all cases. In parentheses are 95 % confidence "
    "intervals. The valve travel is the sum of the magnitudes of all changes of the applied "
    "flow in a run, as a mean over all runs."
)
REFERENCE_TEXT = (
    "The first row has the reference errors. The mark † means: it is proven that no controller "
    "without foresight has a smaller error on average. In a case without the mark, set points "
    "follow a timetable, and the ideal controller is surprised by each change. A controller "
    "that has learnt the timetable can have a ratio below 1 and a score above 1."
)
COSTS_TEXT = (
    "The column 'prior knowledge' says what a controller knows about the plant before a run, "
    "and the column 'searched or trained' says how its settings or weights were found; 1 M "
    "samples are a million samples. Ms is the maximum sensitivity of a control loop, the "
    "largest magnitude of its sensitivity function: the lower Ms is, the more robust is the "
    "loop. Ms is given for linear controllers, with the nominal plant of the first case that "
    "has finished, without dead zone and limits."
)
STEPS_TEXT = (
    "In the cases without random numbers, the table has the largest overshoot beyond a new set "
    "point, in percent of the change; the longest time from a change until the error stays "
    "within 5 % of the change; the integral of the time since the change times |e| (ITAE); and "
    "the valve travel. Numbers are medians. If runs differ, the 10th and the 90th percentile "
    "follow in parentheses."
)
CASES_TEXT = (
    "Each case is the environment MiddlePoint-v0 with the arguments in the last column; all "
    "other arguments have their default values. Figs are the figures of the paper by Cui and "
    "Shin (1992)."
)
PICTURES_TEXT = (
    "To stay readable, the pictures show the network and the PI controller of 1992, the best "
    "controller of the case that knows a step test, PPO, and your own controllers. The file "
    "CASE.csv of a case has the temperature and the flow of all controllers."
)
# The columns of the table of step responses, and the measure and the format of each.
STEP_COLUMNS = {
    "overshoot (%)": ("overshoot", ".0f"),
    "settling time (min)": ("settling_time", ".1f"),
    "ITAE (°C min²)": ("itae", ".1f"),
    "travel (t/h)": ("total_variation", ".0f"),
}
SCREEN_TEXT = "cases: error / reference error; score: 0 idle valve, 1 reference error"
LONGEST_LABEL = 16  # largest number of characters of a controller's label on the screen


@dataclass(frozen=True)
class Comparison:
    """The results of a comparison that the report shows.

    Attributes
    ----------
    controllers : mapping
        Record of each controller by name.
    scenarios : sequence of Scenario
        The scenarios in the order of the tables.
    references : mapping
        Reference error of each of `scenarios` by name.
    results : sequence of Result
        Results of each controller in each scenario, from all tasks that have finished.
    runs : pandas.DataFrame
        Table with a row for each run in `scenarios`.
    estimates : pandas.DataFrame
        Table with a row for each scenario and controller, from `estimates.estimate`.
    scores : mapping
        Overall score of each controller by name, the highest score first.
    """

    controllers: Mapping[str, ControllerSpec]
    scenarios: Sequence[Scenario]
    references: Mapping[str, Reference]
    results: Sequence[Result]
    runs: pd.DataFrame
    estimates: pd.DataFrame
    scores: Mapping[str, Estimate]


def write(
    results: Sequence[Result],
    scenarios: Mapping[str, Scenario],
    references: Mapping[str, Reference],
    controllers: Mapping[str, ControllerSpec],
    folder: Path,
    provenance: Mapping[str, Any],
    note: str,
    error: CommandError | None,
) -> str:
    """Write the CSV files, pictures and report of a comparison, and return text for the screen.

    A scenario without a reference error is written to the CSV files except `estimates.csv`, but
    not to the report. `scenarios`, `references` and `controllers` have the scenario, the
    reference error and the record of each controller by name, `provenance` is the provenance of
    the results, as `provenance_of` returns it, `note` is a sentence on controllers that are
    left out, or "", and `error` says which results are missing. The returned text has the
    ratios and scores, `note`, and the path of the files.
    """
    tables = [pd.DataFrame(columns) for result in results for columns in result.runs]
    runs = pd.concat(tables, ignore_index=True)
    write_table(folder / "runs.csv", runs)
    write_table(folder / "summary.csv", summarise(runs))
    responses = {}
    for name in runs["scenario"].unique():
        columns = [result.responses for result in results if result.scenario == name]
        responses[name] = pd.concat(map(pd.DataFrame, columns))
        responses[name].to_csv(folder / f"{name}.csv", index=False)
    # The report has the scenarios with both results and reference errors.
    reported = [
        scenario
        for name, scenario in scenarios.items()
        if name in references and name in responses
    ]
    if not reported:
        return f"{note}\nNo report without a reference error; data in {folder}/".strip()
    references = {scenario.name: references[scenario.name] for scenario in reported}
    reported_runs = runs[runs["scenario"].isin(references)]
    estimates = estimate(reported_runs, references)
    # Arrays do not fit into the cells of a CSV file.
    write_table(folder / "estimates.csv", estimates.drop(columns="scores"))
    scores = ranked(estimates)
    comparison = Comparison(
        controllers, reported, references, results, reported_runs, estimates, scores
    )
    plots.plot_scores(scores, estimates, controllers, folder / "scores.png")
    for scenario in reported:
        rows = responses[scenario.name]
        case_runs = reported_runs[reported_runs["scenario"] == scenario.name]
        errors = case_runs.groupby("agent")["mae"].mean()
        path = folder / f"{scenario.name}.png"
        plots.plot_responses(rows, errors, scenario, controllers, path)
    # `estimates` has a row for each controller and each scenario that it has finished.
    finished_cases = estimates["agent"].value_counts()
    incomplete = [name for name in scores if finished_cases[name] < len(reported)]
    if incomplete:
        labels = ", ".join(controllers[name].label for name in incomplete)
        missing = f"Scores over fewer cases, as results are missing: {labels}."
        note = f"{note} {missing}".strip()
    # `doubts` returns sentences on cases in which no controller settles or all are at a limit.
    note = " ".join(filter(None, [note, *doubts(comparison)]))
    page = sections(comparison, note)
    write_report(folder, "Comparison of controllers", page, provenance, error)
    path_text = f"The report, tables, data and pictures are in {folder}/"
    return "\n".join(filter(None, [on_screen(comparison), note, path_text]))


def sections(comparison: Comparison, note: str) -> list[Section]:
    """Return the sections of a comparison's report, with `note` in the first section."""
    table = score_table(comparison, format)
    first_row = reference_table(comparison.references)
    cases_text = [CASES_TEXT]
    if len(comparison.scores) > plots.MOST_PICTURED:
        cases_text.append(PICTURES_TEXT)
    steps = steps_table(comparison)
    steps_section = [Section("Step responses", [STEPS_TEXT], steps)] if len(steps) else []
    return [
        Section(
            "Ratios and scores",
            [SCORE_TEXT, REFERENCE_TEXT, *filter(None, [note])],
            pd.concat([first_row, table])[table.columns].fillna(""),
            pictures={"scores.png": "The score of each controller, and its score in each case"},
        ),
        *steps_section,
        Section("What each controller knows and costs", [COSTS_TEXT], costs_table(comparison)),
        Section(
            "Cases",
            cases_text,
            cases_table(comparison.scenarios),
            pictures={
                f"{scenario.name}.png": f"Temperature and flow over time: {scenario.title}"
                for scenario in comparison.scenarios
            },
        ),
    ]


def score_table(comparison: Comparison, text: Callable[[Estimate, str], str]) -> pd.DataFrame:
    """Return a table of texts with the ratios and the score of each controller.

    `text` is a function that converts an estimate to a text in a format such as ".2f". The
    controller with the highest score comes first.
    """
    travels = comparison.runs.groupby(["agent", "scenario"])["total_variation"].mean()
    rows = []
    for agent, score in comparison.scores.items():
        row = {"controller": comparison.controllers[agent].label}
        estimates = comparison.estimates[comparison.estimates["agent"] == agent]
        for name, ratio in zip(estimates["scenario"], estimates["ratio"], strict=True):
            row[name] = text(ratio, ".2f")
        row["score"] = text(score, ".3f")
        row["travel (t/h)"] = f"{travels[agent].mean():,.0f}"  # over the cases
        rows.append(row)
    columns = ["controller", *comparison.references, "score", "travel (t/h)"]
    return pd.DataFrame(rows, columns=columns).fillna("")


def reference_table(references: Mapping[str, Reference]) -> pd.DataFrame:
    """Return a table of texts with one row, which has the reference error of each case, degC.

    The mark † follows a reference error for which `Reference.is_bound` is true.
    """
    row = {"controller": "reference error (°C)"}
    for name, reference in references.items():
        mark = "†" if reference.is_bound else ""
        row[name] = f"{reference.value:.3f}{mark}"
    return pd.DataFrame([row])


def doubts(comparison: Comparison) -> list[str]:
    """Return sentences on cases in which no controller settles, or all are at a limit."""
    sentences = []
    for scenario in comparison.scenarios:
        case_runs = comparison.runs[comparison.runs["scenario"] == scenario.name]
        case_runs = case_runs[case_runs["agent"] != "idle"]
        if case_runs.empty:
            continue
        medians = case_runs.groupby("agent")[["settling_time", "saturation_share"]].median()
        if not is_random(scenario.parameters) and np.isinf(medians["settling_time"]).all():
            sentences.append(f"In the case {scenario.name}, no controller settles.")
        if (medians["saturation_share"] > 50.0).all():
            sentences.append(
                f"In the case {scenario.name}, all controllers are at a limit of the flow for "
                "more than half of the run."
            )
    return sentences


def steps_table(comparison: Comparison) -> pd.DataFrame:
    """Return a table of texts with measures of step responses in cases without randomness."""
    calm = [case.name for case in comparison.scenarios if not is_random(case.parameters)]
    rows = []
    for case in calm:
        percentiles = summarise(comparison.runs[comparison.runs["scenario"] == case])
        for agent in comparison.scores:
            of_agent = percentiles[percentiles["agent"] == agent]
            if of_agent.empty:  # The task has not finished.
                continue
            numbers = of_agent.set_index("metric").to_dict("index")
            row = {"case": case, "controller": comparison.controllers[agent].label}
            for column, (measure, form) in STEP_COLUMNS.items():
                row[column] = percentiles_text(numbers[measure], form)
            rows.append(row)
    return pd.DataFrame(rows, columns=["case", "controller", *STEP_COLUMNS])


def percentiles_text(numbers: Mapping[Hashable, Any], form: str) -> str:
    """Return a median, with the 10th and the 90th percentile if they differ in the format."""
    median, low, high = (
        format(numbers[name], form) if math.isfinite(numbers[name]) else "never"
        for name in ("median", "p10", "p90")
    )
    return median if low == high else f"{median} ({low} to {high})"


def costs_table(comparison: Comparison) -> pd.DataFrame:
    """Return a table of texts on each controller's prior knowledge, robustness and costs."""
    rows = []
    for name in comparison.scores:
        controller = comparison.controllers[name]
        results = [result for result in comparison.results if result.agent == name]
        row = {
            "controller": controller.label,
            "prior knowledge": controller.knows,
            # Results are in the order of the cases: Ms is that with the plant of the first.
            "Ms": sensitivity_text(results[0].sensitivity),
            "searched or trained": controller.searched,
            "processor time (s)": f"{sum(result.seconds for result in results):.1f}",
        }
        rows.append(row)
    return pd.DataFrame(rows)


def sensitivity_text(sensitivity: float | None) -> str:
    """Return the maximum sensitivity Ms of a loop as a text, "" if there is none."""
    if sensitivity is None:
        return ""
    return f"{sensitivity:.2f}" if math.isfinite(sensitivity) else "unstable"


def cases_table(scenarios: Sequence[Scenario]) -> pd.DataFrame:
    """Return a table of texts that describes scenarios, with a row for each scenario."""
    rows = []
    for scenario in scenarios:
        arguments = [f"{name}={value}" for name, value in scenario.arguments.items()]
        row = {
            "case": scenario.name,
            "description": scenario.title,
            "length (samples)": f"{scenario.samples:,}",
            "arguments": ", ".join(arguments) or "none",
        }
        rows.append(row)
    return pd.DataFrame(rows)


def on_screen(comparison: Comparison) -> str:
    """Return the table of ratios and scores for a terminal of 80 columns.

    A heading of two words or more, such as "square zone 7", has its first word in the line
    above.
    """
    table = score_table(comparison, lambda estimate, form: format(estimate.value, form))
    table["controller"] = table["controller"].str[:LONGEST_LABEL]
    headings = {case.name: case.heading or case.name for case in comparison.scenarios}
    words = [headings.get(name, name).partition(" ") for name in table.columns]
    upper = [first if others else "" for first, _, others in words]
    lower = [others or first for first, _, others in words]
    rows = [upper, lower, *table.to_numpy().tolist()]
    first_width, *widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for label, *cells in rows:
        aligned = [cell.rjust(width) for cell, width in zip(cells, widths, strict=True)]
        lines.append(" ".join([label.ljust(first_width), *aligned]))
    return "\n".join([*lines, SCREEN_TEXT])
