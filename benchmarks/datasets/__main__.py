"""Write offline data sets: `python -m benchmarks.datasets --help`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from cyclopts import Parameter

from benchmarks.lib.command import Count, Names, command, options

SAMPLES = 1200  # per episode
EPISODES = 100  # per data set
PLANTS = ("paper", "disturbed", "fouling")  # presets
BEHAVIOURS = {
    "pi": ("pi",),
    "smith": ("smith",),
    "mixed": ("pi", "pi-simc", "smith", "nn"),  # controllers take turns, episode by episode
}
IDS = {
    f"middlepoint/{plant}/{behaviour}-v0": (plant, behaviour)
    for plant in PLANTS
    for behaviour in BEHAVIOURS
}


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Write offline data sets to Minari's folder.

    Each includes the least possible error of its plant.
    """

    ids: Annotated[Names, Parameter(choices=IDS)] = field(default=(), kw_only=False)
    """Data sets to write (default: all)."""
    episodes: Count = EPISODES
    """Episodes per data set, of 1,200 transitions each."""


main = command(Options, "benchmarks.datasets.command")

if __name__ == "__main__":
    raise SystemExit(main(None))
