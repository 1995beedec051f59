"""Compare controllers on the cases of the paper and on the presets."""
