"""PPO on one page, in PyTorch alone, whose experience never leaves the device.

`python -m benchmarks.examples.ppo_torch --device cuda` trains a policy on plants in PyTorch and
prints its mean absolute error on the noise-free square wave, without exploration. With
`--numpy`, the plants are those in NumPy and all they return is carried over, for comparison;
`--times` only prints how long two updates take with both, for 64, 1,024 and 16,384 plants.
Nothing is kept.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, fields
from typing import Any

import gymnasium
import torch
from torch import Tensor, nn
from torch.distributions import Normal

from mptc_gym.torch_env import MiddlePointTorchEnv

# With delay + 2 past actions the problem is Markov while the set point holds.
OBSERVATION: dict[str, Any] = {"action_window": 20, "output_window": 2}
# Returns of about 1 in size: the gradient of larger ones would crowd out that of the policy.
TRAINING = {"setpoint": "random", "reward": "absolute", "error_scale": 50.0, **OBSERVATION}
DEGREES = 5.0  # what temperatures are divided by before they enter a network
SIZES = (64, 1024, 16384)  # plants, of `--times`


@dataclass(frozen=True)
class Arguments:
    """What there is to set."""

    steps: int = 1_000_000
    """Samples of experience, all plants together."""
    seed: int = 0
    """Of the policy, the exploration and the set points."""
    device: str = "cpu"
    """Where everything is computed."""
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
    max_gradient: float = 0.5
    """Norm that gradients are cut to."""
    first_log_std: float = -0.5
    """Logarithm of the exploration's spread at the start; of the action, from -1 to 1."""
    last_log_std: float = -2.0
    """The same at the end; it falls linearly."""


