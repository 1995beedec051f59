"""Watch a controller at work: `python -m benchmarks.watch --help`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from benchmarks.controllers.roster import ROSTER
from benchmarks.lib.command import Count, Seed, command, options
from benchmarks.loop.plants import PlantOptions
from benchmarks.loop.scenarios import SCENARIOS, SETPOINTS
from mptc_gym import MiddlePointEnv

_AGENTS = (
    f"Who controls: {', '.join(ROSTER)}, or a controller of your own, "
    "NAME=MODULE:FACTORY or NAME=PPO:FILE.zip."
)
_CASES = (
    f"Case to run: {', '.join(SCENARIOS)}; on a plant of your own "
    f"{', '.join(name for name, *_ in SETPOINTS)}, or run if it has a set point of its own."
)


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Watch a controller at work, in a window or in a film."""

    agent: Annotated[str, Parameter(help=_AGENTS)] = "nn"
    scenario: Annotated[str, Parameter(help=_CASES)] = "square"
    plant: PlantOptions = field(default_factory=PlantOptions)
    seed: Seed = 0
    """Seed of noise and initial weights."""
    speed: Count = MiddlePointEnv.metadata["render_fps"]
    """Samples per second."""
    video: Path | None = None
    """Write a film to this file, .gif, instead of opening a window."""


main = command(Options, "benchmarks.watch.command", interrupted="nothing is kept.")

if __name__ == "__main__":
    raise SystemExit(main(None))
