"""Search for a controller's gains with Optuna: `python -m benchmarks.tune --help`."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np

from benchmarks.controllers.plant_scale import scales
from benchmarks.controllers.roster import ROSTER
from benchmarks.controllers.spec import ControllerSpec
from benchmarks.lib.command import (
    Folder,
    Parameter,
    Runs,
    blame,
    command,
    options,
)
from benchmarks.lib.parallel import progress_bar
from benchmarks.lib.provenance import origin
from benchmarks.lib.results import KeptResults, conditions_of, results_folder
from benchmarks.lib.seeds import SEEDS
from benchmarks.lib.storage import write_csv, write_json
from benchmarks.loop.rollout import mean_error, settled
from benchmarks.loop.scenarios import Arguments, PlantOptions
from mptc_gym import PRESETS, Parameters

if TYPE_CHECKING:
    import pandas as pd

SEED = SEEDS["sampler"].first  # seed of Optuna's sampler in the first trial
STARTUP = 200  # number of trials with random gains, before the sampler learns from trials
FIRST_RUN = SEEDS["preparation"].first  # seed of the first run of every trial
SPACING = 100_000  # from the first seed of a case to the first seed of the next case
FINALISTS = 10  # number of best trials that are judged again on new runs
FINAL_RUNS = 1000  # runs of each case, to judge a finalist
FINAL_FIRST_RUN = SEEDS["finals"].first  # seed of the first run of a finalist
# Penalty for a run that does not settle, degC: the mean error of an idle valve if the set point
# is 5 degC.
PENALTY = 5.0
LARGEST_ZONE = 0.95  # largest dead zone of a case, as a share of the larger limit of the flow
TUNED = [name for name, spec in ROSTER.items() if spec.spans]
NOTE = (
    "For each case, the median over runs of the mean absolute error, °C. The objective is the "
    f"mean of these medians, plus {PENALTY:g} °C times the share of runs that do not settle at "
    "the constant set point; on another plant, that penalty is scaled with the set points."
)
PAPER = Parameters()  # the paper's plant
PAPER_NOISE = PRESETS["noisy"]["noise_variance"]  # noise variance R of the paper, degC^2
# Arguments of the environment for a plant without noise and load disturbance.
QUIET: Arguments = {
    "noise_variance": 0.0,
    "measurement_noise_variance": 0.0,
    "disturbance_amplitude": 0.0,
    "disturbance_walk_variance": 0.0,
}


class TuningCase(NamedTuple):
    """A case on which a search evaluates controllers."""

    samples: int  # length of a run
    first: int  # first sample that counts in the mean error
    arguments: Arguments  # arguments of the environment


# Cases on the paper's plant that are similar to the paper's cases, but not equal, so that gains
# are not tuned to a published result. In three cases, the mean error of an untrained controller
# counts from the first sample on; in two cases, it counts only after the controller has learnt.
CASES = {
    "constant": TuningCase(600, 0, {"setpoint": 4.8}),
    "dead zone": TuningCase(
        1280, 0, {"setpoint_amplitude": 5.1, "setpoint_period": 640, "dead_zone": 6.5}
    ),
    "noise": TuningCase(
        1040, 0, {"setpoint_amplitude": 4.9, "setpoint_period": 520, "noise_variance": 0.4}
    ),
    "learnt": TuningCase(2240, 1120, {"setpoint_amplitude": 5.2, "setpoint_period": 560}),
    "learnt, slow": TuningCase(1920, 1280, {"setpoint_amplitude": 5.4, "setpoint_period": 640}),
}


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Tune a controller's gains with Optuna, by default on the paper's plant.

    All trials use the same set points and seeds, which no comparison uses. `gains.json` holds
    the best gains: `benchmarks.compare --agent NAME=gains.json` runs the controller with them.
    If a search was stopped, the same command with the same code continues it, to the same
    result.
    """

    controller: Annotated[str, Parameter(choices=TUNED)] = field(kw_only=False)
    """The controller whose gains to search."""
    trials: Runs = 800
    """How many sets of gains to try."""
    runs: Runs = 100
    """Runs of each case in a trial."""
    plant: PlantOptions = field(default_factory=PlantOptions)
    out: Folder = Path("results/tune")


