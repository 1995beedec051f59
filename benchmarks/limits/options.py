"""Declare the options of `python -m benchmarks.limits`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.lib.options import Count, FanOutOptions, Runs, options
from benchmarks.loop.plants import PlantOptions
from mptc_gym.evaluation import EPISODES


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Print the least possible mean error of each case.

    The cases are those of the comparison and the presets, or those of another plant.
    """

    mpc: Runs | None = None
    """Also run the predictive controller this many times on each plant."""
    verify: bool = False
    """Run every controller against the bounds instead."""
    package: bool = False
    """Write the bounds of the presets that ship with the package instead."""
    runs: Runs = 300
    """Runs of each controller in each case of --verify."""
    fan_out: FanOutOptions = field(default_factory=FanOutOptions)
    plant: PlantOptions = field(default_factory=PlantOptions)
    episodes: Count = EPISODES
    """Episodes to average a bound over, where plants or set points are drawn."""
    cache: Path | None = None
    """Folder in which computed bounds are kept (default: results/limits)."""
