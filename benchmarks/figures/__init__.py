"""How do the paper's figures look here? `python -m benchmarks.figures`."""
