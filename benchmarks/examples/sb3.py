"""Train PPO of Stable-Baselines3 on many plants at once, and score the policy.

    pip install -e ".[sb3]"
    python benchmarks/examples/sb3.py

prints the score of the policy during the training, keeps the best policy in the folder `best`,
and scores it on two tasks. A score is 0 for a valve that never moves, and 1 for the
reference error. `benchmarks/train` has a training run with higher scores.
"""

import argparse

import torch
from stable_baselines3 import PPO

from mptc_gym import FOR_LEARNING, evaluate
from mptc_gym.sb3 import ScoreCallback, make_vec_env


def main() -> None:
    """Train a policy by PPO, save the best policy, and print its scores."""
    parser = argparse.ArgumentParser(description="PPO of Stable-Baselines3 on 64 plants.")
    parser.add_argument("--steps", type=int, default=300_000, help="samples of experience")
    steps = parser.parse_args().steps

    torch.set_num_threads(1)  # the networks are too small for more
    # Large moves reach a new set point soon. With a scale of 50 degC for errors, returns are of
    # order 1, and so the value function is learnt quickly.
    interface = {**FOR_LEARNING, "max_move": 1.0, "error_scale": 50.0}
    plants = make_vec_env("MiddlePointNoisy-v0", 64, **interface)
    model = PPO(
        "MlpPolicy",
        plants,
        n_steps=64,  # samples per plant between two updates of the policy
        batch_size=512,
        learning_rate=lambda remaining: 2e-3 * remaining,
        gamma=0.97,  # discount factor per sample
        gae_lambda=1.0,
        policy_kwargs={"log_std_init": -2.0},  # a small random part of the actions
        seed=0,
        device="cpu",
    )
    model.learn(steps, ScoreCallback("MiddlePointNoisy-v0", every=50_000, folder="best"))
    best = PPO.load("best/best_model.zip", env=plants, device="cpu")
    for env in ("MiddlePoint-v0", "MiddlePointNoisy-v0"):
        print(evaluate(best, env))


if __name__ == "__main__":
    main()
