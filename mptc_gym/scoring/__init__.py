"""Hold the modules that `mptc_gym.evaluate` uses to run a policy in environments."""
