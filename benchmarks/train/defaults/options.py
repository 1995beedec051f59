"""Declare the options of `python -m benchmarks.train.defaults`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from benchmarks.lib.options import Count, Runs, Seed, choice, options

CASES = ("ppo-velocity", "ppo", "sac")


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Train with the default settings of Stable-Baselines3, and test on the way."""

    case: Annotated[str, choice(CASES, "What learns, and on which plant")] = "ppo-velocity"
    steps: Count = 300_000
    """Samples of each training."""
    seed: Seed = 0
    """The first seed."""
    seeds: Runs = 3
    """How many seeds to train with."""
    interval: Count = 20_000
    """Samples between tests."""
    out: Path | None = None
    """Where sb3_defaults.csv and sb3_defaults.png are kept."""
    plot: bool = False
    """Train nothing, only draw what --out holds."""
