"""Search for a controller's gains with Optuna: `python -m benchmarks.tune --help`."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np

from benchmarks.controllers.known_plant import PAPER, KnownPlant
from benchmarks.controllers.roster import ROSTER, ControllerSpec
from benchmarks.controllers.spans import SPANS, Spans
from benchmarks.lib.command import CommandError, Count, Folder, Parameter, command, options
from benchmarks.lib.fan_out import with_progress_bar
from benchmarks.lib.outputs import new_folder, provenance_of, write_json
from benchmarks.lib.seeds import SEEDS
from benchmarks.loop.measures import mean_error, settled
from benchmarks.loop.scenarios import Arguments, PlantOptions
from mptc_gym import PRESETS, Parameters

if TYPE_CHECKING:
    from optuna.trial import FrozenTrial

SEED = SEEDS["sampler"].start  # seed of Optuna's sampler in the first trial
STARTUP = 200  # number of trials with random gains, before Optuna's sampler chooses gains
RUNS = 100  # number of runs of each case in a trial
FIRST_RUN = SEEDS["preparation"].start  # seed of the first run of every trial
SPACING_OF_CASES = 100_000  # difference between the first seeds of two successive cases
FINALISTS = 10  # number of best trials whose gains are scored again on new runs
FINAL_RUNS = 1000  # number of new runs of each case
FINAL_FIRST_RUN = SEEDS["finals"].start  # seed of the first new run
NOTES = (
    "The columns from 'constant' to 'learnt, slow' give the median over the runs of the mean "
    "absolute error, in °C, in five cases: a constant set point; a square wave and a dead zone "
    "that is 1.3 times as wide as that of the plant; a square wave and noise; and two square "
    "waves of different periods whose first two periods do not count, so that a controller has "
    "time to learn.",
    "'not converged' is the share of runs that do not settle at the constant set point. "
    "'objective', which the search minimises, is the mean of the five medians, plus 'not "
    "converged' times the amplitude of the plant's set points, in °C. 'in the search' is the "
    "objective of the same gains in the search. The last rows have gains with which other "
    "commands run the same kind of controller.",
)
# Controllers with the gains of a controller to tune, by the name of the latter.
WITH_THE_SAME_GAINS = {
    "nn": ["nn"],
    "pi": ["pi", "pi-searched", "pi-simc"],
}
EDGE = 1.05  # ratio of a gain to the end of its interval, below which it lies at the edge
# Standard deviation of the output in the noise that a calm plant gets, divided by the amplitude
# of the set point.
ADDED_NOISE = 0.1
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

    samples: int  # length of a run
    first: int  # the first sample that counts in the mean error
    arguments: Arguments  # arguments of the environment


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Tune a controller's gains with Optuna, by default on the paper's plant.

    All trials use the same set points and seeds. No comparison uses the set points and seeds of
    the trials. The best gains are written to the file `gains.json`. The command
    `benchmarks.compare --agent NAME=gains.json` runs the controller with the gains in the file.
    A search that was stopped goes on, to the same result, if --out names its folder.
    """

    controller: Annotated[str, Parameter(choices=SPANS)] = field(kw_only=False)
    """Name of the controller whose gains to search."""
    trials: Count = 800
    """Number of sets of gains to try, with those of a search that goes on. The first 200 are
    random."""
    plant: PlantOptions = field(default_factory=PlantOptions)
    out: Folder = None


