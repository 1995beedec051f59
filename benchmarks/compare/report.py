"""Write the tables, pictures and report of a comparison of controllers in scenarios."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from benchmarks.compare import plots
from benchmarks.compare.estimates import estimate, ranked, summarise, write_numbers
from benchmarks.compare.runs import Bound, Result
from benchmarks.controllers.roster import ROSTER, ControllerSpec
from benchmarks.lib.command import CommandError
from benchmarks.lib.report import Section, write_report
from benchmarks.lib.statistics import Estimate, as_text
from benchmarks.loop.scenarios import Scenario

SCORE_TEXT = (
    "The error of a run is the mean of |e| over the samples, where e is the set point minus "
    "the temperature. An idle valve keeps the flow at 0 t/h. The score says which share of the "
    "way from the error of an idle valve to the least possible error a controller covers. "
    "The column 'score' has the mean score over all cases, with a 95 % confidence "
    "interval, and the columns of the cases have the score in each case. The valve travel is "
    "the sum of all changes of the applied flow in a run, as a mean over all runs."
)
RATIO_TEXT = (
    "An error ratio of 1.00 is best. The first row has the least possible error of a "
    "controller that does not know future set points. The mark * means that the plant settles "
    "before each change of the set point, and that the least possible error assumes that each "
    "change comes as a surprise. In a case with the mark *, a controller that has learnt when "
    "the set point changes can have an error ratio below 1.00."
)
COSTS_TEXT = (
    "The column 'prior knowledge' says what a controller knows about the plant before a run, "
    "and the column 'searched or trained' says how its settings or weights were found; 1 M "
    "samples are a million samples. Ms is the maximum sensitivity of a control loop, the "
    "largest magnitude of its sensitivity function: the lower Ms is, the more robust is the "
    "loop. Ms is given for linear controllers, with the nominal plant of the first case, "
    "without dead zone and limits."
)
CASES_TEXT = (
    "Each case is the environment MiddlePoint-v0 with the arguments in the last column; all "
    "other arguments have their default values."
)
SCREEN_TEXT = "score: 0 idle valve, 1 least possible error; cases: error / least possible error"
# Of more controllers than `MOST_PICTURED`, the pictures of responses over time show only users'
# own controllers and `PICTURED`: those of the paper, and the best that know and that are
# trained.
MOST_PICTURED = 8
PICTURED = "nn", "pi", "dahlin", "ppo"
LONGEST_LABEL = 16  # largest number of characters of a controller's label on the screen


@dataclass(frozen=True)
class Comparison:
    """The results of a comparison that the report shows.

    Attributes
    ----------
    controllers : mapping
        Record of each controller by name.
    bounds : sequence of Bound
        The scenarios in the order of the tables, each with its least possible error.
    results : sequence of Result
        Results of each controller in each scenario, from all tasks that have finished.
    runs : pandas.DataFrame
        Table with a row for each run of `results`.
    estimates : pandas.DataFrame
        Table with a row for each scenario and controller, from `estimates.estimate`.
    scores : mapping
        Overall score of each controller by name, the highest score first.
    """

    controllers: Mapping[str, ControllerSpec]
    bounds: Sequence[Bound]
    results: Sequence[Result]
    runs: pd.DataFrame
    estimates: pd.DataFrame
    scores: Mapping[str, Estimate]

    def label(self, agent: str) -> str:
        """Return the name of a controller in tables."""
        return self.controllers[agent].label

    def travel(self, agent: str) -> str:
        """Return the mean valve travel of a controller over all scenarios, t/h, as a text."""
        runs = self.runs[self.runs["agent"] == agent]
        return f"{runs.groupby('scenario')['total_variation'].mean().mean():,.0f}"


def write(
    results: Sequence[Result],
    bounds: Sequence[Bound],
    controllers: Mapping[str, ControllerSpec],
    folder: Path,
    provenance: Mapping[str, Any],
    note: str,
    error: CommandError | None,
) -> str:
    """Write the CSV files, pictures and report of a comparison, and return a table for screens.

    A scenario that is not in `bounds` is written to the CSV files, but not to the report.
    `controllers` has the record of each controller by name, `provenance` is the provenance of
    the results, as `provenance_of` returns it, `note` is a sentence on controllers that are
    left out, and `error` says which results are missing.
    """
    tables = [pd.DataFrame(columns) for result in results for columns in result.runs]
    runs = pd.concat(tables, ignore_index=True)
    write_numbers(folder / "runs.csv", runs)
    write_numbers(folder / "summary.csv", summarise(runs))
    responses = {}
    for name in runs["scenario"].unique():
        columns = [result.responses for result in results if result.scenario == name]
        responses[name] = pd.concat(map(pd.DataFrame, columns))
        write_numbers(folder / f"{name}.csv", responses[name])
    # The report has the scenarios with both results and least possible errors.
    bounds = [bound for bound in bounds if bound.scenario.name in responses]
    runs = runs[runs["scenario"].isin([bound.scenario.name for bound in bounds])]
    if runs.empty:
        return note
    estimates = estimate(runs, bounds, controllers)
    write_numbers(folder / "estimates.csv", estimates.drop(columns="scores"))
    scores = ranked(estimates)
    comparison = Comparison(controllers, bounds, results, runs, estimates, scores)
    plots.plot_scores(scores, estimates, controllers, folder / "scores.png")
    for scenario, _ in bounds:
        rows = responses[scenario.name]
        rows = rows[rows["agent"].isin(pictured(scores))]
        # If the tasks of all pictured controllers have failed, `rows` is empty.
        if not rows.empty:
            errors = runs[runs["scenario"] == scenario.name].groupby("agent")["mae"].mean()
            path = folder / f"{scenario.name}.png"
            plots.plot_responses(rows, errors, scenario, controllers, path)
    page = sections(comparison, note)
    write_report(folder, "Comparison of controllers", page, provenance, error)
    return "\n".join(filter(None, [on_screen(comparison), note]))


def pictured(agents: Iterable[str]) -> list[str]:
    """Return the names of the controllers whose temperature and flow are drawn."""
    names = list(agents)
    chosen = [name for name in names if name in PICTURED or name not in ROSTER]
    return chosen if len(names) > MOST_PICTURED and chosen else names


def sections(comparison: Comparison, note: str) -> list[Section]:
    """Return the sections of a comparison's report, with `note` in the first section."""
    scenarios = [scenario for scenario, _ in comparison.bounds]
    shown = ", ".join(map(comparison.label, pictured(comparison.scores)))
    about_cases = [CASES_TEXT, f"The pictures show these controllers: {shown}."]
    if any("Figs" in scenario.title for scenario in scenarios):
        about_cases.append("Figs are the figures of the paper by Cui and Shin (1992).")
    return [
        Section(
            "Score: 0 for an idle valve, 1 for the least possible error",
            list(filter(None, [SCORE_TEXT, note])),
            score_table(comparison),
            pictures={"scores.png": "The score of each controller, and its score in each case"},
        ),
        Section(
            "Error ratio: mean error / least possible error, with a 95 % confidence interval",
            [RATIO_TEXT],
            ratio_table(comparison),
        ),
        Section("What each controller knows and costs", [COSTS_TEXT], costs_table(comparison)),
        Section(
            "Cases",
            about_cases,
            cases_table(scenarios),
            pictures={
                f"{scenario.name}.png": f"Temperature and flow over time: {scenario.title}"
                for scenario in scenarios
            },
        ),
    ]


