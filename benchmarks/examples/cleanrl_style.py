"""PPO on one page, in PyTorch alone, on a batch of plants that are stepped at once.

`python -m benchmarks.examples.cleanrl_style` trains a policy and prints its mean absolute error
on the noise-free square wave, without exploration. Nothing is kept.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass, fields
from typing import Any, cast

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.distributions import Normal

import mptc_gym  # noqa: F401 (registers the environment)


@dataclass(frozen=True)
class Arguments:
    """What there is to set."""

    steps: int = 1_000_000
    """Samples of experience, all plants together."""
    seed: int = 0
    """Of the policy, the exploration and the set points."""
    num_envs: int = 64
    """Plants that are stepped at once."""
    num_steps: int = 64
    """Samples of each plant between two updates."""
    epochs: int = 5
    """How often an update goes through its samples."""
    minibatches: int = 16
    """Gradient steps of an epoch."""
    learning_rate: float = 1e-3
    """At the start; it falls linearly to a twentieth."""
    gamma: float = 0.95
    """Discount a sample."""
    gae_lambda: float = 1.0
    """Below 1, advantages lean on the value function."""
    clip: float = 0.2
    """How far an update may move the probability of an action."""
    value_weight: float = 0.5
    """Of the value function's loss."""
    max_gradient: float = 0.5
    """Norm that gradients are cut to."""
    first_log_std: float = -0.5
    """Logarithm of the exploration's spread at the start; of the action, from -1 to 1."""
    last_log_std: float = -2.0
    """The same at the end; it falls linearly."""
    evaluations: int = 10
    """How often the policy is measured."""


# With delay + 2 past actions the problem is Markov while the set point holds.
OBSERVATION: dict[str, Any] = {"action_window": 20, "output_window": 2}
# Returns of about 1 in size: the gradient of larger ones would crowd out that of the policy.
TRAINING: dict[str, Any] = {
    "setpoint": "random",
    "reward": "absolute",
    "error_scale": 50.0,
    **OBSERVATION,
}
DEGREES = 5.0  # what temperatures are divided by before they enter a network


