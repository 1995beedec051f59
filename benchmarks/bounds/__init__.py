"""Compute lower bounds of the mean error of every controller, and reference errors."""

from typing import Any


def __getattr__(name: str) -> Any:
    """Return `least_possible`, imported on first use: importing SciPy would delay `--help`."""
    if name != "least_possible":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from benchmarks.bounds.least import least_possible

    return least_possible
