"""Declare the options of `python -m benchmarks.identify.study`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.lib.options import FanOutOptions, Folder, Runs, Seed, options


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Identify known plants from synthetic logs, and count how often that is right."""

    logs: Runs = 60
    """Logs of a kind, each of its plant."""
    plants: Runs | None = None
    """Random plants besides, on which the recommended loops are tried."""
    samples: Runs = 1200
    """Rows of a log."""
    seed: Seed = 1
    """Seed that plants, steps of the flow and noise are drawn with."""
    fan_out: FanOutOptions = field(default_factory=FanOutOptions)
    out: Folder = Path("results/identify-study")
