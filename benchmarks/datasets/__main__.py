"""Write offline data sets: `python -m benchmarks.datasets --help`."""

from __future__ import annotations

from dataclasses import dataclass, field

from benchmarks.lib.command import Count, Names, command, options

SAMPLES = 1200  # per episode
EPISODES = 100  # per data set


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Write offline data sets to Minari's folder.

    Each includes the least possible error of its plant.
    """

    ids: Names = field(default=(), kw_only=False)
    """Data sets to write, such as middlepoint/paper/pi-v0 (default: all)."""
    episodes: Count = EPISODES
    """Episodes per data set, of 1,200 transitions each."""


main = command(Options, "benchmarks.datasets.command")

if __name__ == "__main__":
    raise SystemExit(main(None))
