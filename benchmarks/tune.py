"""Search for a controller's gains with Optuna: `python -m benchmarks.tune --help`."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from benchmarks.controllers.roster import ROSTER
from benchmarks.lib.command import Folder, Parameter, Runs, command, options, progress_bar
from benchmarks.lib.provenance import origin
from benchmarks.lib.results import KeptResults, conditions_of, results_folder
from benchmarks.lib.seeds import SEEDS
from benchmarks.lib.storage import write_csv
from benchmarks.loop.rollout import mean_error, settled

if TYPE_CHECKING:
    import pandas as pd

SEED = SEEDS["sampler"].first
STARTUP = 200  # trials at random before the sampler learns
FIRST_RUN = SEEDS["preparation"].first  # of the trials
FINALISTS = 10  # of the best trials, which are judged again
FINAL_RUNS = 1000  # for that
FINAL_FIRST_RUN = SEEDS["finals"].first
PENALTY = 5.0  # degC, for failing to settle: the cost of doing nothing about an error of 5 degC
TUNED = {name: each.gains for name, each in ROSTER.items() if each.gains}
NOTE = (
    "For each case, the median over runs of the mean absolute error, °C. The objective is "
    f"their mean, plus {PENALTY:g} °C times the share of runs that do not settle at the "
    "constant set point."
)
# Neighbours of the paper's cases: samples, the first of them that counts, and arguments. Three
# count from an untrained controller on, and two count only what follows learning.
CASES: dict[str, tuple[int, int, dict[str, float]]] = {
    "constant": (600, 0, {"setpoint": 4.8}),
    "dead zone": (
        1280, 0, {"setpoint_amplitude": 5.1, "setpoint_period": 640, "dead_zone": 6.5}
    ),
    "noise": (
        1040, 0, {"setpoint_amplitude": 4.9, "setpoint_period": 520, "noise_variance": 0.4}
    ),
    "learnt": (2240, 1120, {"setpoint_amplitude": 5.2, "setpoint_period": 560}),
    "learnt, slow": (1920, 1280, {"setpoint_amplitude": 5.4, "setpoint_period": 640}),
}  # fmt: skip


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Tune a controller's gains with Optuna.

    All trials use the same set points and seeds, which no comparison uses. If a search was
    stopped, the same command with the same code goes on from there, to the same result.
    """

    controller: Annotated[str, Parameter(choices=TUNED)] = field(kw_only=False)
    """Whose gains to search."""
    trials: Runs = 800
    """How many sets of gains to try."""
    runs: Runs = 100
    """Runs of each case in a trial."""
    out: Folder = Path("results/tune")


def work(options: Options) -> str:
    """Run the search, and write and print its results."""
    import pandas as pd

    from benchmarks.lib.report import Section, write_report

    name, made = options.controller, origin()
    target = options.out / name
    with results_folder(target, conditions_of("tune", options)) as folder:
        trials = pd.DataFrame(search(name, options.trials, options.runs, folder))
        title = f"The best gains of {len(trials)} trials, on {FINAL_RUNS} new runs"
        sections = [Section(title, [NOTE], finals(name, trials))]
        write_report(folder, f"Gains: {ROSTER[name].label}", sections, made)
    return f"All trials are in {target}/trials.csv, the best in {target}/report.md"


def finals(name: str, trials: "pd.DataFrame") -> "pd.DataFrame":
    """Score the best trials on new runs, and return them as text, a row each, the best first.

    The best gains of a search owe some of their result to luck; new runs show how much.
    """
    import pandas as pd

    best = trials.nsmallest(FINALISTS, "objective")
    gains = best[[*TUNED[name]]].map(lambda gain: float(f"{gain:.3g}")).to_dict("records")
    table = pd.DataFrame([score(name, FINAL_RUNS, FINAL_FIRST_RUN, each) for each in gains])
    table["in the search"] = best["objective"].to_numpy()
    return table.sort_values("objective", ignore_index=True).map("{:.4g}".format)


def search(name: str, count: int, runs: int, folder: Path) -> list[dict[str, float]]:
    """Try gains of a controller, and return and write one row for each trial.

    What a trial tries follows from those before it. So an interrupted search takes the same
    course again, and finds the results of its first trials in the folder.
    """
    import optuna
    import pandas as pd

    optuna.logging.set_verbosity(optuna.logging.CRITICAL)
    study, kept = optuna.create_study(), KeptResults(folder)
    scale = partial(optuna.distributions.FloatDistribution, log=True)
    spans: Any = {each: scale(*span) for each, span in TUNED[name].items()}
    rows: list[dict[str, float]] = []
    try:
        with progress_bar("trials", count) as advance:
            for i in range(count):
                study.sampler = optuna.samplers.TPESampler(
                    seed=SEED + i, n_startup_trials=STARTUP, multivariate=True
                )
                trial = study.ask(spans)
                row = kept.load(f"trial {i}")
                if row is None:
                    row = score(name, runs, FIRST_RUN, trial.params)
                    kept.save(f"trial {i}", row)
                rows.append(row)
                study.tell(trial, row["objective"])
                advance()
    finally:
        if rows:
            write_csv(folder / "trials.csv", pd.DataFrame(rows))
    return rows


def score(name: str, runs: int, first_run: int, gains: Mapping[Any, float]) -> dict[str, float]:
    """Return the gains, what `NOTE` says of a controller with them, and who does not settle.

    Each case has seeds of its own, beginning with `first_run`.
    """
    controller = replace(ROSTER[name], make=partial(ROSTER[name].make, **gains))
    medians = {}
    for i, (case, (samples, first, arguments)) in enumerate(CASES.items()):
        trajectory = controller.run(arguments, samples, runs, first_run + i * 100_000)
        medians[case] = float(np.median(mean_error(trajectory[first:])))
        if case == "constant":
            failed = 1.0 - float(settled(trajectory).mean())
    objective = float(np.mean(list(medians.values()))) + PENALTY * failed
    return {**gains, **medians, "not converged": failed, "objective": objective}


main = command("tune", Options, work)

if __name__ == "__main__":
    raise SystemExit(main(None))
