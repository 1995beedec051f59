"""Test the paper's claims: `python -m benchmarks.claims --help`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.lib.command import Folder, Names, Runs, command, options
from benchmarks.lib.fan_out import FanOut


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
    fan_out: FanOut = field(default_factory=FanOut)
    out: Folder = Path("results/claims")


main = command(Options, "benchmarks.claims.command")

if __name__ == "__main__":
    raise SystemExit(main(None))
