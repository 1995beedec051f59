"""Search for a controller's gains with Optuna: `python -m benchmarks.tune --help`."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np

from benchmarks.controllers.known_plant import KnownPlant
from benchmarks.controllers.roster import ROSTER
from benchmarks.controllers.spans import Spans
from benchmarks.lib.command import CommandError, Count, Folder, Parameter, command, options
from benchmarks.lib.fan_out import with_progress_bar
from benchmarks.lib.outputs import new_folder, provenance_of, write_csv, write_json
from benchmarks.lib.seeds import SEEDS
from benchmarks.loop.measures import mean_error, settled
from benchmarks.loop.scenarios import Arguments, PlantOptions
from mptc_gym import PRESETS, Parameters

if TYPE_CHECKING:
    import pandas as pd

SEED = SEEDS["sampler"].first  # seed of Optuna's sampler in the first trial
STARTUP = 200  # number of trials with random gains, before Optuna's sampler chooses gains
RUNS = 100  # number of runs of each case in a trial
FIRST_RUN = SEEDS["preparation"].first  # seed of the first run of every trial
SPACING_OF_CASES = 100_000  # difference between the first seeds of two successive cases
FINALISTS = 10  # number of best trials whose gains are scored again on new runs
FINAL_RUNS = 1000  # number of new runs of each case
FINAL_FIRST_RUN = SEEDS["finals"].first  # seed of the first new run
# Penalty for a run that does not settle, degC: the mean error of an idle valve if the set point
# is 5 degC.
PENALTY = 5.0
# Controllers of the roster with the structure of the searched controller and other gains.
PRESENT = {"nn": ["nn"], "pi": ["pi", "pi-searched"], "dahlin": ["dahlin"]}
NOTE = (
    "For each case, the table gives the median over the runs of the mean absolute error, in "
    "°C. The column 'not converged' gives the share of runs that do not settle at the constant "
    f"set point. The objective is the mean of the medians, plus {PENALTY:g} °C times this "
    "share; if a plant has set points other than those of the paper's plant, the penalty is "
    "scaled with the set points. The column 'in the search' gives the objective of the same "
    "gains in the search. The last rows are the controllers that other commands run."
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
    """A case on which a search for gains evaluates a controller."""

    samples: int  # length of a run, samples
    first: int  # number of the first sample that counts in the mean error
    arguments: Arguments  # arguments of the environment


# Cases on the paper's plant that are similar to the paper's cases, but not equal, so that gains
# are not tuned to a published result. In the cases called "learnt", the errors count only after
# a controller has had time to learn; in the other cases, the errors count from the start.
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

    All trials use the same set points and seeds. No comparison uses the set points and seeds of
    the trials. The best gains are written to the file `gains.json`. The command
    `benchmarks.compare --agent NAME=gains.json` runs the controller with the gains in the file.
    A search that was stopped goes on, to the same result, if --out names its folder.
    """

    controller: Annotated[str, Parameter(choices=PRESENT)] = field(kw_only=False)
    """Name of the controller whose gains to search."""
    trials: Count = 800
    """Number of sets of gains to try, with those of a search that goes on."""
    plant: PlantOptions = field(default_factory=PlantOptions)
    out: Folder = None


