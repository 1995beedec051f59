"""Run controllers on plants they were not made for: `python -m benchmarks.sweep --help`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray

from benchmarks.controllers.options import AgentNames, ControllerOptions, chosen
from benchmarks.controllers.roster import ROSTER, label
from benchmarks.controllers.spec import ControllerSpec
from benchmarks.lib.command import Folder, Parameter, Runs, Seed, blame, command, options
from benchmarks.lib.errors import NoBoundError, UsageError
from benchmarks.lib.provenance import origin
from benchmarks.lib.results import KeptResults, conditions_of, results_folder
from benchmarks.lib.seeds import SEEDS
from benchmarks.lib.storage import write_csv, write_json
from benchmarks.loop.rollout import Trajectory, held, measure
from benchmarks.loop.scenarios import Arguments, PlantOptions, around, random_design
from mptc_gym import Parameters

if TYPE_CHECKING:
    import pandas as pd

SAMPLES = 1200  # length of a run, samples
SETPOINT: Arguments = {"setpoint": "square", "setpoint_period": 600}
SEED = SEEDS["studies"].first  # seed of the first run on each plant, and of the bootstraps
PLANTS = 200  # default number of plants in a random design
# A run oscillates if the standard deviation of the error on steady stretches is larger by this
# number, degC, than the standard deviation with an idle valve.
OSCILLATION_THRESHOLD = 1.0
# Headings and number formats of the report's table, by the names of columns of `summarise`.
COLUMNS = {
    "multiple": ("error ratio (median)", "{:.3f}"),
    "multiple_p90": ("error ratio (90th percentile)", "{:.3f}"),
    "travel": ("valve travel (t/h)", "{:,.0f}"),
    "oscillates": ("runs that oscillate (%)", "{:.1f}"),
    "useless": ("runs no better than an idle valve (%)", "{:.1f}"),
}
RATIOS = (
    "The error ratio of a run is its mean error divided by the least possible error. The error "
    "ratio of a plant is the median over the runs on the plant, and the table gives the median "
    "and the 90th percentile over the plants."
)
FAILURES = (
    "The valve travel is the sum of all changes of the flow in a run, and the table gives the "
    "median over all runs. A steady stretch is the second half of the time between two changes "
    "of the set point. A run oscillates if the standard deviation of its error on steady "
    f"stretches is more than {OSCILLATION_THRESHOLD:g} °C larger than with an idle valve. A "
    "run is no better than an idle valve if its mean error is at least as large as with an "
    "idle valve."
)
PICTURE = "The error of each controller on each plant, relative to the least possible error"
# Groups of the plants in a random design: the name of a group, and a condition on the arguments
# of the plants for `DataFrame.query`. The delays 14 and 22 divide the plants that drift into
# three groups of about equal size.
GROUPS = {
    "no drift": "gain_drift.isna()",
    "all that drift": "gain_drift > 0",
    "drift, delay below 14 samples": "gain_drift > 0 and delay < 14",
    "drift, delay from 14 to 22 samples": "gain_drift > 0 and 14 <= delay <= 22",
    "drift, delay above 22 samples": "gain_drift > 0 and delay > 22",
}
# Questions of the report, and for each question the pairs of controllers to compare.
QUESTIONS = {
    "Does online learning help when the plant drifts?": (
        ("nn", "pi-simc"),
        ("nn", "nn-frozen"),
        ("nn-frozen", "pi-simc"),
    ),
    "What does adaptation buy?": (
        ("neural-self-tuning", "neural-smith"),
        ("neural-self-tuning", "self-tuning"),
        ("neural-smith", "smith"),
        ("self-tuning", "smith"),
    ),
}
DIFFERENCES = (
    "The table gives differences between the mean errors of two controllers, in °C, with 95 % "
    "intervals. A difference below 0 °C means that the controller named first has the smaller "
    "error."
)


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Run controllers on plants that they were not made for.

    The nominal plant is the paper's plant, or the plant that --plant, --preset or --set choose.
    The controllers are made for the nominal plant, and run on variations of the nominal plant.
    """

    design: Literal["grid", "random"] = "grid"
    """grid: plants with 20 delays and 10 gains; random: plants that differ in delay, dead zone,
    noise, gain and time constant, half of which drift."""
    plants: Runs | None = None
    """Number of plants in a random design (default: 200)."""
    design_seed: Seed | None = None
    """Seed of the plants in a random design (default: 0)."""
    told: Literal["nominal", "each"] = "nominal"
    """nominal: every controller is made for the nominal plant; each: every controller is made
    for the plant that it controls, as the plant is before it drifts."""
    runs: Runs = 20
    """Number of runs of each controller on each plant."""
    agents: AgentNames = tuple(name for name, spec in ROSTER.items() if spec.swept)
    controllers: ControllerOptions = field(default_factory=ControllerOptions)
    plant: PlantOptions = field(default_factory=PlantOptions)
    out: Annotated[Folder | None, Parameter(help="Default: results/sweep-DESIGN.")] = None


