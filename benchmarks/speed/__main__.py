"""Measure the speed of the environments: `python -m benchmarks.speed --help`."""

from __future__ import annotations

from dataclasses import dataclass

from benchmarks.lib.command import Runs, command, options


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Compare the steps a second of this and other environments.

    The compared cases are timed in turns within one run and reported as ratios with their
    spread. EnvPool and gymnax are included if they are installed.
    """

    rounds: Runs = 15
    """Number of measurements of each case."""
    device: str | None = None
    """Measure only the PyTorch environment, on this device, such as cuda."""


main = command(Options, "benchmarks.speed.command", width=130, interrupted="nothing is kept.")

if __name__ == "__main__":
    raise SystemExit(main(None))
