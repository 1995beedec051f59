"""Run controllers on other plants: `python -m benchmarks.sweep --help`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from benchmarks.controllers.options import AgentNames, ControllerOptions
from benchmarks.controllers.roster import ROSTER
from benchmarks.lib.command import Folder, Runs, Seed, command, options
from benchmarks.loop.plants import PlantOptions

SWEPT = tuple(name for name, controller in ROSTER.items() if controller.swept)


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Run controllers on plants that they were not made for.

    They were made for the paper's plant, or that of --plant, --preset or --set; the design says
    how the other plants differ from it.
    """

    design: Literal["grid", "random", "wide"] = "grid"
    """grid: 20 delays by 10 gains; random: plants that differ in everything, half of which
    drift; wide: the same, most of them outside the ranges of random."""
    plants: Runs = 200
    """Plants of a random or wide design."""
    design_seed: Seed = 0
    """Seed for the plants of a random or wide design."""
    told: Literal["nominal", "each"] = "nominal"
    """nominal: every controller is made for the one plant above; each: for the plant that it
    runs on, as it is before any drift."""
    runs: Runs = 20
    """Runs of a controller on a plant."""
    samples: Runs = 1200
    """Samples of 8 s in a run."""
    agents: AgentNames = SWEPT
    controllers: ControllerOptions = field(default_factory=ControllerOptions)
    plant: PlantOptions = field(default_factory=PlantOptions)
    out: Folder | None = None
    """Folder to write to (default: results/sweep-DESIGN)."""


main = command(Options, "benchmarks.sweep.command", width=150)

if __name__ == "__main__":
    raise SystemExit(main(None))
