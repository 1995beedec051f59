"""Print the reference errors: `python -m benchmarks.bounds --help`."""

from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from benchmarks.bounds.linear_program import NoReferenceError
from benchmarks.bounds.reference import reference_error
from benchmarks.controllers.roster import ROSTER
from benchmarks.lib.command import Count, command, options
from benchmarks.lib.fan_out import FanOut
from benchmarks.lib.outputs import ROOT, commit, versions, write_json
from benchmarks.lib.statistics import bootstrap
from benchmarks.loop.measures import mean_error
from benchmarks.loop.scenarios import PRESET_SCENARIOS, SCENARIOS, PlantOptions, Scenario
from mptc_gym import PRESETS
from mptc_gym.evaluation import (
    EPISODES,
    SEED,
    VALIDATION_EPISODES,
    VALIDATION_SEED,
)
from mptc_gym.plant.parameters import EPISODE_STEPS

# Heading of the table's column for each kind of reference error.
HEADINGS = {"preview": "with preview", "causal": "without preview", "surprise": "surprise"}
# Explanation of each column of the table, by heading, in the order of the columns.
COLUMNS = {
    "idle valve": "the error if the flow stays at 0 t/h.",
    "with preview": (
        "a lower bound for every controller, even for a controller that knows all set points "
        "in advance."
    ),
    "without preview": (
        "a lower bound for controllers that see a set-point change only when it happens. This "
        "bound exists only for random set points, because it is derived from the distribution "
        "of the set points."
    ),
    "surprise": (
        "the least error of a controller that finds the plant settled at each set-point change "
        "and does not expect the change. It is not a lower bound: a controller that "
        "knows the times of the changes can have a smaller error. If the set point never "
        'changes, the error equals the bound "with preview".'
    ),
    "MPC": (
        "the error of model predictive control, which knows the plant, but neither the load "
        "nor future set points. The option --mpc adds this column."
    ),
}
INTERVALS = "Numbers in parentheses are 95 % confidence intervals over random episodes."

# File of the package `mptc_gym` with the reference errors of the package's presets.
PACKAGE_FILE = ROOT / "mptc_gym" / "bounds.json"
# Number of episodes whose reference errors the package has. Published scores use
# `EPISODES` episodes; with 20 more, a somewhat longer evaluation also has a score.
PACKAGED_EPISODES = EPISODES + 20
PACKAGED = PRESETS | {
    f"{name}, random set points": {**PRESETS[name], "setpoint": "random"}
    for name in ("paper", "disturbed", "fouling")  # for policies that meet random set points
}


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Print the reference error of each case, by each kind that the case has.

    A case is a set of arguments of the environment. By default, the cases are the cases of
    `python -m benchmarks.compare` and the presets of the environment.
    """

    mpc: Count | None = None
    """Number of runs of each case with model predictive control, whose mean error is added."""
    package: bool = False
    """Instead of the table, write the reference errors that ship with the package mptc_gym."""
    fan_out: FanOut = field(default_factory=FanOut)
    plant: PlantOptions = field(default_factory=PlantOptions)


def work(options: Options) -> None:
    """Print a table of reference errors, below an explanation of the columns.

    If tasks fail or the user interrupts the computation, the printed table has only the cases
    that are finished. With the option `--package`, write the file `mptc_gym/bounds.json`
    instead.
    """
    import pandas as pd

    from benchmarks.lib.sections import Section, show

    if options.package:
        write_package(options.fan_out)
        return
    cases = options.plant.cases(SCENARIOS | PRESET_SCENARIOS)
    tasks = {name: partial(row, case, options.mpc) for name, case in cases.items()}
    title = "Mean absolute error in °C"
    if options.plant.name:
        title += f", plant: {options.plant.name}"
    finished = options.fan_out.run(tasks, "bounds")
    explanations = [f'- "{heading}": {meaning}' for heading, meaning in COLUMNS.items()]
    table = pd.DataFrame(list(finished.results.values()))
    show(Section(f"{title}:", [INTERVALS, *explanations], table))
    if finished.error:
        raise finished.error


def row(case: Scenario, mpc_runs: int | None) -> dict[str, str]:
    """Return a case's row of the printed table: mean errors, degC, as texts by column heading.

    If `mpc_runs` is not None, the row also has the error of so many runs of MPC.
    The returned text is "" for the column "without preview" if set points are not random, and
    for the column "surprise" if the set point changes before the plant has settled.
    """
    reference = partial(reference_error, samples=case.samples, **case.arguments)
    # Formatting an `Estimate`, as in f"{estimate:.4f}", adds the interval in parentheses. The
    # error of an idle valve does not depend on the kind of reference error; "preview" is used
    # because this kind exists for every case.
    cells = {"case": case.name, "idle valve": f"{reference(kind='preview').idle:.4f}"}
    for kind, heading in HEADINGS.items():
        cells[heading] = ""
        with suppress(NoReferenceError):
            cells[heading] = f"{reference(kind=kind):.4f}"
    if mpc_runs is not None:
        runs = ROSTER["mpc"].run(case.arguments, case.samples, mpc_runs, SEED)
        cells["MPC"] = f"{bootstrap(mean_error(runs), seed=0):.4f}"
    return cells


def write_package(fan_out: FanOut) -> None:
    """Write the file `mptc_gym/bounds.json`, and print its path.

    `fan_out` distributes the cases of `PACKAGED` to worker processes.
    """
    tasks = {name: partial(packaged_case, arguments) for name, arguments in PACKAGED.items()}
    finished = fan_out.run(tasks, "bounds")
    if finished.error:
        raise finished.error
    content = {
        "command": "python -m benchmarks.bounds --package",
        "commit": commit(),
        "versions": versions(),
        "unit": "degC, mean of |e(k)| over k = 1 to samples",
        "samples": EPISODE_STEPS,
        "seed": SEED,
        "episodes": PACKAGED_EPISODES,
        "validation_seed": VALIDATION_SEED,
        "validation_episodes": VALIDATION_EPISODES,
        "cases": finished.results,
    }
    write_json(PACKAGE_FILE, content)
    print(f"Written to {PACKAGE_FILE}")


def packaged_case(arguments: dict[str, Any]) -> dict[str, Any]:
    """Return the reference errors of a case for the file `mptc_gym/bounds.json`.

    `arguments` are the arguments of the environment that define the case. In the returned dict,
    the list "reference" has the reference error of each evaluation episode, degC, or a single
    number if all episodes have the same reference error. If the reference error differs between
    episodes, the returned dict also has the list "validation_reference": the reference error,
    degC, of each episode with which trained policies are selected.
    """
    reference = partial(reference_error, samples=EPISODE_STEPS, **arguments)
    published = reference(seed=SEED, episodes=PACKAGED_EPISODES)
    entry = {"arguments": arguments, "kind": published.kind, "reference": published.episodes}
    if len(published.episodes) > 1:
        validation = reference(seed=VALIDATION_SEED, episodes=VALIDATION_EPISODES)
        entry["validation_reference"] = validation.episodes
    return entry


main = command("bounds", Options, work)

if __name__ == "__main__":
    raise SystemExit(main())
