"""Which gains are best? `python -m benchmarks.tune`."""