class Agent(nn.Module):
    """A Gaussian policy and a value function."""

    scale: Tensor

    def __init__(self, space: gymnasium.spaces.Box) -> None:
        super().__init__()
        # Fixed factors are the same in training and in use, which running averages are not.
        temperatures = torch.as_tensor(space.high) > 1.0  # the others are past actions
        self.register_buffer("scale", torch.where(temperatures, 1.0 / DEGREES, 1.0))
        size = len(space.high)
        self.mean, self.value = network(size, last_gain=0.01), network(size, last_gain=1.0)

    def forward(self, observations: Tensor) -> tuple[Tensor, Tensor]:
        """Return the mean of the actions, shape (n, 1), and the values, shape (n,)."""
        scaled = observations * self.scale
        return self.mean(scaled), self.value(scaled).squeeze(-1)

    @torch.no_grad()
    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return actions without exploration, as a controller does."""
        actions: Tensor = self(torch.as_tensor(observation))[0]
        return cast("NDArray[np.float32]", actions.numpy())


def network(size: int, last_gain: float) -> nn.Sequential:
    """Return two hidden layers and one output; a small gain makes the first outputs small."""
    layers = nn.Linear(size, 64), nn.Linear(64, 64), nn.Linear(64, 1)
    for layer, gain in zip(layers, (2**0.5, 2**0.5, last_gain), strict=True):
        nn.init.orthogonal_(layer.weight, gain)
        nn.init.zeros_(layer.bias)
    first, second, last = layers
    return nn.Sequential(first, nn.Tanh(), second, nn.Tanh(), last)


def estimate(
    rewards: Tensor, values: Tensor, next_values: Tensor, ends: Tensor, arguments: Arguments
) -> Tensor:
    """Return generalised advantage estimates; all have the shape (num_steps, num_envs)."""
    advantages = torch.zeros_like(rewards)
    advantage = torch.zeros_like(rewards[0])
    for t in reversed(range(len(rewards))):
        surprise = rewards[t] + arguments.gamma * next_values[t] - values[t]
        # What was found later belongs to another episode if one has ended here.
        decay = arguments.gamma * arguments.gae_lambda * (1.0 - ends[t])
        advantages[t] = advantage = surprise + decay * advantage
    return advantages


def train(arguments: Arguments) -> Agent:
    """Train a policy and return it."""
    torch.manual_seed(arguments.seed)
    # In mode "SameStep" every step is one of the plant. In "NextStep" each episode would bring
    # one that only resets, whose action and reward mean nothing and would have to be masked.
    plants = gymnasium.make_vec(
        "MiddlePoint-v0", arguments.num_envs, autoreset_mode="SameStep", **TRAINING
    )
    agent = Agent(cast("gymnasium.spaces.Box", plants.single_observation_space))
    optimizer = torch.optim.Adam(agent.parameters(), eps=1e-5)
    shape = arguments.num_steps, arguments.num_envs
    observations = torch.zeros(*shape, len(agent.scale))
    actions = torch.zeros(*shape, 1)
    log_probs, values, next_values, rewards, ends = torch.zeros(5, *shape)
    batch = shape[0] * shape[1]
    updates = max(arguments.steps // batch, 1)
    shown = {updates * (i + 1) // arguments.evaluations for i in range(arguments.evaluations)}

    start = time.perf_counter()
    now = torch.as_tensor(plants.reset(seed=arguments.seed)[0])
    for update in range(1, updates + 1):
        left = 1.0 - (update - 1) / updates
        optimizer.param_groups[0]["lr"] = arguments.learning_rate * max(left, 0.05)
        fall = arguments.first_log_std - arguments.last_log_std
        spread = float(np.exp(arguments.last_log_std + left * fall))

        for t in range(arguments.num_steps):
            with torch.no_grad():
                mean, values[t] = agent(now)
            policy = Normal(mean, spread)
            observations[t], actions[t] = now, policy.sample()
            log_probs[t] = policy.log_prob(actions[t]).squeeze(-1)
            step = plants.step(actions[t].numpy())
            now, rewards[t] = torch.as_tensor(step[0]), torch.as_tensor(step[1])
            terminated, truncated = (torch.as_tensor(each) for each in step[2:4])
            ends[t] = terminated | truncated
            # What follows is worth what it is worth from the last observation of the episode;
            # the one returned at an end is already the first of the next episode.
            following = now.clone()
            for i in np.flatnonzero(ends[t]):
                following[i] = torch.as_tensor(step[4]["final_obs"][i])
            with torch.no_grad():
                next_values[t] = agent(following)[1] * ~terminated

        advantages = estimate(rewards, values, next_values, ends, arguments)
        returns = advantages + values
        kept = (observations, actions, log_probs, advantages, returns)
        flat = [each.flatten(0, 1) for each in kept]
        for _ in range(arguments.epochs):
            for rows in torch.randperm(batch).chunk(arguments.minibatches):
                seen, taken, before, gains, targets = (each[rows] for each in flat)
                mean, value = agent(seen)
                ratio = (Normal(mean, spread).log_prob(taken).squeeze(-1) - before).exp()
                gains = (gains - gains.mean()) / (gains.std() + 1e-8)
                clipped = ratio.clamp(1.0 - arguments.clip, 1.0 + arguments.clip)
                policy_loss = -torch.min(gains * ratio, gains * clipped).mean()
                value_loss = 0.5 * (value - targets).square().mean()
                optimizer.zero_grad()
                (policy_loss + arguments.value_weight * value_loss).backward()
                nn.utils.clip_grad_norm_(agent.parameters(), arguments.max_gradient)
                optimizer.step()

        if update in shown:
            seconds = time.perf_counter() - start
            print(
                f"{update * batch:9,} steps, {seconds:5.1f} s: mean |e| on the square wave "
                f"{square_error(agent):.3f} degC", flush=True,
            )  # fmt: skip
    return agent


def square_error(agent: Agent) -> float:
    """Return the mean |e| on the default square wave, degC."""
    plants = gymnasium.make_vec("MiddlePoint-v0", 1, max_episode_steps=1200, **OBSERVATION)
    observation, infos = plants.reset(seed=0)
    errors = []
    for _ in range(1200):
        errors.append(abs(float(infos["error"][0])))
        observation, *_, infos = plants.step(agent.act(observation))
    return float(np.mean(errors))


def main(arguments: list[str] | None = None) -> int:
    """Train with the arguments of a command line, without the program's name."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.examples.cleanrl_style",
        description=__doc__,
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    for field in fields(Arguments):
        name = f"--{field.name.replace('_', '-')}"
        # argparse shows a default beside a help text only, be it empty.
        parser.add_argument(name, type=type(field.default), default=field.default, help=" ")
    options: dict[str, Any] = vars(parser.parse_args(arguments))
    torch.set_num_threads(1)  # the networks are too small for more
    train(Arguments(**options))
    return 0


if __name__ == "__main__":
    sys.exit(main())
