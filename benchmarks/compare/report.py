"""Write the tables, pictures and report of a comparison of controllers in scenarios."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from benchmarks.compare import plots
from benchmarks.compare.comparison import (
    Result,
    Scale,
    estimate,
    misfits_of,
    ranked,
    summarise,
    write_numbers,
)
from benchmarks.controllers.roster import label
from benchmarks.controllers.spec import ControllerSpec
from benchmarks.lib.command import CommandError
from benchmarks.lib.report import Section, show, write_report
from benchmarks.lib.statistics import Estimate, as_text
from benchmarks.loop.rollout import RESPONSE_SAMPLES, START_SAMPLES
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
    "controller that does not know future set points, and the second row has the least "
    "possible error of a controller that knows them. The mark * means that the plant settles "
    "before each change of the set point, and that the error in the first row assumes that "
    "each change comes as a surprise. In a case with the mark *, a controller that has learnt "
    "when the set point changes can have an error ratio below 1.00."
)
DIFFERENCE_TEXT = (
    "The reference is the controller that was named first, here {reference}. A cell has the "
    "error of a controller minus the error of the reference in the same run, in °C: the mean "
    "over the runs, with a 95 % confidence interval. A negative difference means that the "
    "controller has the smaller error. The percentage is the share of the runs in which the "
    "controller has the smaller error."
)
PARTS_TEXT = (
    "The mean error on the preset hard, in °C, is the sum of three contributions: those of the "
    f"first {START_SAMPLES} samples of a run, of the {RESPONSE_SAMPLES} samples after each "
    "later change of the set point, and of the remaining samples."
)
COSTS_TEXT = (
    "The column 'prior knowledge' says what a controller knows about the plant before a run, "
    "and the column 'searched or trained' says how its settings or weights were found; 1 M "
    "samples are a million samples. Ms is the maximum sensitivity of a control loop, the "
    "largest magnitude of its sensitivity function: the lower Ms is, the more robust is the "
    "loop. Ms and the range of delays with which the loop is stable are given for linear "
    "controllers, with the nominal plant of the first case, without dead zone and limits."
)
CASES_TEXT = (
    "Each case is the environment MiddlePoint-v0 with the arguments in the last column; all "
    "other arguments have their default values."
)
MOST_PICTURED = 8  # largest number of controllers in a picture of responses over time
MISFIT_MARK = "†"  # marks controllers that were made for another plant
PARTS_OF_ERROR = {  # names of the parts of the mean error in CSV files and in the report
    "mae_start": f"first {START_SAMPLES} samples",
    "mae_changes": f"{RESPONSE_SAMPLES} samples after later changes",
    "mae_steady": "remaining samples",
    "mae": "mean error",
}


@dataclass(frozen=True)
class Comparison:
    """All results of a comparison that the report shows.

    Attributes
    ----------
    controllers : mapping
        Record (`ControllerSpec`) of each controller by name.
    results : sequence of Result
        Results of each controller in each scenario, from all tasks that have finished.
    scales : mapping
        Least possible errors by the name of the scenario, for all scenarios of the report.
    runs : pandas.DataFrame
        Table with a row for each run in each scenario, like `comparison.Result.runs`.
    estimates : pandas.DataFrame
        Table with a row for each scenario and controller, from `comparison.estimate`.
    misfits : mapping
        Sentences that say why a controller does not fit a plant, by the controller's name.
    scores : mapping
        Overall score of each controller by name, in the order in which tables list controllers.
    """

    controllers: Mapping[str, ControllerSpec]
    results: Sequence[Result]
    scales: Mapping[str, Scale]
    runs: pd.DataFrame
    estimates: pd.DataFrame
    misfits: Mapping[str, str]
    scores: Mapping[str, Estimate]

    @property
    def ranked(self) -> list[str]:
        """The names of the controllers that fit all plants, the best first."""
        return [name for name in self.scores if name not in self.misfits]

    @property
    def pictured(self) -> list[str]:
        """Names of the controllers whose temperature and flow are drawn, the best first.

        The drawn controllers are the `ranked` controllers, or all controllers if none is
        ranked. Of more than `MOST_PICTURED` controllers, only controllers whose record has
        `pictured` true are drawn.
        """
        names = self.ranked or list(self.scores)
        chosen = [name for name in names if self.controllers[name].pictured]
        if len(names) > MOST_PICTURED and chosen:
            return chosen
        return names


def write(
    results: Sequence[Result],
    scales: Sequence[Scale],
    controllers: Mapping[str, ControllerSpec],
    folder: Path,
    provenance: Mapping[str, Any],
    error: CommandError | None,
) -> None:
    """Write the CSV files, pictures and report of a comparison, and print the main tables.

    A scenario whose least possible errors are not in `scales` is written to the CSV files, but
    not to the report. `controllers` has the record (`ControllerSpec`) of each controller by
    name, `provenance` is the provenance of the results, as `provenance_of` returns it, and
    `error` says which results are missing.
    """
    runs = pd.concat([result.runs for result in results], ignore_index=True)
    write_numbers(folder / "runs.csv", runs)
    write_numbers(folder / "summary.csv", summarise(runs))
    responses = {}
    for name in runs["scenario"].unique():
        tables = [result.responses for result in results if result.scenario == name]
        responses[name] = pd.concat(tables)
        write_numbers(folder / f"{name}.csv", responses[name])
    # The report has the scenarios with both results and least possible errors.
    scale_of = {
        scale.scenario.name: scale for scale in scales if scale.scenario.name in responses
    }
    runs = runs[runs["scenario"].isin(list(scale_of))]
    if runs.empty:
        return
    estimates = estimate(runs, scale_of)
    write_numbers(folder / "estimates.csv", estimates.drop(columns="scores"))
    plants = [scale.scenario.parameters for scale in scale_of.values()]
    misfits = misfits_of(controllers, plants)
    comparison = Comparison(
        controllers=controllers,
        results=results,
        scales=scale_of,
        runs=runs,
        estimates=estimates,
        misfits=misfits,
        scores=ranked(estimates, misfits),
    )
    draw(comparison, responses, folder)
    page = sections(comparison)
    write_report(folder, "Comparison of controllers", page, provenance, error)
    show(*page[:2])


def draw(comparison: Comparison, responses: Mapping[str, pd.DataFrame], folder: Path) -> None:
    """Draw PNG files of the scores, and of temperature and flow over time in each scenario.

    `responses` has, by the name of the scenario, a table that joins the tables
    `Result.responses` of all controllers.
    """
    scores = {name: comparison.scores[name] for name in comparison.ranked}
    if scores:
        plots.plot_scores(scores, comparison.estimates, folder / "scores.png")
    errors = comparison.runs.groupby(["scenario", "agent"])["mae"].mean()
    for name, scale in comparison.scales.items():
        rows = responses[name]
        rows = rows[rows["agent"].isin(comparison.pictured)]
        # If the tasks of all pictured controllers have failed, `rows` is empty.
        if not rows.empty:
            plots.plot_responses(rows, errors[name], scale.scenario, folder / f"{name}.png")


def sections(comparison: Comparison) -> list[Section]:
    """Return the sections of a comparison's report, without sections whose table is empty."""
    reference = label(str(comparison.runs["agent"].iloc[0]))
    scenarios = [scale.scenario for scale in comparison.scales.values()]
    candidates = [
        Section(
            "Score: 0 for an idle valve, 1 for the least possible error",
            [SCORE_TEXT, *notes(comparison)],
            score_table(comparison),
            pictures={"scores.png": "The score of each controller, and its score in each case"},
        ),
        Section(
            "Error ratio: mean error / least possible error, with a 95 % confidence interval",
            [RATIO_TEXT],
            ratio_table(comparison),
        ),
        Section(
            f"Difference to the error of the reference: {reference}",
            [DIFFERENCE_TEXT.format(reference=reference)],
            difference_table(comparison),
        ),
        Section(
            "Where the error arises on the preset hard",
            [PARTS_TEXT],
            parts_table(comparison.runs),
        ),
        Section(
            "What each controller knows and costs",
            [COSTS_TEXT],
            costs_table(comparison.results, comparison.controllers, scenarios[0]),
        ),
        Section(
            "Cases",
            notes_on_cases(comparison, scenarios),
            cases_table(scenarios),
            pictures={
                f"{scenario.name}.png": f"Temperature and flow over time: {scenario.title}"
                for scenario in scenarios
            },
        ),
    ]
    marks = {label(name): f"{label(name)} {MISFIT_MARK}" for name in comparison.misfits}
    filled = []
    for section in candidates:
        table: Any = section.table
        if table.empty:
            continue
        if "controller" in table:
            table["controller"] = table["controller"].replace(marks)
        filled.append(section)
    return filled


