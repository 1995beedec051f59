"""Declare that `python -m benchmarks.identify.tclab_twin` has no options."""

from __future__ import annotations

from dataclasses import dataclass

from benchmarks.lib.options import options


@options
@dataclass(frozen=True)
class Options:
    """Identify TCLab's digital twin, a simulated heater, and compare controllers on it."""
