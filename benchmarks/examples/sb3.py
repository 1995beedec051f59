"""PPO of Stable-Baselines3, all its settings at their defaults, learns to control one plant.

`python benchmarks/examples/sb3.py` trains for 300,000 samples, which takes some minutes, and
prints the score of the policy on a square wave between +5 and -5 degC, which it has not met:
0 is a valve left alone, 1 the least possible error.

This is one file to copy. What makes it work:

- the action changes the flow (`IncrementalAction`), and the dead zone is undone on the way;
- the observation holds the past 20 actions, so nothing is hidden in the delay;
- set points are random, and the reward is the absolute error.
"""

from __future__ import annotations

import argparse
from typing import Any

import gymnasium
import torch
from stable_baselines3 import PPO

from mptc_gym import evaluate
from mptc_gym.wrappers import IncrementalAction

SET_POINTS = {"setpoint": "random", "setpoint_amplitude": 6.0}


def make_plant(**arguments: Any) -> gymnasium.Env[Any, Any]:
    """Make the plant as the policy sees it."""
    plant = gymnasium.make("MiddlePoint-v0", action_window=20, reward="absolute", **arguments)
    return IncrementalAction(plant, max_move=0.4, undo_dead_zone=True)


def main(arguments: list[str] | None = None) -> None:
    """Train, and print how good the policy is."""
    parser = argparse.ArgumentParser(description="PPO of Stable-Baselines3 on one plant.")
    parser.add_argument("--steps", type=int, default=300_000, help="samples of experience")
    parser.add_argument("--seed", type=int, default=0, help="of policy, exploration and plant")
    options = parser.parse_args(arguments)

    torch.set_num_threads(1)  # the networks are too small for more
    plant = make_plant(**SET_POINTS)
    model = PPO("MlpPolicy", plant, seed=options.seed, device="cpu")
    model.learn(options.steps)
    print(evaluate(model, make_plant))


if __name__ == "__main__":
    main()