def notes(comparison: Comparison) -> list[str]:
    """Return sentences on controllers that are not ranked.

    The notes that users' own controllers have, such as a note on a missing environment, come
    first.
    """
    texts = {
        str(policy["note"])
        for result in comparison.results
        for policy in result.policies
        if "note" in policy
    }
    not_ranked = [
        f"{MISFIT_MARK} {reason} So its error says little about the controller, which is not "
        "ranked."
        for reason in comparison.misfits.values()
    ]
    return [*sorted(texts), *not_ranked]


def notes_on_cases(comparison: Comparison, scenarios: Sequence[Scenario]) -> list[str]:
    """Return paragraphs that explain the table of cases, and name the pictured controllers."""
    texts = [CASES_TEXT]
    if any("Figs" in scenario.title for scenario in scenarios):
        texts.append("Figs are the figures of the paper by Cui and Shin (1992).")
    if len(comparison.pictured) < len(comparison.controllers):
        names = ", ".join(label(name) for name in comparison.pictured)
        texts.append(f"The pictures show these controllers: {names}.")
    return texts


def score_table(comparison: Comparison) -> pd.DataFrame:
    """Return a table of texts with the scores and the mean valve travel of each controller.

    The rows have the order of `Comparison.scores`. A controller that does not fit the plants
    has the text "not ranked" in place of an overall score.
    """
    estimates = comparison.estimates
    agents = list(comparison.scores)
    cells = estimates["scores"].map(lambda scores: as_text(scores.mean(), ".2f"))
    table = table_by_agent(estimates, cells, agents)
    travels = comparison.runs.groupby(["agent", "scenario"])["total_variation"].mean()
    overall = []
    for agent, score in comparison.scores.items():
        overall.append("not ranked" if agent in comparison.misfits else f"{score:.3f}")
    table.insert(1, "score", overall)
    table.insert(2, "travel (t/h)", [f"{travels[agent].mean():,.0f}" for agent in agents])
    return table


