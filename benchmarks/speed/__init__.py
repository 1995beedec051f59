"""How fast is it? `python -m benchmarks.speed`."""
