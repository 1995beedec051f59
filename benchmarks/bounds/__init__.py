"""Compute least possible mean errors: lower bounds for every controller, and a reference."""

from typing import Any


def __getattr__(name: str) -> Any:
    """Import `least_possible` on its first use, as SciPy loads more slowly than a help text."""
    if name != "least_possible":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from benchmarks.bounds.least import least_possible

    return least_possible
