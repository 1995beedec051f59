"""Train and score models of Stable-Baselines3 with many plants at once.

    plants = make_vec_env("MiddlePoint-v0", 64, seed=0, action="change",
                          compensated_dead_zone=5.0, action_window=20, setpoint="random")
    model = PPO("MlpPolicy", plants, n_steps=64).learn(200_000, ScoreCallback(folder="best"))

Requires `pip install "mptc_gym[sb3]"`.
"""

from mptc_gym.sb3.models import ScoreCallback, like
from mptc_gym.sb3.vec_env import GymnasiumVecEnv, make_vec_env

__all__ = ["GymnasiumVecEnv", "ScoreCallback", "like", "make_vec_env"]