def ratio_table(comparison: Comparison) -> pd.DataFrame:
    """Return a table of texts with least possible errors and error ratios in each scenario.

    The first two rows have the least possible errors without and with knowledge of future set
    points, degC. Each further row has the error ratios of one controller. The mark * follows a
    least possible error of the kind "reference", which is the error for set-point changes that
    come as a surprise: controllers that have learnt the times of the changes can have a smaller
    error.
    """
    bounds = pd.DataFrame({"controller": ["least possible (°C)", "with foresight (°C)"]})
    for name, scale in comparison.scales.items():
        mark = "*" if scale.least.kind == "reference" else ""
        bounds[name] = [f"{scale.least.value:.3f}{mark}", f"{scale.preview:.3f}"]
    estimates = comparison.estimates
    cells = estimates["ratio"].map("{:.2f}".format)
    ratios = table_by_agent(estimates, cells, list(comparison.scores))
    return pd.concat([bounds, ratios], ignore_index=True)


def difference_table(comparison: Comparison) -> pd.DataFrame:
    """Return a table of texts that compares each controller with the reference controller.

    The reference controller is that of the first row of `comparison.runs`. A cell has the mean
    of a controller's error minus the error of the reference controller, degC, and the share of
    the runs in which the controller has the smaller error. If a comparison has only one
    controller, the table is empty.
    """
    if "difference" not in comparison.estimates:
        return pd.DataFrame()
    compared = comparison.estimates.dropna(subset=["difference"])
    differences = compared["difference"].map("{:+.3f}".format)
    shares = compared["improvement"].map(lambda share: f"{100 * share.value:.0f} %")
    return table_by_agent(
        compared, differences + "; " + shares, list(compared["agent"].unique())
    )


