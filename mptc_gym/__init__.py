"""Control the middle-point temperature of a once-through boiler: a Gymnasium environment.

Importing this package registers `MiddlePoint-v0`, and each of `PRESETS` under its own id.
"""

import gymnasium

from mptc_gym.env import MiddlePointEnv
from mptc_gym.evaluation import Evaluation, evaluate
from mptc_gym.parameters import Parameters
from mptc_gym.presets import IDS, PRESETS
from mptc_gym.vector_env import MiddlePointVectorEnv

__version__ = "0.2.0"
__all__ = [
    "IDS",
    "PRESETS",
    "Evaluation",
    "MiddlePointEnv",
    "MiddlePointVectorEnv",
    "Parameters",
    "__version__",
    "evaluate",
]

for _name, _id in IDS.items():
    gymnasium.register(
        id=_id,
        entry_point="mptc_gym.env:MiddlePointEnv",
        vector_entry_point="mptc_gym.vector_env:MiddlePointVectorEnv",
        max_episode_steps=1200,
        order_enforce=False,  # the environments check this themselves
        kwargs=PRESETS[_name],
    )
