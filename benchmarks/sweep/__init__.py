"""Where do controllers still work on other plants? `python -m benchmarks.sweep`."""
