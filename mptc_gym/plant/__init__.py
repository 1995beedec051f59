"""Model the plant: the arguments, the dynamics and the external signals.

- `parameters` declares every argument of the environment, and `checks` checks single values.
- `sampling` samples the parameter values of a plant for each episode.
- `signals` generates set points, noise and loads.
- `dynamics` simulates plants and actuators.
- `state` returns quantities of plants that a policy cannot observe, for use in training.
"""
