"""Print the least possible mean error: `python -m benchmarks.bounds --help`."""

import shutil
import textwrap
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from benchmarks.lib.command import Count, FanOut, Runs, Seed, command, options
from benchmarks.lib.errors import NoBoundError
from benchmarks.lib.provenance import ROOT, commit, versions
from benchmarks.lib.storage import write_json
from benchmarks.loop.scenarios import PRESET_SCENARIOS, SCENARIOS, PlantOptions, Scenario
from mptc_gym import PRESETS
from mptc_gym.evaluation import EPISODES, SAMPLES, SEED

HEADINGS = {"preview": "with preview", "causal": "without preview", "reference": "reference"}
NOTE = (
    "With preview: no controller does better on average, even one that knows the set point "
    "beforehand. Without: none that learns of a change of the set point when it happens; for "
    "random set points alone, which have a law. Reference: the same, if each change finds the "
    "plant settled; a controller that counts samples can come below it. Where a set point "
    "never changes, the three are the same. 95 % intervals over drawn episodes."
)
PACKAGE = ROOT / "mptc_gym" / "bounds.json"
MORE = 20  # episodes of the package beyond those of a score, for choosing policies
PACKAGED = PRESETS | {
    f"{name}, random set points": {**PRESETS[name], "setpoint": "random"}
    for name in ("paper", "disturbed", "fouling")  # for the data sets
}


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Print the least possible mean error of each case.

    The cases are those of the comparison and the presets, or those of another plant.
    """

    mpc: Runs | None = None
    """Also run the predictive controller this many times in each case."""
    package: bool = False
    """Write the bounds of the presets that ship with the package instead."""
    fan_out: FanOut = field(default_factory=FanOut)
    plant: PlantOptions = field(default_factory=PlantOptions)
    samples: Count | None = None
    """Length of an episode, samples (default: that of the case)."""
    episodes: Count = EPISODES
    """Episodes to average a bound over, where plants or set points are drawn."""
    seed: Seed = SEED
    """Seed of the first episode."""


def work(options: Options) -> str:
    """Print the bounds of the cases and of the presets, or of another plant."""
    cases = options.plant.cases(SCENARIOS | PRESET_SCENARIOS)
    if options.package:
        return write_package(options.fan_out)
    drawn = {"episodes": options.episodes, "seed": options.seed}
    tasks = {
        name: partial(row, case, options.samples or case.samples, drawn, options.mpc)
        for name, case in cases.items()
    }
    print(", ".join(filter(None, ["Mean |e| in °C", options.plant.name])) + ":")
    found = {"": ["no control", *HEADINGS.values(), *["MPC"] * bool(options.mpc)]}
    try:
        found.update(options.fan_out.stream(tasks, "bounds"))
    finally:
        for name in [each for each in ("", *tasks) if each in found]:
            cells = "".join(f"{cell:>26}" for cell in found[name])
            print(f"{name:20}{cells}".rstrip(), flush=True)
    return "\n" + textwrap.fill(NOTE, shutil.get_terminal_size((150, 24)).columns)


def row(case: Scenario, samples: int, drawn: Mapping[str, Any], mpc: int | None) -> list[str]:
    """Return the bounds of a case, and the error of `mpc` runs of MPC, if any.

    `drawn` holds the number and first seed of the episodes.
    """
    from benchmarks.bounds.least import least_possible
    from benchmarks.controllers.roster import ROSTER
    from benchmarks.lib.statistics import bootstrap
    from benchmarks.loop.rollout import mean_error

    least = partial(least_possible, samples=samples, **drawn, **case.arguments)
    cells = [f"{least(kind='preview').idle:.4f}"]
    for kind in HEADINGS:
        cells.append("")
        # "causal" needs random set points, "reference" those that are held long enough.
        with suppress(NoBoundError):
            cells[-1] = f"{least(kind=kind):.4f}"
    if mpc:
        runs = ROSTER["mpc"].run(case.arguments, samples, mpc, drawn["seed"])
        cells.append(f"{bootstrap(mean_error(runs), seed=0):.4f}")
    return cells


def write_package(fan_out: FanOut) -> str:
    """Write the least possible error of each case, for every episode where they differ."""
    from benchmarks.bounds.least import least_possible

    case: dict[str, Any] = {"samples": SAMPLES, "seed": SEED, "episodes": EPISODES + MORE}
    tasks = {name: partial(least_possible, **case, **each) for name, each in PACKAGED.items()}
    found = dict(fan_out.stream(tasks, "bounds"))
    about = {
        "command": "python -m benchmarks.bounds --package",
        "commit": commit(),
        "versions": versions(),
        "unit": "degC, mean of |e(k)| over k = 1 to samples",
    }
    cases = {
        name: {"arguments": arguments, "kind": found[name].kind, "least": found[name].episodes}
        for name, arguments in PACKAGED.items()
    }
    write_json(PACKAGE, {**about, **case, "cases": cases})
    return f"Written to {PACKAGE}"


main = command("bounds", Options, work)

if __name__ == "__main__":
    raise SystemExit(main(None))
