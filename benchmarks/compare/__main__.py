"""Compare controllers in the same noise: `python -m benchmarks.compare --help`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from cyclopts import Parameter

from benchmarks.controllers.options import AgentNames, ControllerOptions
from benchmarks.controllers.roster import ROSTER
from benchmarks.lib.command import Folder, Names, Runs, command, options
from benchmarks.loop.plants import PlantOptions
from benchmarks.loop.scenarios import SCENARIOS, SETPOINTS
from mptc_gym import PRESETS

COMPARED = tuple(name for name, controller in ROSTER.items() if controller.compared)
RUNS = 100
_CASES = (
    f"Cases to run (default: all). Of the paper: {', '.join(SCENARIOS)}. With --presets: "
    f"{', '.join(PRESETS)}. With --plant, --preset or --set: "
    f"{', '.join(name for name, *_ in SETPOINTS)}."
)


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Run controllers on the same cases in the same noise, and write a report.

    The report has tables, data and pictures.
    """

    agents: AgentNames = COMPARED
    controllers: ControllerOptions = field(default_factory=ControllerOptions)
    scenarios: Annotated[Names | None, Parameter(help=_CASES)] = None
    plant: PlantOptions = field(default_factory=PlantOptions)
    presets: bool = False
    """Run the environment's presets instead of the paper's cases."""
    runs: Runs = RUNS
    """Runs of each controller in each case."""
    out: Folder | None = None
    """Folder to write to (default: results/compare, or for other controllers or cases a folder
    beside it that is named after them)."""


main = command(Options, "benchmarks.compare.command", width=190)

if __name__ == "__main__":
    raise SystemExit(main(None))