def work(options: Options) -> str:
    """Run the sweep, write the report and the data, and return the last message for the user.

    After an error or an interruption, the report and the data contain the finished runs.
    """
    controllers = chosen(options.agents, options.controllers.agent)
    nominal = options.plant.arguments()
    plants = design(options, nominal)
    tasks = tasks_of(options, controllers, nominal, plants)
    provenance = origin()
    target = options.out or Path(f"results/sweep-{options.design}")
    # A user's own code may change between two runs, so the results are not kept for later.
    conditions = None if options.controllers.agent else conditions_of("sweep", options)
    results: dict[str, Any] = {}
    with results_folder(target, conditions) as folder:
        kept = KeptResults(folder) if conditions else None
        try:
            # After an error, `results` has the results of the tasks that finished before.
            results.update(options.controllers.fan_out.stream(tasks, "sweep", kept))
        finally:
            missing = len(tasks) - len(results)
            if missing:
                provenance["missing"] = f"{missing} of {len(tasks)} tasks are missing"
            runs = table(plants, list(controllers), results)
            if not runs.empty:
                content = {**provenance, "options": asdict(options)}
                write_json(folder / "provenance.json", content)
                write_csv(folder / "runs.csv", runs)
                write_csv(folder / "summary.csv", summarise(runs))
                report(runs, folder, Parameters(**nominal), provenance)
    return f"The report, the data and a picture are in {target}/"


def design(options: Options, nominal: Arguments) -> list[Arguments]:
    """Return, for each plant of a sweep, the arguments that differ from the nominal plant.

    `nominal` has the environment's arguments for the nominal plant. A `UsageError` is raised if
    `options` contradict each other, or if a plant is invalid.
    """
    plants: list[Arguments] = []
    if options.design == "random":
        plants = random_design(options.plants or PLANTS, options.design_seed or 0, SAMPLES)
    elif options.plants or options.design_seed is not None:
        raise UsageError("--plants and --design-seed need --design random, got --design grid")
    else:
        for gain_factor in np.linspace(0.75, 1.65, 10).round(6).tolist():
            for delay in range(2, 42, 2):
                plants.append({"delay": delay, "gain_factor": gain_factor})
    with blame(f"--design {options.design}"):
        plants = around(nominal, plants)
        for plant in plants:
            Parameters(**{**nominal, **plant})
    return plants


def tasks_of(
    options: Options,
    controllers: Mapping[str, ControllerSpec],
    nominal: Arguments,
    plants: Sequence[Arguments],
) -> dict[str, Any]:
    """Return the tasks of a sweep by name: functions without arguments.

    The task "plant 0" returns the result of `run_idle_valve` on the first plant. The task
    "plant 0, nn" returns the result of `run_agent` with the controller `nn` on the first plant.

    Parameters
    ----------
    options
        The options of the command.
    controllers
        The controllers by name. A controller can have several members, such as networks that
        were trained with different seeds.
    nominal
        Arguments of the environment for the nominal plant.
    plants
        Arguments of the environment that differ from the nominal plant, for each plant.
    """
    members_of = {name: controller.members() for name, controller in controllers.items()}
    ranges = ranges_of(plants)
    tasks: dict[str, Any] = {}
    for i, plant in enumerate(plants):
        case = {**nominal, **plant, **SETPOINT}
        tasks[f"plant {i}"] = partial(run_idle_valve, case, options.runs)
        for name, members in members_of.items():
            # Successive plants get successive members of a controller, so that a map over the
            # plants shows how much the members differ.
            member = members[i % len(members)]
            prior = case
            if options.told == "nominal":
                prior = {**nominal, **SETPOINT}
                # A self-tuning controller knows the ranges of delay and dead zone.
                if "delay_range" in member.prior_knowledge:
                    prior |= ranges
            tasks[f"plant {i}, {name}"] = partial(run_agent, member, prior, case, options.runs)
    return tasks


