"""Draw the pictures of sweeps and the film."""
