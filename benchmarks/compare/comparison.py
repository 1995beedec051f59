"""Run controllers on cases, estimate how far they are from the least possible error, report."""

import math
import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.compare.anticipation import Anticipation, anticipation
from benchmarks.controllers.roster import ROSTER, label
from benchmarks.controllers.spec import ControllerSpec
from benchmarks.lib.report import Section, write_report
from benchmarks.lib.statistics import Estimate, bootstrap, percentiles, written
from benchmarks.lib.storage import write_csv
from benchmarks.loop.rollout import CHANGE, START, Trajectory, is_random, measure
from benchmarks.loop.scenarios import Scenario
from mptc_gym import Parameters
from mptc_gym.evaluation import EPISODES

BOOTSTRAP = 0  # seed of the bootstraps
SCORE = (
    "A score is the mean over the cases, with its 95 % interval. Valve travel is the mean over "
    "all runs."
)
BOUND = (
    "The first row is the least possible error of controllers without foresight. Where it is "
    "marked *, the plant has settled before each change of the set point; a controller that "
    "knows when the changes come can do better, down to the second row."
)
ANTICIPATES = (
    "‡ The controller moves before the square wave changes. Its score in this case is that of "
    "runs with the same seeds in which nobody can foresee the changes."
)
SURPRISED = (
    "These controllers move before the square wave changes. The table shows how much of the "
    "change they have made before they can have seen it. A controller that knows the period of "
    "the square wave can reach the error with foresight. The last column divides the error in "
    "runs whose changes nobody can foresee by the least possible error of these runs."
)
PAIRED = (
    "A number below 0 means that the controller is better. The percentage is the share of runs "
    "in which it is better."
)
ROBUST = (
    "Linear controllers have an Ms, the largest magnitude of the loop's sensitivity, and a "
    "range of delays with which the loop is stable. Both are computed for the nominal plant "
    "of the first case, away from the dead zone and the limits. PI (SIMC), Smith and Dahlin "
    "are tuned to the same Ms."
)
MARK = "†"  # of controllers that were made for another plant
PARTS = {
    "mae_start": f"first {START} samples",
    "mae_changes": f"{CHANGE} samples after later changes",
    "mae_steady": "the rest",
    "mae": "together",
}


@dataclass(frozen=True)
class Case:
    """The results of a controller in a case."""

    scenario: str
    agent: str
    runs: pd.DataFrame  # measures, a row for each run of each member
    responses: pd.DataFrame  # percentiles over the runs, a row for each sample
    policies: Sequence[Mapping[str, Any]]  # origins of the members that were trained
    seconds: float  # processor time of the runs
    anticipation: Anticipation | None = None  # if it moves before a square wave changes


def run_case(scenario: Scenario, controller: ControllerSpec, runs: int, seed: int) -> Case:
    """Run all members of a controller on a case; run i has the seed `seed + i`.

    Where nothing is drawn, all runs are alike: then there is one, and its row is repeated.
    """
    began = time.process_time()
    members = controller.members()
    all_alike = not (controller.random or is_random(scenario.parameters))
    count = 1 if all_alike else runs
    trajectories = [
        member.run(scenario.arguments, scenario.samples, count, seed) for member in members
    ]
    tables = []
    for number, trajectory in enumerate(trajectories):
        columns: dict[str, Any] = {"scenario": scenario.name, "agent": controller.name}
        columns["policy"] = number
        columns["seed"] = range(seed, seed + runs)
        for name, values in measure(trajectory, scenario.parameters).items():
            columns[name] = np.broadcast_to(values, runs)
        tables.append(pd.DataFrame(columns))
    seconds = time.process_time() - began
    return Case(
        scenario.name,
        controller.name,
        pd.concat(tables, ignore_index=True),
        _responses(trajectories, scenario, controller.name),
        [dict(member.provenance) for member in members if member.provenance],
        seconds,
        anticipation(scenario, members, trajectories, runs, seed),
    )