def work(options: Options) -> None:
    """Search for gains, write the results, and print the best gains."""
    import optuna  # here, so that no folder is made if Optuna is missing
    import pandas as pd

    from benchmarks.lib.sections import Section, show, write_report

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    name = options.controller
    plant = options.plant.arguments()
    spans = SPANS[name](KnownPlant(plant))
    provenance = provenance_of(seeds={"sampler": SEED, "runs": FIRST_RUN})
    folder = new_folder(options.out, f"tune-{name}", provenance, goes_on=True)
    try:
        trials = search(name, plant, spans, options.trials, folder)
        rows = finals(name, plant, spans, trials)
    except KeyboardInterrupt as error:
        advice = f"interrupted; with --out {folder}, the same command goes on"
        raise CommandError(advice, status=130) from error
    samples = len(trials) * RUNS * sum(case.samples for case in cases(plant).values())
    budget = f"{len(trials)} trials: {samples / 1e6:.3g} M samples"
    content = {
        "controller": name,
        "gains": {gain: rows[0][gain] for gain in spans},
        "plant": plant,
        # A text for the column "prior knowledge" of the reports of `benchmarks.compare`.
        "knows": f"gains of a search on {options.plant.name or 'the plant of the paper'}",
        "searched": f"{len(spans)} gains by {budget}",
    }
    write_json(folder / "gains.json", content)
    title = f"The best gains of {len(trials)} trials, on {FINAL_RUNS:,} new runs"
    table = pd.DataFrame(rows).map(lambda x: x if isinstance(x, str) else f"{x:.4g}")
    best = Section(title, [*NOTES, *at_edges(rows[0], spans)], table)
    write_report(folder, f"Gains: {ROSTER[name].label}", [best], provenance)
    show(best)
    words = ["--agent", f"my-{name}={folder}/gains.json", *options.plant.words]
    print(f"To run the best gains: python -m benchmarks.compare {shlex.join(words)}")


def finals(
    name: str, plant: Arguments, spans: Spans, trials: Sequence[FrozenTrial]
) -> list[dict[str, Any]]:
    """Return a row for each of the best `FINALISTS` trials, scored on new runs, best first.

    New runs are necessary because the best result of many trials is partly luck. The gains of
    the best trials are rounded to three digits before the new runs. A row has the gains, the
    numbers that `score` returns for the new runs, and "in the search", the objective of the
    gains before rounding in the search, degC. Rows with the gains of other commands follow.

    Parameters
    ----------
    name
        Name of the controller.
    plant
        Arguments of the environment for the plant.
    spans
        Interval in which gains were searched, by the gain's name.
    trials
        Trials of the search, whose value is the objective.
    """
    rows: list[dict[str, Any]] = []
    for trial in sorted(trials, key=attrgetter("value"))[:FINALISTS]:
        gains = gains_of(trial.params, spans)
        rounded = {gain: float(f"{value:.3g}") for gain, value in gains.items()}
        controller = replace(ROSTER[name], arguments=rounded)
        scores = score(controller, plant, FINAL_RUNS, FINAL_FIRST_RUN)
        row = {"gains": "of the search", **rounded, **scores, "in the search": trial.value}
        rows.append(row)
    rows.sort(key=lambda row: row["objective"])
    for present in WITH_THE_SAME_GAINS[name]:
        spec = ROSTER[present]
        if spec.direction in (None, KnownPlant(plant).direction):
            started, _ = spec.start(plant, 1, 0)  # for its gains, which it has as attributes
            gains = {gain: getattr(started, gain) for gain in spans}
            scores = score(spec, plant, FINAL_RUNS, FINAL_FIRST_RUN)
            row = {"gains": f"of {spec.label}", **gains, **scores, "in the search": ""}
            rows.append(row)
    return rows


def at_edges(row: Mapping[str, Any], spans: Spans) -> list[str]:
    """Return a sentence for each gain of a row that lies at an edge of its interval."""
    return [
        f"The best {gain} lies at the edge of the interval of the search, from {least:.3g} to "
        f"{most:.3g}: a gain beyond it may be better."
        for gain, (least, most) in spans.items()
        if not EDGE * abs(least) < abs(row[gain]) < abs(most) / EDGE
    ]


