"""The control loop: the plant, the cases, the rollout loop and its performance measures."""