def _responses(members: Sequence[Trajectory], scenario: Scenario, agent: str) -> pd.DataFrame:
    """Return the set point, the first run, and percentiles over the runs, one row per sample.

    The signals are the output and the applied flow. If the runs differ in their set points,
    the percentiles are those of the first run alone.
    """
    setpoint = members[0].setpoint[:, 0]
    k = np.arange(len(setpoint))
    interval = scenario.parameters.sampling_interval
    columns = {"agent": agent, "sample": k, "time_s": k * interval, "setpoint": setpoint}
    for signal in ("output", "applied"):
        values = np.hstack([getattr(trajectory, signal) for trajectory in members])
        columns[f"{signal}_run"] = values[:, 0]
        if scenario.parameters.setpoint == "random":
            values = values[:, :1]
        # Values that occurred: an interpolated applied input could lie in the dead zone.
        for name, percentile in percentiles(values, "nearest").items():
            columns[f"{signal}_{name}"] = percentile
    return pd.DataFrame(columns)


@dataclass(frozen=True)
class Scale:
    """The bounds that the errors of a case are measured against."""

    scenario: Scenario
    least: Any  # `LeastPossible` of the kind that applies
    preview: float  # the least possible error of any controller, even with foresight, degC


def scale_of(scenario: Scenario, runs: int, seed: int) -> Scale:
    """Return the bounds on the errors of a case: means over the episodes that are run."""
    from benchmarks.bounds.least import least_possible  # here: SciPy is slow to import

    of_episodes = partial(
        least_possible, samples=scenario.samples, episodes=min(runs, EPISODES), seed=seed
    )
    least = of_episodes(**scenario.arguments)
    least.score(0.0)  # raises an error if nothing is better than no control
    preview = of_episodes(kind="preview", **scenario.arguments)
    return Scale(scenario, least, preview.value)


def estimate(
    runs: pd.DataFrame,
    scales: Mapping[str, Scale],
    anticipations: Mapping[tuple[str, str], Anticipation] = MappingProxyType({}),
) -> pd.DataFrame:
    """Return estimates with 95 % intervals, one row for each case and agent.

    They are the `mean` of |e|, degC; `ratio`, the mean divided by `limit`, the least
    possible error; `difference`, the mean paired difference from the first agent; and
    `improvement`, the probability of doing better than that agent, where ties count half.
    `preview` is the least possible error with foresight, `scores` those of the runs, an array:
    of surprising ones, with a `mark`, if `anticipations` has the case and the agent.
    Ends are infinite if runs differ but there is only one.
    """
    reference, rows = runs["agent"].iloc[0], []
    for name, scale in scales.items():
        tables = {
            str(agent): own.pivot_table(index="policy", columns="seed", values="mae").to_numpy()
            for agent, own in runs[runs["scenario"] == name].groupby("agent", sort=False)
        }
        base = tables[reference].mean(axis=0) if reference in tables else None
        limit, drawn = scale.least.value, is_random(scale.scenario.parameters)
        for agent, errors in tables.items():
            mean = bootstrap(errors, seed=BOOTSTRAP)
            if errors.size == 1 and (drawn or (agent in ROSTER and ROSTER[agent].random)):
                mean = replace(mean, low=-math.inf, high=math.inf)
            row = {"scenario": name, "agent": agent, "limit": limit, "preview": scale.preview}
            row |= {"mean": mean, "ratio": mean.scaled(1 / limit)}
            row |= {"scores": scale.least.score(errors), "mark": ""}
            if (name, agent) in anticipations:
                row |= {"scores": anticipations[name, agent].scores, "mark": "‡"}
            if base is not None and agent != reference:
                row["difference"] = bootstrap(errors - base, seed=BOOTSTRAP)
                better = (errors < base) + 0.5 * (errors == base)
                row["improvement"] = bootstrap(better, seed=BOOTSTRAP)
            rows.append(row)
    return pd.DataFrame(rows)