def work(options: Options) -> None:
    """Search for gains, write the results, and print the best gains."""
    import optuna  # here, so that no folder is made if Optuna is missing

    from benchmarks.lib.report import Section, show, write_report

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    name = options.controller
    plant = options.plant.arguments()
    try:
        spans = ROSTER[name].spans(KnownPlant(Parameters(**plant)))  # type: ignore[misc]
    except ValueError as error:
        raise CommandError(f"--plant: {error}") from error
    provenance = provenance_of(seeds={"sampler": SEED, "runs": FIRST_RUN})
    folder = new_folder(options.out, f"tune-{name}", provenance, goes_on=True)
    trials = search(name, plant, spans, options.trials, folder)
    write_csv(folder / "trials.csv", trials)
    finalists = finals(name, plant, list(spans), trials)
    samples = len(trials) * RUNS * sum(case.samples for case in cases(plant).values())
    budget = f"{len(trials)} trials: {samples / 1e6:.3g} M samples"
    content = {
        "controller": name,
        "gains": finalists.loc[0, list(spans)].to_dict(),
        "plant": plant,
        # A text for the column "prior knowledge" of the reports of `benchmarks.compare`.
        "knows": "gains of a search on this plant",
        "searched": f"{len(spans)} gains by {budget}",
    }
    write_json(folder / "gains.json", content)
    title = f"The best gains of {len(trials)} trials, on {FINAL_RUNS:,} new runs"
    texts = finalists.map(lambda cell: cell if isinstance(cell, str) else f"{cell:.4g}")
    best = Section(title, [NOTE], texts.replace("nan", ""))
    write_report(folder, f"Gains: {ROSTER[name].label}", [best], provenance)
    show(best)
    words = ["--agent", f"my-{name}={folder}/gains.json", *options.plant.words]
    print(f"To run the best gains: python -m benchmarks.compare {shlex.join(words)}")


def finals(name: str, plant: Arguments, gains: list[str], trials: pd.DataFrame) -> pd.DataFrame:
    """Return a table of the scores of the best `FINALISTS` trials on new runs, best first.

    New runs are necessary because the best result of many trials is partly luck. The gains of
    the best trials are rounded to three digits before the new runs. A row has the numbers that
    `score` returns for the new runs, and "in the search", the objective of the gains before
    rounding in the search, degC. Rows of the controllers in `PRESENT` follow.

    Parameters
    ----------
    name
        Name of the controller.
    plant
        Arguments of the environment for the plant.
    gains
        Names of the gains.
    trials
        The table that `search` returns.
    """
    import pandas as pd

    best = trials.nsmallest(FINALISTS, "objective")
    rounded: Any = best[gains].map(lambda gain: float(f"{gain:.3g}")).to_dict("records")
    rows = [score(name, plant, FINAL_RUNS, FINAL_FIRST_RUN, finalist) for finalist in rounded]
    table = pd.DataFrame(rows)
    table["in the search"] = best["objective"].to_numpy()
    table = table.sort_values("objective")
    table.insert(0, "gains", "of the search")
    present = []
    for other in PRESENT[name]:
        controller, _ = ROSTER[other].start(plant, 1, 0)
        values = {gain: getattr(controller, gain) for gain in gains}
        row = score(name, plant, FINAL_RUNS, FINAL_FIRST_RUN, values)
        present.append({"gains": f"of {ROSTER[other].label}", **row})
    return pd.concat([table, pd.DataFrame(present)], ignore_index=True)


def cases(plant: Arguments) -> dict[str, TuningCase]:
    """Return the cases of a search for gains, by name: `CASES`, scaled to the plant.

    The set points are scaled in proportion to `setpoint_amplitude`, the lengths of the runs in
    proportion to `setpoint_period`, and the dead zone and the noise variance in proportion to
    the values of the plant. In the case "noise", even a plant without noise gets some noise. In
    the case "constant", the plant has neither noise nor load, so that every good control loop
    can settle.
    """
    known, paper = KnownPlant(Parameters(**plant)), KnownPlant(PAPER)
    duration = known.parameters.setpoint_period / PAPER.setpoint_period
    noise = float(known.model.numbers.noise_variance) / PAPER_NOISE
    if noise == 0.0:  # The noise variance is scaled with the square of temperature changes.
        noise = (known.temperature_range / paper.temperature_range) ** 2
    amplitude = amplitude_of(plant)
    factors = {
        "setpoint": amplitude,
        "setpoint_amplitude": amplitude,
        "setpoint_period": duration,
        "dead_zone": known.dead_zone / paper.dead_zone,
        "noise_variance": noise,
    }
    scaled_cases: dict[str, TuningCase] = {}
    for name, case in CASES.items():
        scaled = {key: factors[key] * value for key, value in case.arguments.items()}
        if "setpoint_period" in scaled:  # The period must be an even number of samples.
            scaled["setpoint_period"] = max(2, 2 * round(scaled["setpoint_period"] / 2))
        if name == "constant":
            scaled |= QUIET
        arguments = {**plant, "setpoint": "square", **scaled}
        lengths = round(duration * case.samples), round(duration * case.first)
        scaled_cases[name] = TuningCase(*lengths, arguments)
    return scaled_cases