def work(options: Options) -> str:
    """Run the search, write and print its results, and return the closing message for users."""
    from benchmarks.lib.report import Section, write_report

    provenance = origin()
    name = options.controller
    plant = options.plant.arguments()
    gains = [*spans_of(ROSTER[name], plant)]
    target = options.out / name
    with results_folder(target, conditions_of("tune", options)) as folder:
        trials = search(name, plant, options.trials, options.runs, folder)
        table = finals(name, plant, trials)
        samples = options.runs * sum(case.samples for case in cases(plant).values())
        budget = f"{len(trials)} trials: {len(trials) * samples / 1e6:.3g} M samples"
        content = {
            "controller": name,
            "gains": table.loc[0, gains].to_dict(),
            "plant": plant,
            "knows": "gains of a search on this plant",
            "searched": f"{len(gains)} gains by {budget}",
        }
        write_json(folder / "gains.json", content)
        title = f"The best gains of {len(trials)} trials, on {FINAL_RUNS} new runs"
        sections = [Section(title, [NOTE], table.map("{:.4g}".format))]
        write_report(folder, f"Gains: {ROSTER[name].label}", sections, provenance)
    words = [*options.plant.words(), "--agent", f"my-{name}={target}/gains.json"]
    return (
        f"All trials are in {target}/trials.csv, the best in {target}/report.md. To compare "
        f"them: python -m benchmarks.compare {shlex.join(words)}"
    )


def finals(name: str, plant: Arguments, trials: pd.DataFrame) -> pd.DataFrame:
    """Score the best trials of a search on new runs, and return a row for each, best first.

    The best gains of a search owe some of their result to luck, and new runs show how much.

    Parameters
    ----------
    name
        Name of the controller.
    plant
        Arguments of the environment for the plant of the search.
    trials
        The trials of the search, as `search` returns them.

    Returns
    -------
    DataFrame
        A row for each finalist: the numbers that `score` returns, and the objective of the
        trial "in the search", degC.
    """
    import pandas as pd

    best = trials.nsmallest(FINALISTS, "objective")
    gains = [*spans_of(ROSTER[name], plant)]
    rounded: Any = best[gains].map(lambda gain: float(f"{gain:.3g}")).to_dict("records")
    rows = [score(name, plant, FINAL_RUNS, FINAL_FIRST_RUN, finalist) for finalist in rounded]
    table = pd.DataFrame(rows)
    table["in the search"] = best["objective"].to_numpy()
    return table.sort_values("objective", ignore_index=True)


def spans_of(spec: ControllerSpec, plant: Arguments) -> Mapping[str, tuple[float, float]]:
    """Return the interval of the search for each gain of a controller, by the gain's name.

    An interval is a pair: the value with the smallest magnitude, and the value with the largest
    magnitude, both of the same sign.

    Parameters
    ----------
    spec
        The controller.
    plant
        Arguments of the environment for the plant.

    Raises
    ------
    ValueError
        If the controller has no gains to search.
    UsageError
        If the plant has no gain or time constant that defines the intervals.
    """
    if spec.spans is None:
        raise ValueError(f"{spec.name} has no gains to search")
    with blame("--plant"):
        return spec.spans(Parameters(**plant))


def cases(plant: Arguments) -> dict[str, TuningCase]:
    """Return the cases of a search on a plant, by name: scaled versions of `CASES`.

    `plant` holds arguments of the environment. Set points are scaled in proportion to
    `setpoint_amplitude`, the lengths of runs in proportion to `setpoint_period`, and dead zone
    and noise in proportion to the plant's own values. A plant without noise gets some noise in
    the case "noise". In the case "constant" there are neither noise nor load, so that every
    good loop can settle.
    """
    parameters = Parameters(**plant)
    amplitude = parameters.setpoint_amplitude / PAPER.setpoint_amplitude
    duration = parameters.setpoint_period / PAPER.setpoint_period
    zone = sum(parameters.range_of("dead_zone")) / 2.0 / PAPER.range_of("dead_zone")[0]
    limit = max(abs(parameters.range_of("u_min")[1]), abs(parameters.range_of("u_max")[0]))
    noise = sum(parameters.range_of("noise_variance")) / 2.0 / PAPER_NOISE
    if not noise:  # In proportion to the temperatures that the flow reaches, squared.
        reach = "reach of half the flow's range, °C"
        noise = (scales(parameters)[reach] / scales(PAPER)[reach]) ** 2
    scaled: dict[str, TuningCase] = {}
    for name, case in CASES.items():
        arguments = {**plant, "setpoint": "square", **case.arguments}
        if name == "constant":
            arguments |= {**QUIET, "setpoint": amplitude * case.arguments["setpoint"]}
        else:
            period = case.arguments["setpoint_period"]
            arguments["setpoint_period"] = max(2, 2 * round(duration * period / 2))  # even
            arguments["setpoint_amplitude"] *= amplitude
        if name == "dead zone":
            arguments["dead_zone"] = min(zone * arguments["dead_zone"], LARGEST_ZONE * limit)
        if name == "noise":
            arguments["noise_variance"] *= noise
        scaled[name] = TuningCase(
            samples=round(duration * case.samples),
            first=round(duration * case.first),
            arguments=arguments,
        )
    return scaled


