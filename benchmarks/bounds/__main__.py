"""Print the least possible mean error: `python -m benchmarks.bounds --help`."""

import shutil
import textwrap
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from benchmarks.lib.command import Count, Runs, Seed, command, options
from benchmarks.lib.errors import NoBoundError
from benchmarks.lib.parallel import FanOut
from benchmarks.lib.provenance import ROOT, commit, versions
from benchmarks.lib.storage import write_json
from benchmarks.loop.scenarios import PRESET_SCENARIOS, SCENARIOS, PlantOptions, Scenario
from mptc_gym import PRESETS
from mptc_gym.evaluation import (
    EPISODES,
    SAMPLES,
    SEED,
    VALIDATION_EPISODES,
    VALIDATION_SEED,
)

HEADINGS = {"preview": "with preview", "causal": "without preview", "reference": "reference"}
NOTE = (
    "'With preview' is a lower bound for every controller, even one that knows all set points "
    "in advance. 'Without preview' is a lower bound for controllers that see a change of the "
    "set point only when it happens; it exists for random set points, whose distribution is "
    "known. 'Reference' is the lowest error if the plant has settled before each change and "
    "the change comes as a surprise; a controller that knows when the changes come can do "
    "better. If the set point never changes, the three are the same. All three assume that the "
    "controller knows the present load. 'Hidden load' is an estimate, and no bound, for "
    "controllers that see the load only through the transmitter. Intervals are 95 % intervals "
    "over sampled episodes."
)
PACKAGE = ROOT / "mptc_gym" / "bounds.json"
# The package has the bounds of this many episodes after the `EPISODES` of a published score, so
# that a somewhat longer evaluation can be compared with bounds, too.
MORE_EPISODES = 20
PACKAGED = PRESETS | {
    f"{name}, random set points": {**PRESETS[name], "setpoint": "random"}
    for name in ("paper", "disturbed", "fouling")  # the plants of the data sets
}


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Print the least possible mean error of each case.

    The cases are those of the comparison and the presets, or the cases of another plant.
    """

    mpc: Runs | None = None
    """Also run the predictive controller this many times in each case."""
    package: bool = False
    """Write the bounds of the presets that ship with the package instead."""
    fan_out: FanOut = field(default_factory=FanOut)
    plant: PlantOptions = field(default_factory=PlantOptions)
    samples: Count | None = None
    """Length of an episode, samples (default: the length of the case)."""
    episodes: Count = EPISODES
    """Episodes to average a bound over, where plants or set points are drawn."""
    seed: Seed = SEED
    """Seed of the first episode."""


def work(options: Options) -> str:
    """Print the bounds of all cases and presets, or of another plant; return a note for users.

    After an error or an interruption, the cases that have finished are printed. With the option
    `package`, the bounds that ship with the package are written instead.
    """
    import pandas as pd

    from benchmarks.lib.report import on_screen

    cases = options.plant.cases(SCENARIOS | PRESET_SCENARIOS)
    if options.package:
        return write_package(options.fan_out)
    tasks = {name: partial(row, case, options) for name, case in cases.items()}
    print(", ".join(filter(None, ["Mean |e| in °C", options.plant.name])) + ":")
    rows: dict[str, dict[str, str]] = {}
    try:
        rows.update(options.fan_out.stream(tasks, "bounds"))
    finally:
        if rows:
            table = pd.DataFrame([rows[name] for name in tasks if name in rows])
            print(on_screen(table), flush=True)
    return "\n" + textwrap.fill(NOTE, shutil.get_terminal_size((150, 24)).columns)


def row(case: Scenario, options: Options) -> dict[str, str]:
    """Return the table's row for a case: its name and its errors, degC, as text.

    The keys are the headings of the table. The text is empty if the case has no bound of a
    kind, or if it has no load for the estimate.
    """
    from benchmarks.bounds.least import least_possible, with_hidden_load
    from benchmarks.controllers.roster import ROSTER
    from benchmarks.lib.statistics import bootstrap
    from benchmarks.loop.rollout import mean_error

    samples = options.samples or case.samples
    arguments: dict[str, Any] = {
        "samples": samples,
        "episodes": options.episodes,
        "seed": options.seed,
        **case.arguments,
    }
    cells = {"case": case.name}
    cells["idle valve"] = f"{least_possible(kind='preview', **arguments).idle:.4f}"
    for kind, heading in HEADINGS.items():
        cells[heading] = ""
        with suppress(NoBoundError):
            cells[heading] = f"{least_possible(kind=kind, **arguments):.4f}"
    cells["hidden load (estimate)"] = ""
    if case.parameters.is_disturbed:
        cells["hidden load (estimate)"] = f"{with_hidden_load(**arguments):.4f}"
    if options.mpc:
        runs = ROSTER["mpc"].run(case.arguments, samples, options.mpc, options.seed)
        cells["MPC"] = f"{bootstrap(mean_error(runs), seed=0):.4f}"
    return cells


def write_package(fan_out: FanOut) -> str:
    """Write the least possible errors that ship with the package, `bounds.json`.

    Each case of `PACKAGED` has a list "least", the bounds of the episodes of published scores,
    degC; the list has one number if all episodes have the same bound. If bounds differ between
    episodes, the case also has a list "validation_least", the bounds of the episodes on which
    policies are selected. `fan_out` runs the cases in parallel. The closing message of the
    command is returned.
    """
    from benchmarks.bounds.least import least_possible

    published: dict[str, Any] = {"seed": SEED, "episodes": EPISODES + MORE_EPISODES}
    validation: dict[str, Any] = {"seed": VALIDATION_SEED, "episodes": VALIDATION_EPISODES}
    tasks = {
        name: partial(least_possible, samples=SAMPLES, **published, **arguments)
        for name, arguments in PACKAGED.items()
    }
    bounds = dict(fan_out.stream(tasks, "bounds"))
    tasks = {
        name: partial(least_possible, samples=SAMPLES, **validation, **PACKAGED[name])
        for name, least in bounds.items()
        if len(least.episodes) > 1
    }
    validation_bounds = dict(fan_out.stream(tasks, "validation bounds"))
    cases: dict[str, dict[str, Any]] = {}
    for name, arguments in PACKAGED.items():
        least = bounds[name]
        cases[name] = {"arguments": arguments, "kind": least.kind, "least": least.episodes}
        if name in validation_bounds:
            cases[name]["validation_least"] = validation_bounds[name].episodes
    content = {
        "command": "python -m benchmarks.bounds --package",
        "commit": commit(),
        "versions": versions(),
        "unit": "degC, mean of |e(k)| over k = 1 to samples",
        "samples": SAMPLES,
        **published,
        "validation_seed": VALIDATION_SEED,
        "validation_episodes": VALIDATION_EPISODES,
        "cases": cases,
    }
    write_json(PACKAGE, content)
    return f"Written to {PACKAGE}"


main = command("bounds", Options, work)

if __name__ == "__main__":
    raise SystemExit(main(None))
