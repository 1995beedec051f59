"""Train PPO of Stable-Baselines3 to control the plant, in a quarter of a minute on one core.

`python benchmarks/examples/sb3.py` trains a policy, saves it in `ppo-0.zip`, and prints its
scores: 0 is a valve left alone, 1 the least possible error.

Copy this one file; `benchmarks/train/ppo.py` is built on it. The training works for these
reasons:

- **Groups.** Eight plants meet the same noise and set points, and differ only in the actions
  that they explore. Without the mean of the group, advantages have much less variance.
- **Changes.** The policy sees the error and changes, but no levels, and has no biases. The
  policy is at rest only where the error is 0, so it has no offset, and acts at -5 degC as at
  +5 degC.
- **Exploration that falls.** The standard deviation of the actions follows a schedule, as it
  stays high if it is learnt.
- **Changes of the flow.** The action changes the flow (`IncrementalAction`, which also
  compensates the dead zone).
"""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor, nn

from mptc_gym import evaluate
from mptc_gym.sb3 import make_vec_env, save, spec_of

GROUP = 8  # plants that meet the same noise and set points
SETTINGS: dict[str, Any] = {
    "n_steps": 64,  # samples per plant between updates
    "batch_size": 4096,
    "n_epochs": 5,
    "gamma": 0.96,  # per sample
    # Below 1, the value function would also stand in for effects of actions that the delay
    # still holds back.
    "gae_lambda": 1.0,
}
WINDOWS = {"setpoint_window": 3, "error_window": 1, "output_window": 64, "action_window": 64}
PLANTS: dict[str, Any] = {
    "wrapper": {"max_move": 2.0, "compensate_dead_zone": True},
    "noise_variance": [0.0, 0.5],
    "setpoint": "random",
    "setpoint_amplitude": 6.0,
    "reward": "absolute",
    "error_scale": 50.0,  # for returns of order 1, which are learnt quickly
    **WINDOWS,
}


def inputs(observations: Tensor, windows: Mapping[str, int]) -> Tensor:
    """Return the error and the changes of set point, temperature and flow, of order 1.

    `observations` have the shape (n, size), with the `windows` of setpoints, errors, outputs
    and actions in this order, by length. There are n rows of inputs.
    """
    setpoints, errors, outputs, actions = observations.split([*windows.values()], dim=1)
    scaled_changes = [
        0.2 * changes(setpoints, 3),
        0.5 * changes(outputs, 8),
        changes(actions, 30),
    ]
    return torch.cat([errors, *scaled_changes], dim=1)


def changes(window: Tensor, single: int) -> Tensor:
    """Return the differences between means over stretches of a window, newest first.

    The window has the shape (n, length). The newest stretches have one sample each, and there
    are `single` of them; the older stretches have 2, 4, 8 and so on.
    """
    lengths = [1] * single
    while remaining := window.shape[1] - sum(lengths):
        lengths.append(min(2 * lengths[-1], remaining))
    means = [stretch.mean(1) for stretch in window.split(lengths, 1)]
    return -torch.stack(means, 1).diff()


class Changes(BaseFeaturesExtractor):
    """Extract the inputs of the networks: see `inputs`."""

    def __init__(self, space: Any) -> None:
        super().__init__(space, features_dim=49)

    def forward(self, observations: Tensor) -> Tensor:
        """Return the inputs, one row per observation, shape (n, 49)."""
        return inputs(observations, WINDOWS)


class GroupBuffer(RolloutBuffer):
    """Rollouts whose advantages are relative to the mean of a plant's group."""

    def compute_returns_and_advantage(self, last_values: Tensor, dones: Any) -> None:
        """Compute returns as usual, and advantages relative to those of the group."""
        super().compute_returns_and_advantage(last_values, dones)
        groups = self.advantages.reshape(self.buffer_size, -1, GROUP)
        groups -= groups.mean(axis=2, keepdims=True)


class Exploration(BaseCallback):
    """Move the logarithm of the actions' standard deviation from `first` to `last`.

    It changes in proportion to the samples of experience.
    """

    def __init__(self, first: float, last: float) -> None:
        super().__init__()
        self._first = first
        self._last = last

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        progress = self.num_timesteps / self.locals["total_timesteps"]
        log_std = cast("nn.Parameter", self.model.policy.log_std)
        log_std.data.fill_(self._first + progress * (self._last - self._first))


def make_ppo(plants: VecEnv, seed: int, **policy: Any) -> PPO:
    """Return an untrained model for these plants, whose policy has no biases.

    `policy` holds arguments of the policy's class.
    """
    model = PPO(
        "MlpPolicy",
        plants,
        # The learning rate falls with the share of the training that remains. At the last
        # update nothing remains; the lower bound lets this update have an effect.
        learning_rate=lambda remaining: 2e-3 * max(remaining, 0.05),
        rollout_buffer_class=GroupBuffer,
        policy_kwargs=policy,
        seed=seed,
        device="cpu",
        **SETTINGS,
    )
    for layer in (*model.policy.mlp_extractor.policy_net, model.policy.action_net):
        if isinstance(layer, nn.Linear):
            nn.init.zeros_(layer.bias)
            layer.bias.requires_grad_(False)
    return model


def main() -> None:
    """Train a policy, save it and print its scores."""
    parser = argparse.ArgumentParser(description="PPO of Stable-Baselines3 on 512 plants.")
    parser.add_argument("--steps", type=int, default=1_000_000, help="samples of experience")
    parser.add_argument("--seed", type=int, default=0, help="of policy, exploration and plants")
    parser.add_argument("--out", type=Path, default=Path(), help="folder of the policy")
    options = parser.parse_args()

    torch.set_num_threads(1)  # the networks are too small for more
    plants = make_vec_env("MiddlePoint-v0", 512, group=GROUP, **PLANTS)
    linear = {"pi": [], "vf": [64, 64]}  # the policy; the value function has two layers
    model = make_ppo(plants, options.seed, features_extractor_class=Changes, net_arch=linear)
    model.learn(options.steps, Exploration(-1.2, -4.0))
    save(model, options.out / f"ppo-{options.seed}.zip")
    for env in ("MiddlePoint-v0", "MiddlePointNoisy-v0"):
        print(evaluate(model, spec_of(model, env)))


if __name__ == "__main__":
    main()
