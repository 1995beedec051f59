"""Declare the options of `python -m benchmarks.claims`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.lib.options import FanOutOptions, Folder, Names, Runs, options


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Test the paper's claims, each on a thousand runs.

    The verdicts go to claims.md, all numbers to claims.csv, plots and their data beside them.
    """

    claims: Names = field(default=(), kw_only=False)
    """Claims to test (default: all)."""
    runs: Runs = 1000
    """Runs of each case."""
    fan_out: FanOutOptions = field(default_factory=FanOutOptions)
    out: Folder = Path("results/claims")
