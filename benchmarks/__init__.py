"""Studies of controllers on the plant. Each runs as `python -m benchmarks.NAME`."""
