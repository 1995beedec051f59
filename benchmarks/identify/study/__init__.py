"""How often is the identification correct? `python -m benchmarks.identify.study`."""