def table_by_agent(rows: pd.DataFrame, cells: Any, agents: Sequence[str]) -> pd.DataFrame:
    """Return a table of texts, with a row for each controller and a column for each scenario.

    `rows` has the columns `scenario` and `agent` (the controller), and `cells` has a text for
    each row of `rows`. The rows of the returned table have the order of `agents`.
    """
    table = rows.assign(cell=cells).pivot(index="agent", columns="scenario", values="cell")
    table = table.loc[list(agents), rows["scenario"].unique()].fillna("").rename(index=label)
    return table.rename_axis(index="controller", columns=None).reset_index()


def parts_table(runs: pd.DataFrame) -> pd.DataFrame:
    """Return a table of texts that splits the mean error on the preset `hard` into parts, degC.

    The table has a column for each of `PARTS_OF_ERROR`, and a row for each controller, the
    smallest mean error first.
    """
    means = runs[runs["scenario"] == "hard"].groupby("agent")[list(PARTS_OF_ERROR)].mean()
    texts = means.sort_values("mae").map("{:.3f}".format)
    return (
        texts.rename(index=label, columns=PARTS_OF_ERROR)
        .rename_axis("controller")
        .reset_index()
    )


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


def costs_table(
    results: Sequence[Result], controllers: Mapping[str, ControllerSpec], scenario: Scenario
) -> pd.DataFrame:
    """Return a table of texts on each controller's prior knowledge, robustness and costs.

    The robustness of linear controllers is computed with the nominal plant of `scenario`.
    `controllers` has the record of each controller by name.
    """
    rows = []
    for name, controller in controllers.items():
        own_results = [result for result in results if result.agent == name]
        # The record of a user's own controller has no texts for the table. The provenance of
        # the controller may have such texts.
        policies = [policy for result in own_results for policy in result.policies]
        provenance = policies[0] if policies else {}
        sensitivity, delays = robustness_texts(controller, scenario)
        row = {
            "controller": label(name),
            "prior knowledge": controller.knows or provenance.get("knows", ""),
            "Ms": sensitivity,
            "stable with delays of (samples)": delays,
            "searched or trained": controller.searched or provenance.get("searched", ""),
            "processor time (s)": f"{sum(result.seconds for result in own_results):.1f}",
        }
        rows.append(row)
    return pd.DataFrame(rows)


def robustness_texts(controller: ControllerSpec, scenario: Scenario) -> tuple[str, str]:
    """Return two texts on the robustness of the loop of a controller with a plant.

    The first text is Ms, the maximum sensitivity of the loop with the nominal plant of the
    scenario, and the second text is the range of the delays, in samples, with which the loop is
    stable. If the loop is unstable, the texts are "unstable" and "none". If the controller is
    not linear, both texts are empty.
    """
    if not controller.linear:
        return "", ""
    loop = controller.loop(scenario.arguments)
    delays = loop.stable_delays()
    if delays is None:
        return "unstable", "none"
    shortest, longest = delays
    return f"{loop.sensitivity():.2f}", f"{shortest} to {longest}"
