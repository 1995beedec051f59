"""Write the tables, pictures and report of a comparison of controllers in scenarios."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from benchmarks.compare.comparison import (
    Anticipations,
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
from benchmarks.lib.report import Section, write_report
from benchmarks.lib.statistics import Estimate, written
from benchmarks.loop.rollout import RESPONSE_SAMPLES, START_SAMPLES
from benchmarks.loop.scenarios import Scenario

SCORE = (
    "The score of a controller is the mean of its scores in the cases, with a 95 % interval. "
    "The valve travel is the mean over all runs. The last columns have the score in each "
    "case."
)
BOUND = (
    "The first row is the least possible error of a controller without foresight. The mark * "
    "means that the plant has settled before each change of the set point. In a case with "
    "this mark, a controller that knows when the set point changes can have a smaller error, "
    "down to the error in the second row."
)
ANTICIPATES = (
    "‡ The controller moves the valve before the square wave changes. Its score in this case "
    "is the score in runs with the same seeds in which nobody can foresee the changes."
)
SURPRISED = (
    "These controllers move the valve before the square wave changes. The column 'moved "
    "before the change' has the share of a change that the temperature has made before it can "
    "respond to the change. A controller that knows the period of the square wave can reach "
    "the error with foresight. The last column is the error ratio in runs whose changes "
    "nobody can foresee."
)
PAIRED = (
    "If a difference is below 0 °C, the controller has a smaller error than the controller in "
    "the heading. The percentage is the share of runs in which its error is smaller."
)
HARD = (
    "The mean error is the sum of the contributions of three parts of a run. All columns are "
    "in °C."
)
ROBUST = (
    "The loop of a linear controller has an Ms, which is the largest magnitude of its "
    "sensitivity function, and a range of delays with which the loop is stable. Both are "
    "computed for the nominal plant of the first case, away from the dead zone and the "
    "limits. PI (SIMC), Smith and Dahlin are tuned to the same Ms."
)
MISFIT = "†"  # marks controllers that were made for another plant
PARTS = {  # the columns of a part of the mean error, and of the mean error
    "mae_start": f"first {START_SAMPLES} samples",
    "mae_changes": f"{RESPONSE_SAMPLES} samples after later changes",
    "mae_steady": "the rest",
    "mae": "together",
}


@dataclass(frozen=True)
class Comparison:
    """All results of a comparison that the report shows.

    The scenarios are those whose least possible error has been computed.

    Attributes
    ----------
    controllers : mapping
        The record of each controller by name.
    results : sequence of Result
        The results of each controller in each scenario, as far as these tasks have finished.
    scales : mapping
        The least possible errors in each scenario, by the name of the scenario.
    runs : pandas.DataFrame
        A row for each run in the scenarios, as in `comparison.Result`.
    estimates : pandas.DataFrame
        A row for each scenario and controller, as `comparison.estimate` returns it.
    anticipations : mapping
        The anticipation of each controller that acts before a square wave changes, by the names
        of scenario and controller.
    misfits : mapping
        Sentences that say why a controller does not fit a plant, by the controller's name.
    scores : mapping
        The overall score of each controller by name, the best first and the misfits last.
    """

    controllers: Mapping[str, ControllerSpec]
    results: Sequence[Result]
    scales: Mapping[str, Scale]
    runs: pd.DataFrame
    estimates: pd.DataFrame
    anticipations: Anticipations
    misfits: Mapping[str, str]
    scores: Mapping[str, Estimate]


def write(
    results: Sequence[Result],
    scales: Sequence[Scale],
    controllers: Mapping[str, ControllerSpec],
    folder: Path,
    origin: Mapping[str, Any],
) -> None:
    """Write the CSV files, pictures and report of a comparison, and print the main tables.

    Parameters
    ----------
    results
        The results of each controller in each scenario.
    scales
        The least possible errors of the scenarios. A scenario whose least possible errors are
        missing is in the CSV files, but not in the report.
    controllers
        The record of each controller by name.
    folder
        The folder to write to.
    origin
        The provenance of the results, as `provenance.origin` returns it.
    """
    runs = pd.concat([result.runs for result in results], ignore_index=True)
    write_numbers(folder / "runs.csv", runs)
    write_numbers(folder / "summary.csv", summarise(runs))
    responses = {}
    for name in runs["scenario"].unique():
        tables = [result.responses for result in results if result.scenario == name]
        responses[name] = pd.concat(tables)
        write_numbers(folder / f"{name}.csv", responses[name])
    scale_of = {}
    for scale in scales:
        if scale.scenario.name in responses:
            scale_of[scale.scenario.name] = scale
    runs = runs[runs["scenario"].isin(list(scale_of))]
    if runs.empty:
        return
    anticipations = {
        (result.scenario, result.agent): result.anticipation
        for result in results
        if result.anticipation is not None
    }
    estimates = estimate(runs, scale_of, anticipations)
    write_numbers(folder / "estimates.csv", estimates.drop(columns=["scores", "mark"]))
    plants = [scale.scenario.parameters for scale in scale_of.values()]
    misfits = misfits_of(controllers, plants)
    comparison = Comparison(
        controllers=controllers,
        results=results,
        scales=scale_of,
        runs=runs,
        estimates=estimates,
        anticipations=anticipations,
        misfits=misfits,
        scores=ranked(estimates, misfits),
    )
    draw(comparison, responses, folder)
    write_report(folder, "Comparison of controllers", sections(comparison), origin, printed=2)


def draw(comparison: Comparison, responses: Mapping[str, pd.DataFrame], folder: Path) -> None:
    """Draw the scores, and the temperature and flow over time in each scenario.

    Controllers that do not fit the plants have no scores in the picture. Temperature and flow
    are drawn for the controllers whose record has `pictured` true, or for all controllers if
    there is no such record.

    Parameters
    ----------
    comparison
        The results.
    responses
        The tables `responses` of `comparison.Result` for all controllers, by the name of the
        scenario.
    folder
        The folder of the PNG files.
    """
    from benchmarks.compare import plots  # imported here, as matplotlib is slow to import

    runs = comparison.runs
    misfits = comparison.misfits
    fitting = {
        name: comparison.scores[name] for name in comparison.scores if name not in misfits
    }
    if fitting:
        plots.plot_scores(fitting, comparison.estimates, folder / "scores.png")
    pictured = [name for name in fitting if comparison.controllers[name].pictured]
    errors = runs.groupby(["scenario", "agent"])["mae"].mean()
    for name, scale in comparison.scales.items():
        rows = responses[name]
        if rows["agent"].isin(pictured).any():
            rows = rows[rows["agent"].isin(pictured)]
        plots.plot_responses(rows, errors[name], scale.scenario, folder / f"{name}.png")


def sections(comparison: Comparison) -> list[Section]:
    """Return the sections of the report whose tables have at least one row."""
    reference = label(str(comparison.runs["agent"].iloc[0]))
    first_scale = next(iter(comparison.scales.values()))
    titles = {name: scale.scenario.title for name, scale in comparison.scales.items()}
    candidates = [
        Section(
            "Score: 0 for an idle valve, 1 for the least possible error",
            [SCORE, *notes(comparison)],
            score_table(
                comparison.runs, comparison.estimates, comparison.scores, comparison.misfits
            ),
            pictures={
                "scores.png": "The score of each controller, and a small tick for each case"
            },
        ),
        Section(
            "Error ratio: mean error / least possible error, with its 95 % interval",
            [BOUND],
            ratio_table(comparison.estimates, comparison.scales, list(comparison.scores)),
        ),
        Section(
            "Anticipation: who moves before the square wave changes",
            [SURPRISED],
            anticipation_table(comparison.anticipations, comparison.estimates),
        ),
        Section(
            f"Difference to {reference} (°C), 95 % interval",
            [PAIRED],
            difference_table(comparison.estimates),
        ),
        Section(
            "Where the error arises: hard",
            [HARD],
            parts_table(comparison.runs),
        ),
        Section(
            "What each controller knows and costs",
            [ROBUST],
            costs_table(comparison.results, comparison.controllers, first_scale.scenario),
        ),
        Section(
            "Cases",
            table=pd.DataFrame(titles.items(), columns=["case", "what it is"]),
            pictures={
                f"{name}.png": f"Temperature and applied flow over time: {title}"
                for name, title in titles.items()
            },
        ),
    ]
    marks = {label(name): f"{label(name)} {MISFIT}" for name in comparison.misfits}
    filled = []
    for section in candidates:
        table = section.table
        if table is None or table.empty:
            continue
        if "controller" in table:
            table["controller"] = table["controller"].replace(marks)
        filled.append(section)
    return filled


def notes(comparison: Comparison) -> list[str]:
    """Return sentences on controllers that are not ranked, or ranked by surprising runs."""
    texts = {
        str(policy["note"])
        for result in comparison.results
        for policy in result.policies
        if "note" in policy
    }
    if comparison.anticipations:
        texts.add(ANTICIPATES)
    not_ranked = [
        f"{MISFIT} {reason} So its error is no measure of the controller, which is not ranked."
        for reason in comparison.misfits.values()
    ]
    return [*sorted(texts), *not_ranked]


def score_table(
    runs: pd.DataFrame,
    estimates: pd.DataFrame,
    scores: Mapping[str, Estimate],
    misfits: Collection[str] = (),
) -> pd.DataFrame:
    """Return a table of texts with the scores and the mean valve travel of each controller.

    Parameters
    ----------
    runs
        A row for each run, as in `comparison.Result`.
    estimates
        The table of `comparison.estimate`.
    scores
        The overall score of each controller by name, in the order of the rows of the result.
    misfits
        The names of controllers that do not fit the plants, which are shown as "not ranked".
    """
    agents = list(scores)
    cells = estimates["scores"].map(lambda scores: written(scores.mean(), ".2f"))
    table = _by_agent(estimates, cells + estimates["mark"], agents)
    travels = runs.groupby(["agent", "scenario"])["total_variation"].mean()
    overall = []
    for agent, score in scores.items():
        overall.append("not ranked" if agent in misfits else f"{score:.3f}")
    table.insert(1, "score", overall)
    table.insert(2, "travel (t/h)", [f"{travels[agent].mean():,.0f}" for agent in agents])
    return table


def ratio_table(
    estimates: pd.DataFrame, scales: Mapping[str, Scale], agents: Sequence[str]
) -> pd.DataFrame:
    """Return a table of texts with least possible errors and error ratios in each scenario.

    The first two rows have the least possible errors without and with knowledge of future set
    points, degC. The other rows have the error ratios of the controllers.

    Parameters
    ----------
    estimates
        The table of `comparison.estimate`.
    scales
        The least possible errors in each scenario, by the name of the scenario.
    agents
        The names of the controllers, in the order of the rows.
    """
    bounds = pd.DataFrame({"controller": ["least possible (°C)", "with foresight (°C)"]})
    for name, scale in scales.items():
        mark = "*" if scale.least.kind == "reference" else ""
        bounds[name] = [f"{scale.least.value:.3f}{mark}", f"{scale.preview:.3f}"]
    cells = estimates["ratio"].map("{:.2f}".format) + estimates["mark"]
    return pd.concat([bounds, _by_agent(estimates, cells, agents)], ignore_index=True)


def anticipation_table(anticipations: Anticipations, estimates: pd.DataFrame) -> pd.DataFrame:
    """Return a table of texts on the controllers that act before a square wave changes.

    There is a row for each scenario and controller in `anticipations`. `estimates` is the table
    of `comparison.estimate`.
    """
    rows = []
    for row in estimates.to_dict("records"):
        anticipation = anticipations.get((row["scenario"], row["agent"]))
        if anticipation is None:
            continue
        rows.append(
            {
                "case": row["scenario"],
                "controller": label(row["agent"]),
                "moved before the change (%)": f"{anticipation.movement.scaled(100.0):.0f}",
                "mean error (°C)": f"{row['mean'].value:.3f}",
                "without foresight": f"{row['limit']:.3f}",
                "with foresight": f"{row['preview']:.3f}",
                "error ratio": f"{row['ratio'].value:.2f}",
                "error ratio where changes surprise": f"{anticipation.ratio:.2f}",
            }
        )
    return pd.DataFrame(rows)


def difference_table(estimates: pd.DataFrame) -> pd.DataFrame:
    """Return a table of texts that compares the errors with those of the reference controller.

    A cell has the mean difference of the errors, degC, and the share of the runs in which the
    error is smaller than that of the reference. `estimates` is the table of
    `comparison.estimate`. If there is only one controller, the result is empty.
    """
    if "difference" not in estimates:
        return pd.DataFrame()
    compared = estimates.dropna(subset=["difference"])
    cells = []
    for difference, improvement in zip(
        compared["difference"], compared["improvement"], strict=True
    ):
        cells.append(f"{difference:+.3f}; {100 * improvement.value:.0f} %")
    return _by_agent(compared, cells, list(compared["agent"].unique()))


def _by_agent(rows: pd.DataFrame, cells: Any, agents: Sequence[str]) -> pd.DataFrame:
    """Return a table of texts, with a row for each controller and a column for each scenario.

    Parameters
    ----------
    rows
        A table with the columns `scenario` and `agent` (the controller), one row for each cell.
    cells
        The texts of the cells, in the order of `rows`.
    agents
        The names of the controllers, in the order of the rows of the result.
    """
    table = rows.assign(cell=cells).pivot(index="agent", columns="scenario", values="cell")
    table = table.loc[list(agents), rows["scenario"].unique()].fillna("").rename(index=label)
    return table.rename_axis(index="controller", columns=None).reset_index()


def parts_table(runs: pd.DataFrame) -> pd.DataFrame:
    """Return a table of texts with the parts of the mean error in the scenario `hard`, degC.

    `PARTS` has the parts. There is a row for each controller, the smallest mean error first.
    `runs` has a row for each run, as in `comparison.Result`.
    """
    means = runs[runs["scenario"] == "hard"].groupby("agent")[list(PARTS)].mean()
    texts = means.sort_values("mae").map("{:.3f}".format)
    return texts.rename(index=label, columns=PARTS).rename_axis("controller").reset_index()


def costs_table(
    results: Sequence[Result], controllers: Mapping[str, ControllerSpec], scenario: Scenario
) -> pd.DataFrame:
    """Return a table of texts on knowledge, robustness and costs, a row for each controller.

    Parameters
    ----------
    results
        The results of each controller in each scenario, which have the processor times.
    controllers
        The record of each controller by name, in the order of the rows.
    scenario
        The scenario for whose nominal plant the robustness of linear controllers is computed.
    """
    rows = []
    for name, controller in controllers.items():
        of_controller = [result for result in results if result.agent == name]
        # A user's own controller says in its provenance what the roster says of a controller.
        policies = [policy for result in of_controller for policy in result.policies]
        provenance = policies[0] if policies else {}
        sensitivity, delays = robustness(controller, scenario)
        row = {
            "controller": label(name),
            "prior knowledge": controller.knows or provenance.get("knows", ""),
            "Ms": sensitivity,
            "stable with delays of (samples)": delays,
            "searched or trained": controller.searched or provenance.get("searched", ""),
            "processor time (s)": f"{sum(result.seconds for result in of_controller):.1f}",
        }
        rows.append(row)
    return pd.DataFrame(rows)


def robustness(controller: ControllerSpec, scenario: Scenario) -> tuple[str, str]:
    """Return two texts on the robustness of a controller's loop, or two empty texts.

    The first text is Ms, the maximum sensitivity of the loop with the nominal plant of the
    scenario, and the second text is the range of the delays, in samples, with which the loop is
    stable. If the controller is not linear, both texts are empty.
    """
    if not controller.linear:
        return "", ""
    loop = controller.loop(scenario.arguments)
    delays = loop.stable_delays()
    if delays is None:
        return "unstable", "none around the plant's"
    return f"{loop.sensitivity():.2f}", f"{delays[0]} to {delays[1]}"
