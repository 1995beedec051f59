"""Simulate many plants at once in PyTorch, on any device, optionally with gradients.

- `env` has the environment, `MiddlePointTorchEnv`.
- `episodes` keeps the sample number and the parameter values of every plant.
- `signals` generates set points, noise and loads.
- `plant` computes the temperatures, a block of successive samples at a time.
- `window` stores the observations.
"""

from mptc_gym.torch_env.env import MiddlePointTorchEnv, make_vec

__all__ = ["MiddlePointTorchEnv", "make_vec"]
