"""Watch a controller at work, or take its place: `python -m benchmarks.watch`."""
