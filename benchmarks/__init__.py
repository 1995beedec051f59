"""Questions about controllers on this plant. `python -m benchmarks` lists them."""
