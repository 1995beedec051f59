"""How far anyone can come: bounds that hold for every controller, a reference, and a score."""

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
