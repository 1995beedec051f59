"""Define cases, run controllers on plants, measure the runs, and model plants as linear."""
