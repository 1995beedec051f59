"""Train, score, save and load models of Stable-Baselines3 with many plants at once.

    plants = make_vec_env("MiddlePoint-v0", 64, seed=0, wrapper={"compensate_dead_zone": True},
                          action_window=20, setpoint="random")
    model = PPO("MlpPolicy", plants, n_steps=64).learn(200_000, ScoreCallback(path="best.zip"))

Requires `pip install "mptc_gym[sb3]"`.
"""

from mptc_gym.sb3.models import ScoreCallback, load, save, spec_of
from mptc_gym.sb3.vec_env import GymnasiumVecEnv, make_vec_env

__all__ = ["GymnasiumVecEnv", "ScoreCallback", "load", "make_vec_env", "save", "spec_of"]