def ranges_of(plants: Sequence[Arguments]) -> Arguments:
    """Return the ranges [lowest, highest] of `delay` and `dead_zone` over the plants, by name.

    The range of an argument that is the same for all plants is left out.
    """
    ranges: Arguments = {}
    for name in ("delay", "dead_zone"):
        values = [plant[name] for plant in plants if name in plant]
        if len(set(values)) > 1:
            ranges[name] = [min(values), max(values)]
    return ranges


def run_agent(
    controller: ControllerSpec, prior: Arguments, case: Arguments, runs: int
) -> dict[str, Any]:
    """Run a controller on a plant, and return measures of each run, arrays of shape (runs,).

    Parameters
    ----------
    controller
        The controller.
    prior
        Arguments of the environment for the plant that the controller is made for.
    case
        Arguments of the environment for the plant on which the controller runs.
    runs
        Number of runs.

    Returns
    -------
    dict
        The measures by name: `run`, the number of the run; the measures that
        `benchmarks.loop.rollout.measure` returns; and `swing`, the result of the function
        `swing`, degC.
    """
    agent = controller.in_service(prior, runs, SEED)
    trajectory = controller.run(case, SAMPLES, runs, SEED, agent)
    measures = measure(trajectory, Parameters(**case))
    return {"run": np.arange(runs), **measures, "swing": swing(trajectory)}


def run_idle_valve(case: Arguments, runs: int) -> dict[str, Any]:
    """Return measures of runs with an idle valve on a plant, and the least possible error.

    `case` has the environment's arguments for the plant, and `runs` is the number of runs. The
    result has the measures of `run_agent`, and "least_possible", the least possible mean error
    of a controller that does not foresee changes of the set point, degC. The least possible
    mean error is NaN if the plant does not settle between changes of the set point.
    """
    from benchmarks.bounds.least import least_possible

    measures = run_agent(ROSTER["idle"], prior=case, case=case, runs=runs)
    least = math.nan
    with suppress(NoBoundError):
        least = least_possible(samples=SAMPLES, kind="reference", **case).value
    return {**measures, "least_possible": least}


