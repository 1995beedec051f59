"""Train the neural controllers: `python -m benchmarks.train --help`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from benchmarks.lib.command import Count, Folder, command, options
from benchmarks.lib.fan_out import FanOut

NETWORKS = "nn-smith", "ppo", "ppo-hard"
OUT = Path("results/networks")


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Train the neural controllers: by the gradient through the plant, or by PPO.

    Finished networks are kept: the same command, run again, trains only the missing ones.
    """

    network: Annotated[str, Parameter(choices=NETWORKS)] = field(kw_only=False)
    """What to train."""
    networks: Count | None = None
    """Number of networks to train, each from its own seed (default: 1 for nn-smith, where
    validation chooses the best of several; 5 for PPO, which are all compared)."""
    steps: Count | None = None
    """Optimiser steps or, for PPO, samples of experience (default: as published)."""
    keep: bool = False
    """Save the result to agents/pretrained."""
    out: Folder = OUT
    fan_out: FanOut = field(default_factory=FanOut)


main = command(Options, "benchmarks.train.command")

if __name__ == "__main__":
    raise SystemExit(main(None))
