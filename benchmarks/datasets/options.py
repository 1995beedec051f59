"""Declare the options of `python -m benchmarks.datasets`."""

from __future__ import annotations

from dataclasses import dataclass, field

from benchmarks.lib.options import Count, Names, options

SAMPLES = 1200  # of an episode
EPISODES = 100  # of a data set


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Write offline data sets where Minari keeps its own.

    Each comes with the least possible error of its plant.
    """

    ids: Names = field(default=(), kw_only=False)
    """Data sets to write, such as middlepoint/paper/pi-v0 (default: all)."""
    episodes: Count = EPISODES
    """Episodes of a data set, 1,200 transitions each."""
