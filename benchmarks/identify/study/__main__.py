"""Identify known plants from synthetic logs: `python -m benchmarks.identify.study --help`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.lib.command import Folder, Runs, Seed, command, options
from benchmarks.lib.fan_out import FanOut


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Identify known plants from synthetic logs, and count how often this is correct."""

    logs: Runs = 60
    """Number of logs of each kind, each from a plant of its own."""
    plants: Runs | None = None
    """Number of additional random plants on which recommended loops are tried."""
    faults: Runs | None = None
    """Number of additional logs of each kind of faulty valve, by a simulator of its own."""
    samples: Runs = 1200
    """Number of rows of a log."""
    seed: Seed = 1
    """Seed of the plants, the steps of the flow and the noise."""
    fan_out: FanOut = field(default_factory=FanOut)
    out: Folder = Path("results/identify-study")


main = command(Options, "benchmarks.identify.study.command")

if __name__ == "__main__":
    raise SystemExit(main(None))
