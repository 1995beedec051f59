"""Serve environments of every kind: one plant or many, in NumPy or PyTorch, wrapped or not.

- `making` makes environments from ids and specs (`EnvSpec`).
- `batch` is the base class of the vector environments in NumPy and PyTorch.
- `layers` looks into wrapped environments.
- `record` keeps the latest samples of an episode, and `drawing` draws them.
"""
