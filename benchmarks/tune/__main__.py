"""Tune a controller's gains: `python -m benchmarks.tune --help`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from benchmarks.controllers.roster import ROSTER
from benchmarks.lib.command import Count, Folder, Runs, command, options
from benchmarks.lib.fan_out import FanOut
from benchmarks.loop.plants import PlantOptions

TUNED = {name: each.tuning for name, each in ROSTER.items() if each.tuning}
_TRIALS = ", ".join(f"{tuning.trials} for {name}" for name, tuning in TUNED.items())


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Tune a controller's gains with Optuna.

    All trials use the same set points and seeds, which no comparison uses. The search is saved
    after every trial; the same command resumes it and gives the same result.
    """

    controller: Annotated[str, Parameter(choices=TUNED)] = field(kw_only=False)
    """Whose gains to search."""
    trials: Annotated[
        Count | None, Parameter(help=f"How many sets of gains to try (default: {_TRIALS}).")
    ] = None
    runs: Runs = 100
    """Runs of each case in a trial."""
    plant: PlantOptions = field(default_factory=PlantOptions)
    out: Folder = Path("results/tune")
    fan_out: FanOut = field(default_factory=FanOut)


main = command(Options, "benchmarks.tune.command")

if __name__ == "__main__":
    raise SystemExit(main(None))
