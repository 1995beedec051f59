"""Lower bounds that hold for every controller, a reference, and a score."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from benchmarks.limits.bounds import (
        KINDS,
        LeastPossible,
        frontier,
        is_random,
        least_possible,
    )
    from benchmarks.limits.reference import held, steady_stretches

__all__ = [
    "KINDS",
    "LeastPossible",
    "frontier",
    "held",
    "is_random",
    "least_possible",
    "steady_stretches",
]


def __getattr__(name: str) -> Any:
    """Import what is asked for, as SciPy takes longer to load than a command's help."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    place = "reference" if name in ("held", "steady_stretches") else "bounds"
    return getattr(importlib.import_module(f"benchmarks.limits.{place}"), name)
