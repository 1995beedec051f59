"""Serve environments of every kind: one plant or many, in NumPy or PyTorch, wrapped or not.

- `making` makes environments from ids and specs (`EnvSpec`).
- `batch` holds what the vector environments of NumPy and PyTorch share.
- `layers` looks into wrapped environments.
- `record` keeps the latest samples of an episode, and `drawing` draws them.
"""