def amplitude_of(plant: Arguments) -> float:
    """Return the amplitude of a plant's set points as a multiple of that of the paper's."""
    return Parameters(**plant).setpoint_amplitude / PAPER.setpoint_amplitude


def search(name: str, plant: Arguments, spans: Spans, count: int, folder: Path) -> pd.DataFrame:
    """Try `count` sets of gains of a controller, and return a table of the results of `score`.

    The trials are stored in `folder`, trial by trial. A search that starts again goes on after
    the stored trials of the same controller and plant, and tries the gains that it would have
    tried without an interruption.

    Parameters
    ----------
    name
        Name of the controller.
    plant
        Arguments of the environment for the plant.
    spans
        Interval in which to search for each gain, by the gain's name.
    count
        Number of trials, with the stored trials.
    folder
        Folder of the results.
    """
    import optuna
    import pandas as pd
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend

    study = optuna.create_study(
        storage=JournalStorage(JournalFileBackend(str(folder / "trials.log"))),
        study_name=json.dumps([name, plant]),
        load_if_exists=True,
    )
    magnitudes: Any = {
        gain: optuna.distributions.FloatDistribution(abs(least), abs(most), log=True)
        for gain, (least, most) in spans.items()
    }
    is_complete = [optuna.trial.TrialState.COMPLETE]
    first = len(study.get_trials(states=is_complete))
    for i in with_progress_bar(range(first, count), "trials", count - first):
        # The gains of a trial depend on the results of earlier trials only, and not on where
        # the search was interrupted: each trial has a new sampler, which ignores trials that
        # have no result.
        study.sampler = optuna.samplers.TPESampler(
            seed=SEED + i, n_startup_trials=STARTUP, multivariate=True, constant_liar=False
        )
        trial = study.ask(magnitudes)
        gains = {}
        for gain, magnitude in trial.params.items():
            gains[gain] = math.copysign(magnitude, spans[gain][0])
        row = score(name, plant, RUNS, FIRST_RUN, gains)
        trial.set_user_attr("row", row)
        study.tell(trial, row["objective"])
    return pd.DataFrame(
        [trial.user_attrs["row"] for trial in study.get_trials(states=is_complete)]
    )


def score(
    name: str, plant: Arguments, runs: int, first_run: int, gains: Mapping[str, float]
) -> dict[str, float]:
    """Run a controller with the gains `gains` in all cases, and return the results by name.

    The results contain:

    - the gains;
    - the median over the runs of the mean error in each case, degC, by the name of the case;
    - "not converged": the share of runs that do not settle at the constant set point;
    - "objective": the mean of the medians over the cases, plus a penalty in proportion to "not
      converged", degC. The search minimises the objective.

    Parameters
    ----------
    name
        Name of the controller.
    plant
        Arguments of the environment for the plant.
    runs
        Number of runs of each case.
    first_run
        Seed of the first run of the first case.
    gains
        The gains by name.
    """
    controller = replace(ROSTER[name], arguments=gains)
    medians: dict[str, float] = {}
    unsettled = 0.0
    for i, (case_name, case) in enumerate(cases(plant).items()):
        seed = first_run + i * SPACING_OF_CASES
        trajectory = controller.run(case.arguments, case.samples, runs, seed)
        medians[case_name] = float(np.median(mean_error(trajectory[case.first :])))
        if case_name == "constant":
            unsettled = 1.0 - float(settled(trajectory).mean())
    penalty = PENALTY * amplitude_of(plant)
    objective = float(np.mean(list(medians.values()))) + penalty * unsettled
    return {**gains, **medians, "not converged": unsettled, "objective": objective}


main = command("tune", Options, work)

if __name__ == "__main__":
    raise SystemExit(main())