def score_table(comparison: Comparison) -> pd.DataFrame:
    """Return a table of texts with the scores and the mean valve travel of each controller."""
    means = comparison.estimates["scores"].map(lambda scores: as_text(scores.mean(), ".2f"))
    table = table_by_agent(comparison, means)
    scores = [f"{score:.3f}" for score in comparison.scores.values()]
    table.insert(1, "score", scores)
    table.insert(2, "travel (t/h)", [comparison.travel(agent) for agent in comparison.scores])
    return table


def ratio_table(comparison: Comparison) -> pd.DataFrame:
    """Return a table of texts with least possible errors and error ratios in each scenario.

    The first row has the least possible errors, degC, and each further row has the error ratios
    of one controller. The mark * follows a least possible error of the kind "reference", which
    is the error for set-point changes that come as a surprise: controllers that have learnt the
    times of the changes can have a smaller error.
    """
    first_row = pd.DataFrame({"controller": ["least possible (°C)"]})
    for scenario, least in comparison.bounds:
        mark = "*" if least.kind == "reference" else ""
        first_row[scenario.name] = [f"{least.value:.3f}{mark}"]
    ratios = table_by_agent(comparison, comparison.estimates["ratio"].map("{:.2f}".format))
    return pd.concat([first_row, ratios], ignore_index=True)


def table_by_agent(comparison: Comparison, cells: Any) -> pd.DataFrame:
    """Return a table of texts, with a row for each controller and a column for each scenario.

    `cells` has a text for each row of `comparison.estimates`. The controller with the highest
    score comes first.
    """
    rows = comparison.estimates.assign(cell=cells)
    table = rows.pivot(index="agent", columns="scenario", values="cell")
    table = table.loc[list(comparison.scores), rows["scenario"].unique()].fillna("")
    table = table.rename(index=comparison.label)
    return table.rename_axis(index="controller", columns=None).reset_index()


def costs_table(comparison: Comparison) -> pd.DataFrame:
    """Return a table of texts on each controller's prior knowledge, robustness and costs."""
    rows = []
    for name in comparison.scores:
        controller = comparison.controllers[name]
        results = [result for result in comparison.results if result.agent == name]
        row = {
            "controller": controller.label,
            "prior knowledge": controller.knows,
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
    """Return the table of scores, error ratios and valve travel for a terminal of 80 columns.

    A heading of two words or more, such as "square zone 7", has its first word in the line
    above.
    """
    headings = [case.heading or case.name for case, _ in comparison.bounds]
    upper = []
    lower = []
    for heading in ("controller", "score", *headings, "travel (t/h)"):
        first, _, others = heading.partition(" ")
        upper.append(first if others else "")
        lower.append(others or first)
    rows = [upper, lower]
    ratios = comparison.estimates.set_index(["agent", "scenario"])["ratio"]
    for agent, score in comparison.scores.items():
        row = [comparison.label(agent)[:LONGEST_LABEL], f"{score.value:.3f}"]
        for scenario, _ in comparison.bounds:
            ratio = ratios.get((agent, scenario.name))
            row.append("" if ratio is None else f"{ratio.value:.2f}")
        rows.append([*row, comparison.travel(agent)])
    first_width, *widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for label, *cells in rows:
        aligned = [cell.rjust(width) for cell, width in zip(cells, widths, strict=True)]
        lines.append(" ".join([label.ljust(first_width), *aligned]))
    return "\n".join([*lines, SCREEN_TEXT])
