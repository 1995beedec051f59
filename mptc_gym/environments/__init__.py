"""Make, inspect, record and draw environments, with or without wrappers.

- `making` makes environments from environment ids and from Gymnasium's `EnvSpec`.
- `layers` finds the plants and the wrappers in an environment.
- `record` stores the latest samples of an episode, and `drawing` draws a picture of a record.
"""
