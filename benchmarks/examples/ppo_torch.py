"""Train PPO on one page, in PyTorch alone, on a batch of plants on any device.

`python -m benchmarks.examples.ppo_torch --device cuda` trains a policy and prints its score on
the noise-free square wave, without exploration. The plants are stepped on the device, so the
experience never leaves it. The policy is not saved.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Annotated, Any, cast

import gymnasium
import numpy as np
import torch
from cyclopts import App, Parameter
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.distributions import Normal

from mptc_gym import evaluate
from mptc_gym.torch_env import MiddlePointTorchEnv


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Training settings."""

    steps: int = 1_000_000
    """Total number of samples, over all plants."""
    seed: int = 0
    """Seed of the policy, the exploration and the set points."""
    device: str = "cpu"
    """Device of the plants and the policy: cpu or cuda."""
    num_envs: int = 64
    """Number of plants stepped at once."""
    num_steps: int = 64
    """Samples of each plant between two updates."""
    epochs: int = 5
    """Passes through the samples in an update."""
    minibatches: int = 16
    """Gradient steps in a pass."""
    learning_rate: float = 1e-3
    """Initial learning rate; it falls linearly to a twentieth."""
    gamma: float = 0.95
    """Discount per sample."""
    gae_lambda: float = 1.0
    """Lambda of the advantage estimates; below 1, they rely on the value function."""
    clip: float = 0.2
    """Limit on the relative change of an action's probability in an update."""
    value_weight: float = 0.5
    """Weight of the value function's loss."""
    max_gradient: float = 0.5
    """Norm to which gradients are clipped."""
    first_log_std: float = -0.5
    """Initial log standard deviation of the exploration; actions are within -1 and 1."""
    last_log_std: float = -2.0
    """Final log standard deviation; it falls linearly."""
    evaluations: int = 10
    """Number of evaluations during training."""


DEFAULTS = Arguments()
# With delay + 2 past actions the problem is Markov while the set point is constant.
OBSERVATION: dict[str, Any] = {"action_window": 20, "output_window": 2}
# Returns are of order 1: the gradient of larger ones would swamp that of the policy.
TRAINING = {"setpoint": "random", "reward": "absolute", "error_scale": 50.0, **OBSERVATION}
DEGREES = 5.0  # divisor of temperatures at the inputs of the networks
app = App(help=__doc__, version_flags=(), result_action="return_value")


class ActorCritic(nn.Module):
    """A Gaussian policy and a value function."""

    scale: Tensor

    def __init__(self, space: gymnasium.spaces.Box) -> None:
        super().__init__()
        # Unlike running averages, fixed factors are the same in training and evaluation.
        temperatures = torch.as_tensor(space.high) > 1.0  # the others are past actions
        self.register_buffer("scale", torch.where(temperatures, 1.0 / DEGREES, 1.0))
        size = len(space.high)
        self.mean, self.value = network(size, last_gain=0.01), network(size, last_gain=1.0)

    def forward(self, observations: Tensor) -> tuple[Tensor, Tensor]:
        """Return the mean of the actions, shape (n, 1), and the values, shape (n,)."""
        scaled = observations * self.scale
        return self.mean(scaled), self.value(scaled).squeeze(-1)

    @torch.no_grad()
    def act(self, observations: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return actions without exploration, shape (n, 1)."""
        mean: Tensor = self(torch.as_tensor(observations, device=self.scale.device))[0]
        return cast("NDArray[np.float32]", mean.cpu().numpy())


def network(size: int, last_gain: float) -> nn.Sequential:
    """Return two hidden layers and one output; a small gain makes the initial outputs small."""
    layers = nn.Linear(size, 64), nn.Linear(64, 64), nn.Linear(64, 1)
    for layer, gain in zip(layers, (2**0.5, 2**0.5, last_gain), strict=True):
        nn.init.orthogonal_(layer.weight, gain)
        nn.init.zeros_(layer.bias)
    first, second, last = layers
    return nn.Sequential(first, nn.Tanh(), second, nn.Tanh(), last)


def estimate(
    rewards: Tensor, values: Tensor, next_values: Tensor, ends: Tensor, arguments: Arguments
) -> Tensor:
    """Return generalised advantage estimates; all arrays have shape (num_steps, num_envs)."""
    advantages = torch.zeros_like(rewards)
    advantage = torch.zeros_like(rewards[0])
    for t in reversed(range(len(rewards))):
        surprise = rewards[t] + arguments.gamma * next_values[t] - values[t]
        # After the end of an episode, later advantages belong to the next one.
        decay = arguments.gamma * arguments.gae_lambda * (1.0 - ends[t])
        advantages[t] = advantage = surprise + decay * advantage
    return advantages


@app.default
def train(arguments: Annotated[Arguments, Parameter(name="*")] = DEFAULTS) -> ActorCritic:
    """Train a policy and return it."""
    torch.manual_seed(arguments.seed)
    device = arguments.device
    if device == "cpu":
        torch.set_num_threads(1)  # the networks are too small for more
    # In mode "SameStep" every step is a step of the plant. "NextStep" would add one per episode
    # that only resets, whose action and reward are meaningless and would have to be masked.
    plants = MiddlePointTorchEnv(
        arguments.num_envs, device=device, autoreset_mode="SameStep", **TRAINING
    )
    agent = ActorCritic(cast("gymnasium.spaces.Box", plants.single_observation_space)).to(
        device
    )
    optimizer = torch.optim.Adam(agent.parameters(), eps=1e-5)
    shape = arguments.num_steps, arguments.num_envs
    observations = torch.zeros(*shape, len(agent.scale), device=device)
    actions = torch.zeros(*shape, 1, device=device)
    log_probs, values, next_values, rewards, ends = torch.zeros(5, *shape, device=device)
    batch = shape[0] * shape[1]
    updates = max(arguments.steps // batch, 1)
    shown = {updates * (i + 1) // arguments.evaluations for i in range(arguments.evaluations)}

    start = time.perf_counter()
    now, _ = plants.reset(seed=arguments.seed)
    for update in range(1, updates + 1):
        left = 1.0 - (update - 1) / updates
        optimizer.param_groups[0]["lr"] = arguments.learning_rate * max(left, 0.05)
        fall = arguments.first_log_std - arguments.last_log_std
        spread = math.exp(arguments.last_log_std + left * fall)

        with torch.no_grad():
            for t in range(arguments.num_steps):
                mean, values[t] = agent(now)
                policy = Normal(mean, spread)
                observations[t], actions[t] = now, policy.sample()
                log_probs[t] = policy.log_prob(actions[t]).squeeze(-1)
                now, rewards[t], terminated, truncated, infos = plants.step(actions[t])
                ends[t] = terminated | truncated
                # Bootstrap from the last observation of an episode: the observation returned at
                # its end is already the first of the next episode.
                following = now
                if "final_obs" in infos:
                    following = torch.where(ends[t, :, None] > 0, infos["final_obs"], now)
                next_values[t] = agent(following)[1] * ~terminated

        advantages = estimate(rewards, values, next_values, ends, arguments)
        kept = (observations, actions, log_probs, advantages, advantages + values)
        flat = [each.flatten(0, 1) for each in kept]
        for _ in range(arguments.epochs):
            order = torch.randperm(batch, device=device)
            for rows in order.chunk(arguments.minibatches):
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
            seconds, found = time.perf_counter() - start, evaluate(agent.act, **OBSERVATION)
            print(f"{update * batch:11,} steps, {seconds:5.1f} s: {found}", flush=True)
    return agent


if __name__ == "__main__":
    app()
