"""Draw the pictures of sweeps, which compare controllers on many plants."""
