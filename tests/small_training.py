"""A training of PPO that takes a second."""

from benchmarks.train import ppo

SMALL = ppo.PPOArguments(
    seed=0, n_envs=4, n_steps=32, batch_size=64, n_epochs=2, steps=1024, starts=2
)
