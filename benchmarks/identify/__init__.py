"""From a recorded log to a plant and its controllers: `python -m benchmarks.identify`."""