def misfits_of(
    controllers: Mapping[str, ControllerSpec], plants: Sequence[Parameters]
) -> dict[str, str]:
    """Return the controllers that were made for other plants, and why, in a sentence each."""
    misfits: dict[str, str] = {}
    for name, spec in controllers.items():
        for plant in plants:
            reason = spec.misfit(plant)
            if reason:
                misfits.setdefault(name, reason)
    return misfits


def ranked(estimates: pd.DataFrame, misfits: Collection[str] = ()) -> dict[str, Estimate]:
    """Return the overall scores of all agents, the best first; `misfits` come last.

    They are means over the cases, however hard these are. The 95 % intervals resample policies
    and runs within each case.
    """
    scores = {
        str(agent): bootstrap(*tables, seed=BOOTSTRAP)
        for agent, tables in estimates.groupby("agent", sort=False)["scores"]
    }
    return dict(sorted(scores.items(), key=lambda item: (item[0] in misfits, -item[1].value)))


def summarise(runs: pd.DataFrame) -> pd.DataFrame:
    """Return percentiles over the runs, one row for each case, agent and metric."""
    metrics = runs.columns.drop(["scenario", "agent", "policy", "seed"])
    return pd.DataFrame(
        [
            {"scenario": scenario, "agent": agent, "metric": metric, "runs": len(group)}
            | percentiles(group[metric].to_numpy())
            for (scenario, agent), group in runs.groupby(["scenario", "agent"], sort=False)
            for metric in metrics
        ]
    )


def write(
    cases: Sequence[Case],
    found: Sequence[Scale],
    controllers: Mapping[str, ControllerSpec],
    folder: Path,
    made: Mapping[str, Any],
) -> None:
    """Write the numbers, pictures and report of finished cases, and print the main tables.

    A case without a scale, as its bounds have failed, is in the numbers only.
    """
    runs = pd.concat([case.runs for case in cases], ignore_index=True)
    responses = {
        name: pd.concat([each.responses for each in cases if each.scenario == name])
        for name in runs["scenario"].unique()
    }
    for name, table in {"runs": runs, "summary": summarise(runs), **responses}.items():
        write_numbers(folder / f"{name}.csv", table)
    scales = {each.scenario.name: each for each in found if each.scenario.name in responses}
    runs = runs[runs["scenario"].isin([*scales])]
    if runs.empty:
        return
    anticipations = {
        (case.scenario, case.agent): case.anticipation
        for case in cases
        if case.anticipation is not None
    }
    estimates = estimate(runs, scales, anticipations)
    plants = [scale.scenario.parameters for scale in scales.values()]
    misfits = misfits_of(controllers, plants)
    scores = ranked(estimates, misfits)
    write_numbers(folder / "estimates.csv", estimates.drop(columns=["scores", "mark"]))
    errors = runs.groupby(["scenario", "agent"])["mae"].mean()
    pictured = [
        name for name, spec in controllers.items() if spec.pictured and name not in misfits
    ]
    from benchmarks.compare import plots  # here: processes that run cases do without

    fitting = {agent: score for agent, score in scores.items() if agent not in misfits}
    if fitting:
        plots.plot_scores(fitting, estimates, folder / "scores.png")
        shown = runs[runs["agent"].isin(fitting)]
        plots.plot_travel(shown, estimates, [*fitting], folder / "travel.png")
    for name, scale in scales.items():
        few = responses[name][responses[name]["agent"].isin(pictured)]
        rows, path = responses[name] if few.empty else few, folder / f"{name}.png"
        plots.plot_responses(rows, errors[name], scale.scenario, path)
    sections = report(
        runs, estimates, scores, scales, cases, controllers, misfits, anticipations
    )
    write_report(folder, "Comparison of controllers", sections, made, printed=2)


