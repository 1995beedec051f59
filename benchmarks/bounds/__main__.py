"""Print the least possible mean error: `python -m benchmarks.bounds --help`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.lib.command import Count, Runs, Seed, command, options
from benchmarks.lib.fan_out import FanOut
from benchmarks.loop.plants import PlantOptions
from mptc_gym.evaluation import EPISODES, SEED


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
    cache: Path | None = None
    """Folder in which computed bounds are kept (default: results/bounds)."""


main = command(Options, "benchmarks.bounds.command", width=150)

if __name__ == "__main__":
    raise SystemExit(main(None))
