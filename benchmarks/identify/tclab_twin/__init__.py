"""Does it work on a plant of others? `python -m benchmarks.identify.tclab_twin`."""
