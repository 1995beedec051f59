"""Compute lower bounds for every controller, a reference, and a score."""

from benchmarks.bounds.least import least_possible

__all__ = ["least_possible"]
