"""How far anyone can come: bounds that hold for every controller, a reference, and a score."""

from benchmarks.limits.bounds import (
    KINDS,
    LeastPossible,
    frontier,
    least_possible,
)
from benchmarks.limits.reference import held, steady_stretches

__all__ = [
    "KINDS",
    "LeastPossible",
    "frontier",
    "held",
    "least_possible",
    "steady_stretches",
]
