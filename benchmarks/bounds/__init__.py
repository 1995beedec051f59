"""Compute lower bounds for every controller, a reference, and a score."""

from typing import Any


class NoBoundError(ValueError):
    """The case has no bound of the kind that was asked for; the message says why."""


def __getattr__(name: str) -> Any:
    """Import `least_possible` when it is used, as SciPy loads more slowly than a help text."""
    if name != "least_possible":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from benchmarks.bounds.least import least_possible

    return least_possible