def swing(trajectory: Trajectory) -> NDArray[np.float64]:
    """Return the standard deviation of the error while the set point is held, degC.

    Of the samples between two changes of the set point, only the second half (a steady stretch)
    counts. The result has the shape (runs,).
    """
    errors = trajectory.setpoint - trajectory.output
    variances = []
    for start, stop in held(trajectory.setpoint[:, 0]):
        steady = errors[(start + stop) // 2 : stop]
        variances.append(steady.var(axis=0))
    return np.asarray(np.sqrt(np.mean(variances, axis=0)))


def table(
    plants: Sequence[Arguments], agents: Sequence[str], results: Mapping[str, Any]
) -> pd.DataFrame:
    """Return a table with a row for each finished run of a controller on a plant.

    The columns are:

    - `plant`: the number of the plant;
    - `agent`: the name of the controller;
    - `limit`: the least possible mean error on the plant, degC;
    - `ratio`: the error ratio, which is the mean error divided by `limit`;
    - `oscillates`: whether the run oscillates;
    - `useless`: whether the run is no better than an idle valve in the same noise;
    - the measures of `run_agent` and the arguments of the plant, by name.

    Parameters
    ----------
    plants
        Arguments of the environment that differ from the nominal plant, for each plant.
    agents
        The names of the controllers.
    results
        The results of the finished tasks, by the names of the tasks in `tasks_of`.
    """
    import pandas as pd

    tables = [pd.DataFrame()]
    for i, plant in enumerate(plants):
        idle = results.get(f"plant {i}")
        for agent in agents:
            measures = results.get(f"plant {i}, {agent}")
            if idle and measures:
                comparisons = {
                    "limit": idle["least_possible"],
                    "ratio": measures["mae"] / idle["least_possible"],
                    "oscillates": measures["swing"] > idle["swing"] + OSCILLATION_THRESHOLD,
                    "useless": measures["mae"] >= idle["mae"],
                }
                columns = {"plant": i, "agent": agent, **measures, **comparisons, **plant}
                tables.append(pd.DataFrame(columns))
    return pd.concat(tables, ignore_index=True)


def summarise(runs: pd.DataFrame) -> pd.DataFrame:
    """Return a table that summarises all runs of each controller, in a row for each controller.

    The columns are:

    - `agent`: the name of the controller;
    - `multiple` and `multiple_p90`: the median and the 90th percentile, over the plants, of the
      error ratio of a plant, which is the median over the runs on the plant;
    - `travel`: the median valve travel of the runs, t/h;
    - `oscillates`: the share of the runs that oscillate, %;
    - `useless`: the share of the runs that are no better than an idle valve, %.

    `runs` is the table that the function `table` returns.
    """
    by_agent = runs.groupby("agent", sort=False)
    ratios_of_plants = runs.groupby(["agent", "plant"], sort=False)["ratio"].median()
    ratios = ratios_of_plants.groupby("agent", sort=False)
    summary = 100.0 * by_agent[["oscillates", "useless"]].mean()
    summary["multiple"] = ratios.median()
    summary["multiple_p90"] = ratios.quantile(0.9)
    summary["travel"] = by_agent["total_variation"].median()
    return summary[[*COLUMNS]].reset_index()


def report(runs: pd.DataFrame, out: Path, nominal: Parameters, provenance: Arguments) -> None:
    """Draw the picture of error ratios, write the report to the folder `out`, and print it.

    If plants drift, the report has a table of error differences for each of `QUESTIONS` whose
    controllers have run. `runs` is the table that the function `table` returns. `provenance`
    has the command, the commit of the code and the versions of Python and of packages.
    """
    from benchmarks.lib.report import Section, write_report
    from benchmarks.plots.sweep import draw

    draw(runs, out / "map.png", nominal)
    overview = summarise(runs)
    overview.insert(0, "controller", overview.pop("agent").map(label))
    for name, (heading, form) in COLUMNS.items():
        overview[heading] = overview.pop(name).map(form.format)
    texts = [RATIOS, FAILURES]
    pictures = {"map.png": PICTURE}
    sections = [Section("Errors on other plants", texts, overview, pictures=pictures)]
    if "gain_drift" in runs:
        agents = set(runs["agent"])
        for question, pairs in QUESTIONS.items():
            pairs_that_ran = [pair for pair in pairs if agents.issuperset(pair)]
            answers = differences(runs, pairs_that_ran)
            if not answers.empty:
                sections.append(Section(question, [DIFFERENCES], answers))
    write_report(out, "Controllers on other plants", sections, provenance)


def differences(runs: pd.DataFrame, pairs: Sequence[tuple[str, str]]) -> pd.DataFrame:
    """Return a table of the differences between the mean errors of two controllers, as strings.

    A difference is the mean error of the first controller in a pair minus the mean error of the
    second controller, degC, with a 95 % interval. The table has a column for each pair in
    `pairs`, and a row for each group of plants in `GROUPS`. Plants on which any controller of
    the pairs has not finished are left out, and so are groups with fewer than two plants.
    `runs` is the table that the function `table` returns.
    """
    import pandas as pd

    from benchmarks.lib.statistics import bootstrap

    agents = {agent for pair in pairs for agent in pair}
    runs_of_agents = runs[runs["agent"].isin(agents)]
    errors = runs_of_agents.pivot(index="plant", columns=["agent", "run"], values="mae")
    errors = errors.dropna()
    plants = runs.drop_duplicates("plant").set_index("plant").loc[errors.index]
    rows = []
    for group, condition in GROUPS.items():
        errors_of_group = errors.loc[plants.query(condition).index]
        count = len(errors_of_group)
        if count < 2:
            continue
        row = {"plants": group, "number of plants": str(count)}
        for first, second in pairs:
            difference = errors_of_group[first] - errors_of_group[second]
            estimate = bootstrap(difference.to_numpy(), seed=SEED)
            row[f"{label(first)} - {label(second)}"] = f"{estimate:+.3f}"
        rows.append(row)
    return pd.DataFrame(rows)


main = command("sweep", Options, work)

if __name__ == "__main__":
    raise SystemExit(main(None))
