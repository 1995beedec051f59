"""Draw counterparts of the paper's figures: `python -m benchmarks.figures --help`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from benchmarks.lib.command import Folder, Runs, command, options


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Draw counterparts of the paper's Figs 5 to 12.

    Each case is run a thousand times, with different initial weights and noise each time. A
    strong line shows a typical run, the one with the median mean error, over a band from the
    10th to the 90th percentile of all runs. The plotted data are in CSV files.
    """

    runs: Runs = 1000
    """Runs of each case."""
    out: Folder = Path("results/figures")


main = command(Options, "benchmarks.figures.command")

if __name__ == "__main__":
    raise SystemExit(main(None))
