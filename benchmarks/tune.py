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
    progress_bar,
)
from benchmarks.lib.provenance import origin
from benchmarks.lib.results import KeptResults, conditions_of, results_folder
from benchmarks.lib.seeds import SEEDS
from benchmarks.lib.storage import write_csv, write_json
from benchmarks.loop.rollout import mean_error, settled
from benchmarks.loop.scenarios import Arguments, PlantOptions
from mptc_gym import PRESETS, Parameters

if TYPE_CHECKING:
    import pandas as pd

SEED = SEEDS["sampler"].first
STARTUP = 200  # trials at random before the sampler learns
FIRST_RUN = SEEDS["preparation"].first  # seed of the runs of a trial
SPACING = 100_000  # from the first seed of a case to the first seed of the next case
FINALISTS = 10  # of the best trials, which are judged again
FINAL_RUNS = 1000  # of each case, to judge a finalist
FINAL_FIRST_RUN = SEEDS["finals"].first
PENALTY = 5.0  # degC, for failing to settle: the cost of doing nothing about an error of 5 degC
LARGEST_ZONE = 0.95  # of a scaled dead zone, as a share of the larger limit of the flow
TUNED = [name for name, spec in ROSTER.items() if spec.spans]
NOTE = (
    "For each case, the median over runs of the mean absolute error, °C. The objective is the "
    f"mean of these medians, plus {PENALTY:g} °C times the share of runs that do not settle at "
    "the constant set point; on another plant, that penalty is scaled with the set points."
)
PAPER = Parameters()
PAPER_NOISE = PRESETS["noisy"]["noise_variance"]  # degC^2
QUIET: Arguments = {
    "noise_variance": 0.0,
    "measurement_noise_variance": 0.0,
    "disturbance_amplitude": 0.0,
    "disturbance_walk_variance": 0.0,
}


class TuningCase(NamedTuple):
    """A case of the search."""

    samples: int  # length of a run
    first: int  # sample at which the mean error begins
    arguments: Arguments  # of the environment


# Neighbours of the paper's cases. Three cases count the errors of an untrained controller from
# the first sample on, and two count only what follows learning.
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
    """Run the search, and write and print its results."""
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
    """Score the best trials on new runs, and return a row for each, the best first.

    The best gains of a search owe some of their result to luck; new runs show how much. A row
    is what `score` returns, with the objective "in the search". `trials` is what `search`
    returns for a plant with these arguments of the environment.
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
    """Return where to search for each gain of a controller on a plant, by name.

    A pair holds the values of the smallest and of the largest magnitude. A `UsageError` is
    raised if the plant's gain or time constant does not define them.
    """
    if spec.spans is None:
        raise ValueError(f"{spec.name} has no gains to search")
    with blame("--plant"):
        return spec.spans(Parameters(**plant))


def cases(plant: Arguments) -> dict[str, TuningCase]:
    """Return the cases of a search on a plant by name: those of the paper's plant, scaled.

    Set points scale with `setpoint_amplitude`, lengths with `setpoint_period`, and the dead
    zone and the noise with the plant's; a plant without noise has some in the case "noise".
    At the constant set point there are neither noise nor load, so that a loop can settle.
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
    """Try `count` sets of gains of a controller, and return a row for each trial.

    A row is what `score` returns. The rows are also written to `trials.csv` in the folder, as
    far as they have come. Which gains a trial tries follows from the trials before it. So an
    interrupted search takes the same course again, and finds the results of its first trials in
    the folder.
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
    """Run a controller with these gains in all cases, and return a row of numbers.

    The row has the gains by name; the median mean error of each case, degC, by its name; "not
    converged", the share of runs that do not settle at the constant set point; and the
    "objective", degC, as `NOTE` says. The seeds of the first case begin with `first_run`.
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
