"""Compute lower bounds for every controller, a reference, and a score."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from benchmarks.bounds.least import least_possible

__all__ = ["least_possible"]


def __getattr__(name: str) -> Any:
    """Import the function when it is used, as SciPy takes longer to load than a help text."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from benchmarks.bounds import least

    return getattr(least, name)