class Carried:
    """The plants in NumPy; what they take and return is carried from and to a device."""

    def __init__(self, num_envs: int, device: str, **arguments: Any) -> None:
        self._plants = gymnasium.make_vec("MiddlePoint-v0", num_envs, **arguments)
        self.single_observation_space = self._plants.single_observation_space
        self._device = device

    def reset(self, *, seed: int) -> tuple[Tensor, dict[str, Any]]:
        """Start episodes of all plants."""
        return self._to_device(self._plants.reset(seed=seed)[0]), {}

    def step(self, actions: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        """Step all plants; infos hold `final_obs` as those of the plants in PyTorch do."""
        observations, *others, infos = self._plants.step(actions.cpu().numpy())
        now = self._to_device(observations)
        told = {}
        if "final_obs" in infos:
            last = observations.copy()
            for i in infos["_final_obs"].nonzero()[0]:
                last[i] = infos["final_obs"][i]
            told["final_obs"] = self._to_device(last)
        rewards, terminated, truncated = map(self._to_device, others)
        return now, rewards.float(), terminated, truncated, told

    def _to_device(self, array: Any) -> Tensor:
        return torch.as_tensor(array, device=self._device)


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


def network(size: int, last_gain: float) -> nn.Sequential:
    """Return two hidden layers and one output; a small gain makes the first outputs small."""
    layers = nn.Linear(size, 64), nn.Linear(64, 64), nn.Linear(64, 1)
    for layer, gain in zip(layers, (2**0.5, 2**0.5, last_gain), strict=True):
        nn.init.orthogonal_(layer.weight, gain)
        nn.init.zeros_(layer.bias)
    first, second, last = layers
    return nn.Sequential(first, nn.Tanh(), second, nn.Tanh(), last)


def train(arguments: Arguments, *, numpy: bool = False) -> tuple[Agent, float, float]:
    """Train a policy, and return it, and the seconds of collecting and of learning."""
    torch.manual_seed(arguments.seed)
    device, n = arguments.device, arguments.num_envs
    # In mode "SameStep" every step is one of the plant. In "NextStep" each episode would bring
    # one that only resets, whose action and reward mean nothing and would have to be masked.
    made = Carried if numpy else MiddlePointTorchEnv
    plants: Any = made(n, device=device, autoreset_mode="SameStep", **TRAINING)
    agent = Agent(plants.single_observation_space).to(device)
    optimizer = torch.optim.Adam(agent.parameters(), eps=1e-5)
    shape = arguments.num_steps, n
    observations = torch.zeros(*shape, len(agent.scale), device=device)
    actions = torch.zeros(*shape, 1, device=device)
    log_probs, values, next_values, rewards, ends = torch.zeros(5, *shape, device=device)
    batch = shape[0] * shape[1]
    updates = max(arguments.steps // batch, 1)
    collecting = learning = 0.0

    now, _ = plants.reset(seed=arguments.seed)
    for update in range(updates):
        left = 1.0 - update / updates
        optimizer.param_groups[0]["lr"] = arguments.learning_rate * max(left, 0.05)
        fall = arguments.first_log_std - arguments.last_log_std
        spread = float(torch.tensor(arguments.last_log_std + left * fall).exp())

        began = seconds(device)
        with torch.no_grad():
            for t in range(arguments.num_steps):
                mean, values[t] = agent(now)
                policy = Normal(mean, spread)
                observations[t], actions[t] = now, policy.sample()
                log_probs[t] = policy.log_prob(actions[t]).squeeze(-1)
                now, rewards[t], terminated, truncated, infos = plants.step(actions[t])
                ends[t] = terminated | truncated
                # What follows is worth what it is worth from the last observation of the
                # episode; the one returned at an end is already the first of the next.
                following = now
                if "final_obs" in infos:
                    following = torch.where(ends[t, :, None] > 0, infos["final_obs"], now)
                next_values[t] = agent(following)[1] * ~terminated

        advantages = torch.zeros_like(rewards)
        advantage = torch.zeros_like(rewards[0])
        for t in reversed(range(arguments.num_steps)):
            surprise = rewards[t] + arguments.gamma * next_values[t] - values[t]
            # What was found later belongs to another episode if one has ended here.
            decay = arguments.gamma * arguments.gae_lambda * (1.0 - ends[t])
            advantages[t] = advantage = surprise + decay * advantage
        collecting += seconds(device) - began

        began = seconds(device)
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
                value_loss = 0.25 * (value - targets).square().mean()
                optimizer.zero_grad()
                (policy_loss + value_loss).backward()
                nn.utils.clip_grad_norm_(agent.parameters(), arguments.max_gradient)
                optimizer.step()
        learning += seconds(device) - began
    return agent, collecting, learning


def seconds(device: str) -> float:
    """Return the time at which a device has done all that it was asked for."""
    if device != "cpu":
        torch.accelerator.synchronize()
    return time.perf_counter()


@torch.no_grad()
def square_error(agent: Agent, device: str) -> float:
    """Return the mean |e| on the default square wave, degC."""
    plants = MiddlePointTorchEnv(1, device=device, **OBSERVATION)
    observation, _ = plants.reset(seed=0)
    errors = []
    for _ in range(1200):
        observation, *_, infos = plants.step(agent(observation)[0])
        errors.append(infos["error"].abs())
    return float(torch.cat(errors).mean())


def main(arguments: list[str] | None = None) -> None:
    """Train with the arguments of a command line, without the program's name."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    for field in fields(Arguments):
        name = f"--{field.name.replace('_', '-')}"
        parser.add_argument(name, type=type(field.default), default=field.default)
    parser.add_argument("--numpy", action="store_true", help="plants in NumPy")
    parser.add_argument("--times", action="store_true", help="how long both take")
    options = vars(parser.parse_args(arguments))
    numpy, times = options.pop("numpy"), options.pop("times")
    if options["device"] == "cpu":
        torch.set_num_threads(1)  # the networks are too small for more
    for n in SIZES if times else (options["num_envs"],):
        # Two updates show how long it takes, and teach nothing.
        changed = {"num_envs": n, "steps": 2 * n * options["num_steps"]} if times else {}
        chosen = Arguments(**{**options, **changed})
        for in_numpy in (False, True) if times else (numpy,):
            agent, collecting, learning = train(chosen, numpy=in_numpy)
            line = (
                f"{n:6,} plants in {'NumPy' if in_numpy else 'PyTorch':7}: collecting "
                f"{collecting:6.2f} s, learning {learning:6.2f} s"
            )
            if not times:
                error = square_error(agent, chosen.device)
                line += f", mean |e| on the square wave {error:.3f} degC"
            print(line, flush=True)


if __name__ == "__main__":
    main()
