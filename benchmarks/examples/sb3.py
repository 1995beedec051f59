"""Train PPO of Stable-Baselines3 to control the plant, in a quarter of a minute on one core.

`python benchmarks/examples/sb3.py` trains a policy, saves it in `ppo-0.zip`, and prints its
score on an unseen square wave: 0 is a valve left alone, 1 the least possible error.

Copy this one file. It works for these reasons:

- 64 plants are stepped at once, with random set points; the reward is the absolute error.
- The action changes the flow (`IncrementalAction`), which also compensates the dead zone.
- The policy sees errors and changes of the flow, not its level, and has no biases. It is thus
  at rest only where the error is 0 and nothing moves, and has no offset to unlearn.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import torch
from gymnasium.spaces import Box
from stable_baselines3 import PPO
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor, nn

from mptc_gym import evaluate
from mptc_gym.sb3 import make_vec_env, save

SETPOINTS, ERRORS, ACTIONS = 3, 3, 20  # windows of the observation; actions: the delay plus two


class Moves(BaseFeaturesExtractor):
    """Extract the error, its changes and the moves of the flow, newest first."""

    def __init__(self, space: Box) -> None:
        super().__init__(space, features_dim=ERRORS + ACTIONS - 1)

    def forward(self, observations: Tensor) -> Tensor:
        """Return the inputs of the networks, of order 1."""
        _, errors, actions = observations.split([SETPOINTS, ERRORS, ACTIONS], dim=1)
        return torch.cat([errors[:, :1], -0.5 * errors.diff(), -2.0 * actions.diff()], dim=1)


def make_model(seed: int) -> PPO:
    """Return an untrained model."""
    plants = make_vec_env(
        "MiddlePoint-v0",
        64,
        wrapper={"max_move": 1.0, "compensate_dead_zone": True},
        setpoint_window=SETPOINTS,
        error_window=ERRORS,
        action_window=ACTIONS,
        setpoint="random",
        setpoint_amplitude=6.0,
        reward="absolute",
        error_scale=50.0,  # for returns of order 1, which are learnt quickly
    )
    model = PPO(
        "MlpPolicy",
        plants,
        n_steps=64,
        batch_size=512,
        learning_rate=lambda left: 2e-3 * max(left, 0.05),
        gamma=0.97,
        gae_lambda=1.0,
        policy_kwargs={"features_extractor_class": Moves, "log_std_init": -2.0},
        seed=seed,
        device="cpu",
    )
    for layer in (*model.policy.mlp_extractor.policy_net, model.policy.action_net):
        if isinstance(layer, nn.Linear):
            nn.init.zeros_(layer.bias)
            layer.bias.requires_grad_(False)
    return model


def main(arguments: list[str] | None = None) -> None:
    """Train a policy, save it and print its score."""
    parser = argparse.ArgumentParser(description="PPO of Stable-Baselines3 on 64 plants.")
    parser.add_argument("--steps", type=int, default=200_000, help="samples of experience")
    parser.add_argument("--seed", type=int, default=0, help="of policy, exploration and plants")
    parser.add_argument("--out", type=Path, default=Path(), help="folder of the policy")
    options = parser.parse_args(arguments)

    torch.set_num_threads(1)  # the networks are too small for more
    began = time.process_time()
    model = make_model(options.seed).learn(options.steps)
    seconds = time.process_time() - began
    save(model, options.out / f"ppo-{options.seed}.zip")
    print(f"seed {options.seed}, {seconds:.0f} s: {evaluate(model)}")


if __name__ == "__main__":
    main()
