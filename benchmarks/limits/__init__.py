"""How far anyone can come: bounds that hold for every controller, a reference, and a score."""

from benchmarks.limits.bounds import (
    KINDS,
    LeastPossible,
    frontier,
    least_possible,
)
from benchmarks.limits.reference import (
    Limit,
    held,
    minimum_variance,
    scenario_limit,
    steady_stretches,
)

__all__ = [
    "KINDS",
    "LeastPossible",
    "Limit",
    "frontier",
    "held",
    "least_possible",
    "minimum_variance",
    "scenario_limit",
    "steady_stretches",
]
