"""Control the middle-point temperature of a once-through boiler: a Gymnasium environment.

    env = gymnasium.make("mptc_gym:MiddlePointNoisy-v0")
    observation, info = env.reset(seed=0)
    observation, reward, terminated, truncated, info = env.step(env.action_space.sample())

Importing this package registers the ids `MiddlePoint-v0`, `MiddlePointDeadZone7-v0`,
`MiddlePointNoisy-v0`, `MiddlePointDisturbed-v0`, `MiddlePointFouling-v0`,
`MiddlePointRandomised-v0` and `MiddlePointHard-v0`. `PRESETS` holds the arguments of the
registered environments. `FOR_LEARNING` holds arguments for reinforcement learning. `evaluate`
scores a policy.
"""

import gymnasium

from mptc_gym.env import MiddlePointEnv
from mptc_gym.evaluation import Evaluation, evaluate
from mptc_gym.plant.parameters import EPISODE_STEPS, Parameters
from mptc_gym.presets import FOR_LEARNING, IDS, PRESETS
from mptc_gym.vector_env import MiddlePointVectorEnv

__version__ = "0.8.0"
__all__ = [
    "FOR_LEARNING",
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
        entry_point="mptc_gym.env:make_env",
        vector_entry_point="mptc_gym.vector_env:make_vector_env",
        max_episode_steps=EPISODE_STEPS,
        order_enforce=False,  # the environments check this themselves
        kwargs=PRESETS[_name],
    )
