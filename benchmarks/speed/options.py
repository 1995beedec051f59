"""Declare the options of `python -m benchmarks.speed`."""

from __future__ import annotations

from dataclasses import dataclass

from benchmarks.lib.options import Runs, options


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Measure environment steps a second beside other environments.

    What is compared takes turns in one run and is reported as a ratio, with its spread. EnvPool
    and gymnax are measured where they are installed.
    """

    rounds: Runs = 15
    """Measurements of each."""
    device: str | None = None
    """Measure the environment in PyTorch there (cuda), and nothing else."""
