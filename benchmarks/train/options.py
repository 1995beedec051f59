"""Declare the options of `python -m benchmarks.train`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from benchmarks.lib.options import Count, FanOutOptions, Folder, choice, options

OUT = Path("results/networks")


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Train the networks that control: by the gradient through the plant, or by PPO.

    What is finished is kept: the same command trains what is missing.
    """

    network: Annotated[str, choice(("nn-smith", "ppo"), "What to train")] = field(kw_only=False)
    networks: Count | None = None
    """How many to train, each from a seed of its own (default: 1 of nn-smith, of which
    validation would choose one, and 5 of PPO, all of which are compared)."""
    steps: Count | None = None
    """Steps of the optimiser, for PPO samples of experience (default: as published)."""
    retrain: bool = False
    """Train even what is finished."""
    keep: bool = False
    """Put the result into agents/pretrained."""
    out: Folder = OUT
    fan_out: FanOutOptions = field(default_factory=FanOutOptions)
