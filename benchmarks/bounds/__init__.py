"""Compute lower bounds of the mean error of every controller, and reference errors."""

from benchmarks.bounds.least import least_possible as least_possible
