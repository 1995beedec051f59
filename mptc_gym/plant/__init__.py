"""Model the plant: its arguments, its dynamics and the signals that reach it.

- `parameters` declares every argument of the environment, and `checks` checks single values.
- `sampling` samples the plant numbers of an episode from its own random numbers.
- `signals` generates set points, noise and loads.
- `dynamics` steps plants and valves; `state` describes a plant to a teacher in training.
"""
