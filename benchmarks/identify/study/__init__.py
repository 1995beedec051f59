"""How often is the identification right? `python -m benchmarks.identify.study`."""
