"""Does it work on someone else's plant? `python -m benchmarks.identify.tclab_twin`."""
