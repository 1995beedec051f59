"""Train PPO of Stable-Baselines3 to control the plant, in a quarter of a minute on one core.

`python benchmarks/examples/sb3.py` trains a policy, saves the policy in `ppo.zip`, and prints
the policy's scores. A score is 0 for a valve that never moves, and 1 for the reference
error.

Four choices make the training of PPO fast:

- **Groups.** The eight plants of a group have the same noise and set points, and differ only in
  the random part of their actions. From the advantage of each plant, the mean advantage of the
  plant's group is subtracted, which makes the variance of the advantages much smaller.

- **Changes as inputs.** The policy's inputs are the error, and the changes of set point,
  temperature and flow, but not the values of set point, temperature and flow. The policy
  network has no biases, so the policy keeps the flow constant only if the error is 0: there is
  no steady-state error. A policy without the temperature as an input behaves in the same way at
  temperatures of -5 degC and +5 degC.

- **Less and less exploration.** The standard deviation of the actions falls by a schedule,
  because a standard deviation that PPO learns remains too high.

- **Changes of the flow as actions.** With `action="change"`, an action is a change of the flow,
  and the commands skip the dead zone of the valve.
"""

import argparse
from collections.abc import Mapping
from typing import Any, cast

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor, nn

from mptc_gym import evaluate
from mptc_gym.sb3 import make_vec_env

GROUP = 8  # number of plants that have the same noise and set points
# Arguments of the class `PPO`.
SETTINGS: dict[str, Any] = {
    "n_steps": 64,  # samples per plant between two updates of the policy
    "batch_size": 4096,
    "n_epochs": 5,
    "gamma": 0.96,  # discount factor per sample
    # With a lambda below 1, advantages would depend on how well the value function predicts the
    # rewards after the delay.
    "gae_lambda": 1.0,
}
# Arguments of the environment that determine the observation.
WINDOWS = {"setpoint_window": 3, "error_window": 1, "output_window": 64, "action_window": 64}
PLANTS: dict[str, Any] = {
    "action": "change",
    "max_move": 2.0,
    "compensated_dead_zone": 5.0,
    "noise_variance": [0.0, 0.5],
    "setpoint": "random",
    "setpoint_amplitude": 6.0,
    "reward": "absolute",
    "error_scale": 50.0,  # for returns of order 1, which are learnt quickly
    **WINDOWS,
}


def inputs(observations: Tensor, windows: Mapping[str, int]) -> Tensor:
    """Return the networks' inputs: the error, and changes of set point, output and action.

    The inputs are of order 1, with a row for each row of `observations`. A row of
    `observations` holds the latest set points, errors, outputs and actions, each newest first.
    `windows` holds the numbers of set points, errors (one), outputs and actions in a row of
    `observations`.
    """
    setpoints, errors, outputs, actions = observations.split([*windows.values()], dim=1)
    scaled_changes = [
        0.2 * changes(setpoints, short_stretches=3),
        0.5 * changes(outputs, short_stretches=8),
        changes(actions, short_stretches=30),
    ]
    return torch.cat([errors, *scaled_changes], dim=1)


def changes(window: Tensor, short_stretches: int) -> Tensor:
    """Return changes of a signal between stretches of samples, shape (n, stretches - 1).

    `window` holds past samples of the signal for n plants, newest first, shape (n, length). A
    change is the mean over a stretch of samples minus the mean over the next older stretch. The
    newest `short_stretches` stretches have one sample each, older stretches have 2, 4, 8 and so
    on, and the oldest stretch has the remaining samples.
    """
    lengths = [1] * short_stretches
    while remaining := window.shape[1] - sum(lengths):
        lengths.append(min(2 * lengths[-1], remaining))
    means = [stretch.mean(dim=1) for stretch in window.split(lengths, dim=1)]
    return -torch.stack(means, dim=1).diff()  # `diff` is the older mean minus the newer mean


class Changes(BaseFeaturesExtractor):
    """A feature extractor that computes the inputs of policy network and value network."""

    def __init__(self, observation_space: Any) -> None:
        # The 49 inputs are 1 error, and 2, 12 and 34 changes of set point, output and action.
        super().__init__(observation_space, features_dim=49)

    def forward(self, observations: Tensor) -> Tensor:
        """Return the network inputs, shape (n, 49), for observations of shape (n, size)."""
        return inputs(observations, WINDOWS)


class GroupBuffer(RolloutBuffer):
    """A rollout buffer that subtracts from each advantage the mean advantage of a group."""

    def compute_returns_and_advantage(self, last_values: Tensor, dones: Any) -> None:
        """Compute returns, and advantages minus the mean advantage of a group of plants."""
        super().compute_returns_and_advantage(last_values, dones)
        # `groups` is a view of `self.advantages`, shape (samples, plants), and changes it.
        groups = self.advantages.reshape(self.buffer_size, -1, GROUP)
        groups -= groups.mean(axis=2, keepdims=True)


class Exploration(BaseCallback):
    """A callback that lowers the standard deviation of the actions during the training.

    The natural logarithm of the standard deviation of the actions changes linearly with the
    number of training steps so far.

    Parameters
    ----------
    first, last
        Natural logarithm of the standard deviation at the start and at the end of the training.
    """

    def __init__(self, first: float, last: float) -> None:
        super().__init__()
        self._first = first
        self._last = last

    def _on_step(self) -> bool:
        return True  # go on with the training

    def _on_rollout_start(self) -> None:
        progress = self.num_timesteps / self.locals["total_timesteps"]
        log_std = cast("nn.Parameter", self.model.policy.log_std)
        log_std.data.fill_(self._first + progress * (self._last - self._first))


def make_ppo(plants: VecEnv, seed: int, **policy_arguments: Any) -> PPO:
    """Return an untrained model of PPO whose policy network has no biases.

    `plants` are the training plants, in groups of `GROUP` plants with the same seed. The
    `policy_arguments` are items of the argument `policy_kwargs` of the class `PPO`.
    """
    model = PPO(
        "MlpPolicy",
        plants,
        # The learning rate falls with the share of the training that remains. At the last
        # update, this share is 0 or below, and the limit 0.05 keeps the learning rate above 0.
        learning_rate=lambda remaining: 2e-3 * max(remaining, 0.05),
        rollout_buffer_class=GroupBuffer,
        policy_kwargs=policy_arguments,
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
    """Train a policy by PPO, save the policy, and print the policy's scores."""
    parser = argparse.ArgumentParser(description="PPO of Stable-Baselines3 on 512 plants.")
    parser.add_argument("--steps", type=int, default=1_000_000, help="samples of experience")
    steps = parser.parse_args().steps

    torch.set_num_threads(1)  # the networks are too small for more
    # Each group of `GROUP` plants has the same noise and set points.
    plants = make_vec_env("MiddlePoint-v0", 512, group=GROUP, **PLANTS)
    layers = {"pi": [], "vf": [64, 64]}  # a linear policy; a value function of two layers
    # `Changes` converts an observation to the inputs of the networks.
    model = make_ppo(plants, seed=0, features_extractor_class=Changes, net_arch=layers)
    # The standard deviation of the actions falls from exp(-1.2) to exp(-4.0).
    model.learn(steps, Exploration(first=-1.2, last=-4.0))
    model.save("ppo.zip")
    for env in ("MiddlePoint-v0", "MiddlePointNoisy-v0"):
        print(evaluate(model, env))


if __name__ == "__main__":
    main()