def cases(plant: Arguments) -> dict[str, TuningCase]:
    """Return the cases of a search for gains on a plant, by name.

    On the paper's plant, the cases are similar to the paper's cases, but not equal, so that
    gains are not tuned to a published result. In the cases called "learnt", the errors count
    only after a controller has had time to learn. In the case "constant", the plant has neither
    noise nor load, so that every good control loop can settle.

    For other plants, the set points are scaled in proportion to `setpoint_amplitude`, the
    lengths of the runs in proportion to `setpoint_period`, and the dead zone and the noise
    variance in proportion to the values of the plant. In the case "noise", even a plant without
    noise gets some noise: as much that it moves the output by a tenth of the amplitude.
    """
    known = KnownPlant(plant)
    # Factors that are 1 for the paper's plant.
    amplitude = known.parameters.setpoint_amplitude / PAPER.parameters.setpoint_amplitude
    duration = known.parameters.setpoint_period / PAPER.parameters.setpoint_period
    dead_zone = known.dead_zone / PAPER.dead_zone
    noise = float(known.model.numbers.noise_variance) / PAPER_NOISE
    noise_variance = 0.4 * noise
    if noise == 0.0:
        noise_variance = 0.4  # as of the published search
        if known.parameters != PAPER.parameters:
            deviation = ADDED_NOISE * known.parameters.setpoint_amplitude
            noise_variance = deviation**2 / known.model.noise_power

    def square(
        samples: int, first: int, level: float, period: int, **changes: float
    ) -> TuningCase:
        """Return the case of a square wave, whose period is an even number of samples.

        `first` is the first sample whose error counts, and `level` the amplitude, degC. The
        numbers are those for the paper's plant, and are scaled to the plant of the search.
        """
        arguments = {
            **plant,
            "setpoint": "square",
            "setpoint_amplitude": min(level * amplitude, known.parameters.temperature_span),
            "setpoint_period": max(2, 2 * round(period * duration / 2)),
            **changes,
        }
        return TuningCase(round(samples * duration), round(first * duration), arguments)

    constant = {**plant, **QUIET, "setpoint": 4.8 * amplitude}
    return {
        "constant": TuningCase(round(600 * duration), 0, constant),
        "dead zone": square(1280, 0, 5.1, 640, dead_zone=6.5 * dead_zone),
        "noise": square(1040, 0, 4.9, 520, noise_variance=noise_variance),
        "learnt": square(2240, 1120, 5.2, 560),
        "learnt, slow": square(1920, 1280, 5.4, 640),
    }


def search(
    name: str, plant: Arguments, spans: Spans, count: int, folder: Path
) -> list[FrozenTrial]:
    """Try `count` sets of gains of a controller, and return the trials.

    Optuna stores the trials in `folder`, trial by trial. A search that starts again goes on
    after the stored trials, and tries the gains that it would have tried without an
    interruption. A `CommandError` is raised if the trials in `folder` are of another controller
    or plant.

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
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend

    storage = JournalStorage(JournalFileBackend(str(folder / "trials.log")))
    study_name = json.dumps([name, plant])
    names = optuna.study.get_all_study_names(storage)
    if names:
        if json.loads(names[0]) != json.loads(study_name):  # in any order of the arguments
            raise CommandError(f"--out: {folder} has another search, {names[0]}")
        study_name = names[0]
    study = optuna.create_study(storage=storage, study_name=study_name, load_if_exists=True)
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
        controller = replace(ROSTER[name], arguments=gains_of(trial.params, spans))
        scores = score(controller, plant, RUNS, FIRST_RUN)
        study.tell(trial, scores["objective"])
    return study.get_trials(states=is_complete)


def gains_of(magnitudes: Mapping[str, float], spans: Spans) -> dict[str, float]:
    """Return the gains of a trial, which have the signs of `spans`, from their magnitudes."""
    # Both ends of an interval have the same sign.
    return {gain: math.copysign(magnitudes[gain], ends[0]) for gain, ends in spans.items()}


def score(
    controller: ControllerSpec, plant: Arguments, runs: int, first_run: int
) -> dict[str, float]:
    """Run a controller in all cases, and return the results by name.

    The results contain:

    - the median over the runs of the mean error in each case, degC, by the name of the case;
    - "not converged": the share of runs that do not settle at the constant set point;
    - "objective": the mean of the medians over the cases, plus the product of "not converged"
      and the amplitude of the plant's set points, degC, which is the mean error of an idle
      valve. The search minimises the objective.

    Parameters
    ----------
    controller
        Record of the controller, with its gains.
    plant
        Arguments of the environment for the plant.
    runs
        Number of runs of each case.
    first_run
        Seed of the first run of the first case.
    """
    medians: dict[str, float] = {}
    unsettled = 0.0
    for i, (case_name, case) in enumerate(cases(plant).items()):
        seed = first_run + i * SPACING_OF_CASES
        trajectory = controller.run(case.arguments, case.samples, runs, seed)
        medians[case_name] = float(np.median(mean_error(trajectory[case.first :])))
        if case_name == "constant":
            unsettled = 1.0 - float(settled(trajectory).mean())
    penalty = unsettled * Parameters(**plant).setpoint_amplitude
    objective = float(np.mean(list(medians.values()))) + penalty
    return {**medians, "not converged": unsettled, "objective": objective}


main = command("tune", Options, work)

if __name__ == "__main__":
    raise SystemExit(main())
