"""Declare the options of `python -m benchmarks.train`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from benchmarks.lib.options import Count, FanOutOptions, Folder, Prices, choice, options

NETWORKS = ("nn-dpc", "nn-adaptive", "ppo")


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Train the networks that control: by the gradient through the plant, or by PPO.

    nn-dpc is for the paper's plant, nn-adaptive for many plants. Several networks are trained,
    which differ in their seeds, and validation chooses one. ppo trains the policies of
    Stable-Baselines3's PPO, all of which are compared. What is finished is kept: the same
    command, run again after it was interrupted, trains what is missing.
    """

    network: Annotated[str, choice(NETWORKS, "What to train")] = field(kw_only=False)
    networks: Count = 5
    """How many to train, each from a seed of its own."""
    steps: Count | None = None
    """Steps of the optimiser, for PPO samples of experience (default: those of the networks
    that come with the project)."""
    prices: Prices = ()
    """Train with each of these prices of valve travel, °C for each t/h a sample, and draw what
    it buys."""
    retrain: bool = False
    """Train even what is finished."""
    keep: bool = False
    """Put what is chosen into agents/pretrained."""
    out: Folder = Path("results/networks")
    fan_out: FanOutOptions = field(default_factory=FanOutOptions)
