"""Compute reference errors, most of which are lower bounds of the mean error."""

from benchmarks.bounds.reference import reference_error as reference_error
