"""Declare the options of `python -m benchmarks.sweep`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from benchmarks.controllers.options import AgentNames, ControllerOptions
from benchmarks.controllers.roster import ROSTER
from benchmarks.lib.options import Runs, Seed, options
from benchmarks.loop.plants import PlantOptions

SWEPT = tuple(name for name, controller in ROSTER.items() if controller.swept)


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Run controllers on plants that they were not made for.

    The plant that they were made for is the paper's, or that of --plant, --preset or --set; the
    others differ from it in what the design says.
    """

    design: Literal["grid", "random", "wide"] = "grid"
    """grid: 20 delays by 10 gains; random: plants that differ in everything, half of which
    drift; wide: the same, most of them beyond what random draws from."""
    plants: Runs = 200
    """Plants of a random or wide design."""
    design_seed: Seed = 0
    """Seed that the plants of a random or wide design are drawn with."""
    told: Literal["nominal", "each"] = "nominal"
    """nominal: every controller is made for the one plant above; each: for the very plant that
    it runs on, as it is at the start if it drifts."""
    runs: Runs = 20
    """Runs of a controller on a plant."""
    samples: Runs = 1200
    """Samples of 8 s in a run."""
    agents: AgentNames = SWEPT
    controllers: ControllerOptions = field(default_factory=ControllerOptions)
    plant: PlantOptions = field(default_factory=PlantOptions)
    out: Path | None = None
    """Folder to write to (default: results/sweep-DESIGN)."""
