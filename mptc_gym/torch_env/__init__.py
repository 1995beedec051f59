"""Simulate many plants side by side in PyTorch, on any device, optionally with gradients.

- `env` is the environment, `MiddlePointTorchEnv`.
- `episodes` keeps what every plant has of its own: its sample number and its plant numbers.
- `signals` generates set points, noise and loads.
- `plant` moves the plants, a block of samples at a time.
- `window` stores the observations.
"""

from mptc_gym.torch_env.env import MiddlePointTorchEnv, make_vec

__all__ = ["MiddlePointTorchEnv", "make_vec"]
