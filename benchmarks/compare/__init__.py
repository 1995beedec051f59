"""How do the controllers compare? `python -m benchmarks.compare`."""