def write_numbers(path: Path, table: pd.DataFrame) -> None:
    """Write a table of numbers, texts and estimates as CSV.

    An estimate becomes three columns: its value and the ends of its interval, empty if they are
    unknown. Infinite values, which apart from these are settling times, are written in words.
    """
    columns: dict[Any, Any] = {}
    for name, cells in table.items():
        columns[name] = cells
        if any(isinstance(cell, Estimate) for cell in cells):
            for end, suffix in (("value", ""), ("low", "_low"), ("high", "_high")):
                ends = [getattr(cell, end, math.nan) for cell in cells]
                columns[f"{name}{suffix}"] = [x if math.isfinite(x) else math.nan for x in ends]
    flat = pd.DataFrame(columns)
    write_csv(path, flat.astype(object).where(flat != math.inf, "not settled"))


def report(
    runs: pd.DataFrame,
    estimates: pd.DataFrame,
    scores: Mapping[str, Estimate],
    scales: Mapping[str, Scale],
    cases: Sequence[Case],
    controllers: Mapping[str, ControllerSpec],
    misfits: Mapping[str, str],
    anticipations: Mapping[tuple[str, str], Anticipation],
) -> list[Section]:
    """Return the sections of the report that have anything to show."""
    reference = str(runs["agent"].iloc[0])
    notes = {each["note"] for case in cases for each in case.policies if "note" in each}
    not_ranked = [
        f"{MARK} Not ranked, as its error here is no result: {reason}"
        for reason in misfits.values()
    ]
    if anticipations:
        notes.add(ANTICIPATES)
    paired = difference_table(estimates)
    parts = runs[runs["scenario"] == "hard"].groupby("agent")[[*PARTS]].mean()
    parts = parts.sort_values("mae").map("{:.3f}".format).rename(index=label, columns=PARTS)
    titles = {name: scale.scenario.title for name, scale in scales.items()}
    sections = [
        Section(
            "Score: 0 for an idle valve, 1 for the least possible error",
            [SCORE, *sorted(notes), *not_ranked],
            score_table(runs, estimates, scores, misfits),
            pictures={
                "scores.png": "The score of each controller, and a small tick for each case",
                "travel.png": "Mean error and mean valve travel of each controller; the lower "
                "left is better",
            },
        ),
        Section(
            "Error ratio: mean error / least possible error, with its 95 % interval",
            [BOUND],
            ratio_table(estimates, scales, [*scores]),
        ),
        Section(
            "Anticipation: who moves before the square wave changes",
            [SURPRISED],
            anticipation_table(anticipations, estimates),
        ),
        Section(f"Difference to {label(reference)} (°C), 95 % interval", [PAIRED], paired),
        Section(
            "Where the error arises: hard",
            ["The columns are the contributions of parts of the run to the mean error, in °C."],
            parts.rename_axis("controller").reset_index(),
        ),
        Section(
            "What each controller knows and costs",
            [ROBUST],
            costs_table(cases, controllers, next(iter(scales.values())).scenario),
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
    marks = {label(agent): f"{label(agent)} {MARK}" for agent in misfits}
    for section in sections:
        if section.table is not None and "controller" in section.table:
            section.table["controller"] = section.table["controller"].replace(marks)
    return [each for each in sections if each.table is None or len(each.table)]


def anticipation_table(
    anticipations: Mapping[tuple[str, str], Anticipation], estimates: pd.DataFrame
) -> pd.DataFrame:
    """Return what controllers gain that move before a square wave changes, a row for each."""
    rows = []
    for row in estimates.to_dict("records"):
        found = anticipations.get((row["scenario"], row["agent"]))
        if found is None:
            continue
        rows.append(
            {
                "case": row["scenario"],
                "controller": label(row["agent"]),
                "moved before the change (%)": f"{found.movement.scaled(100.0):.0f}",
                "mean error (°C)": f"{row['mean'].value:.3f}",
                "without foresight": f"{row['limit']:.3f}",
                "with foresight": f"{row['preview']:.3f}",
                "error ratio": f"{row['ratio'].value:.2f}",
                "error ratio where changes surprise": f"{found.ratio:.2f}",
            }
        )
    return pd.DataFrame(rows)


def score_table(
    runs: pd.DataFrame,
    estimates: pd.DataFrame,
    scores: Mapping[str, Estimate],
    misfits: Collection[str] = (),
) -> pd.DataFrame:
    """Return the scores and the mean valve travel, the best first.

    Controllers in `misfits` have no score.
    """
    cells = estimates["scores"].map(lambda scores: written(scores.mean(), ".2f"))
    cells += estimates["mark"]
    table = _by_agent(estimates, cells, [*scores])
    travels = runs.groupby(["agent", "scenario"])["total_variation"].mean()
    overall = [f"{score:.3f}" for score in scores.values()]
    for place, agent in enumerate(scores):
        if agent in misfits:
            overall[place] = "not ranked"
    table.insert(1, "score", overall)
    table.insert(2, "travel (t/h)", [f"{travels[agent].mean():,.0f}" for agent in scores])
    return table


def ratio_table(
    estimates: pd.DataFrame, scales: Mapping[str, Scale], agents: Sequence[str]
) -> pd.DataFrame:
    """Return the least possible errors, and the mean errors divided by them."""
    bounds = pd.DataFrame({"controller": ["least possible (°C)", "with foresight (°C)"]})
    for name, scale in scales.items():
        mark = "*" * (scale.least.kind == "reference")
        bounds[name] = [f"{scale.least.value:.3f}{mark}", f"{scale.preview:.3f}"]
    cells = estimates["ratio"].map("{:.2f}".format) + estimates["mark"]
    table = _by_agent(estimates, cells, agents)
    return pd.concat([bounds, table], ignore_index=True)


def difference_table(estimates: pd.DataFrame) -> pd.DataFrame:
    """Return the paired differences, and the shares of runs that are better."""
    if "difference" not in estimates:
        return pd.DataFrame()
    others = estimates.dropna(subset=["difference"])
    pairs = zip(others["difference"], others["improvement"], strict=True)
    cells = [f"{mean:+.3f}; {100 * better.value:.0f} %" for mean, better in pairs]
    return _by_agent(others, cells, [*others["agent"].unique()])


def _by_agent(rows: pd.DataFrame, cells: Any, agents: Sequence[str]) -> pd.DataFrame:
    """Return a table of cells, a row for each of the agents and a column for each case."""
    table = rows.assign(cell=cells).pivot(index="agent", columns="scenario", values="cell")
    table = table.loc[[*agents], rows["scenario"].unique()].fillna("").rename(index=label)
    return table.rename_axis(index="controller", columns=None).reset_index()


def costs_table(
    cases: Sequence[Case], controllers: Mapping[str, ControllerSpec], scenario: Scenario
) -> pd.DataFrame:
    """Return a row for each controller: its knowledge, its robustness and its costs.

    The robustness of linear controllers is that with the nominal plant of the scenario.
    """
    rows = []
    for name, controller in controllers.items():
        own_cases = [case for case in cases if case.agent == name]
        # The roster says it in a record, a user's own controller itself.
        about = next((dict(policy) for case in own_cases for policy in case.policies), {})
        sensitivity, delays = robustness(controller, scenario)
        row = {
            "controller": label(name),
            "prior knowledge": controller.knows or about.get("knows", ""),
            "Ms": sensitivity,
            "stable with delays of (samples)": delays,
            "searched or trained": controller.searched or about.get("searched", ""),
            "processor time (s)": f"{sum(case.seconds for case in own_cases):.1f}",
        }
        rows.append(row)
    return pd.DataFrame(rows)


def robustness(controller: ControllerSpec, scenario: Scenario) -> tuple[str, str]:
    """Return Ms and the range of delays of a linear controller's loop, as texts."""
    if not controller.linear:
        return "", ""
    loop = controller.loop(scenario.arguments)
    delays = loop.stable_delays()
    if delays is None:
        return "unstable", "none around the plant's"
    return f"{loop.sensitivity():.2f}", f"{delays[0]} to {delays[1]}"
