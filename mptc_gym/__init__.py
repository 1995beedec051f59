"""The middle-point temperature of a once-through boiler, as a Gymnasium environment.

Importing this package registers `MiddlePoint-v0`.
"""

import gymnasium

from mptc_gym.env import MiddlePointEnv
from mptc_gym.parameters import Parameters

__version__ = "0.1.0"
__all__ = ["MiddlePointEnv", "Parameters", "__version__"]

gymnasium.register(
    id="MiddlePoint-v0",
    entry_point="mptc_gym.env:MiddlePointEnv",
    max_episode_steps=1200,
    order_enforce=False,
)
