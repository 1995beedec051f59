"""The control loop: the plant, the cases, the one rollout loop and what is measured of it."""
