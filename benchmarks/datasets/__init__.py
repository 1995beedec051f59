"""Offline data sets with a known optimum: `python -m benchmarks.datasets`."""
