"""How far do default settings get? `python -m benchmarks.train.defaults`."""