def search(name: str, plant: Arguments, count: int, runs: int, folder: Path) -> pd.DataFrame:
    """Try sets of gains of a controller, and return a table with a row for each trial.

    A row has the numbers that `score` returns. After an interruption, the rows of the finished
    trials are in `trials.csv`. The gains of a trial follow from the results of the trials
    before. So an interrupted search that starts again tries the same gains, and loads the
    results of finished trials from the folder.

    Parameters
    ----------
    name
        Name of the controller.
    plant
        Arguments of the environment for the plant.
    count
        Number of trials.
    runs
        Runs of each case in a trial.
    folder
        Folder of `trials.csv` and of the results of single trials.
    """
    import optuna
    import pandas as pd

    optuna.logging.set_verbosity(optuna.logging.CRITICAL)
    study = optuna.create_study()
    finished = KeptResults(folder)
    spans = spans_of(ROSTER[name], plant)
    magnitudes: Any = {
        gain: optuna.distributions.FloatDistribution(abs(least), abs(most), log=True)
        for gain, (least, most) in spans.items()
    }
    rows: list[dict[str, float]] = []
    try:
        with progress_bar("trials", count) as advance:
            for i in range(count):
                study.sampler = optuna.samplers.TPESampler(
                    seed=SEED + i, n_startup_trials=STARTUP, multivariate=True
                )
                trial = study.ask(magnitudes)
                row = finished.load(f"trial {i}")
                if row is None:
                    gains = {
                        gain: math.copysign(size, spans[gain][0])
                        for gain, size in trial.params.items()
                    }
                    row = score(name, plant, runs, FIRST_RUN, gains)
                    finished.save(f"trial {i}", row)
                rows.append(row)
                study.tell(trial, row["objective"])
                advance()
    finally:
        if rows:
            write_csv(folder / "trials.csv", pd.DataFrame(rows))
    return pd.DataFrame(rows)


def score(
    name: str, plant: Arguments, runs: int, first_run: int, gains: Mapping[str, float]
) -> dict[str, float]:
    """Run a controller with some gains in all cases, and return a dict of numbers.

    Parameters
    ----------
    name
        Name of the controller.
    plant
        Arguments of the environment for the plant.
    runs
        Runs of each case.
    first_run
        Seed of the first run of the first case.
    gains
        The gains by name.

    Returns
    -------
    dict
        The gains by name; the median over runs of the mean error in each case, degC, by the
        name of the case; "not converged", the share of runs that do not settle at the constant
        set point; and "objective", degC, which the search minimises: the mean of these medians
        plus a penalty for runs that do not settle.
    """
    controller = ROSTER[name].with_gains(gains)
    medians: dict[str, float] = {}
    failed = 0.0
    for i, (case_name, case) in enumerate(cases(plant).items()):
        seed = first_run + i * SPACING
        trajectory = controller.run(case.arguments, case.samples, runs, seed)
        medians[case_name] = float(np.median(mean_error(trajectory[case.first :])))
        if case_name == "constant":
            failed = 1.0 - float(settled(trajectory).mean())
    penalty = PENALTY * Parameters(**plant).setpoint_amplitude / PAPER.setpoint_amplitude
    objective = float(np.mean(list(medians.values()))) + penalty * failed
    return {**gains, **medians, "not converged": failed, "objective": objective}


main = command("tune", Options, work)

if __name__ == "__main__":
    raise SystemExit(main(None))
