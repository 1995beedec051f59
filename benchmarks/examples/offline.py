"""Offline learning on one page, in PyTorch alone: behaviour cloning and TD3+BC.

`python -m benchmarks.datasets` writes the data first. `python -m benchmarks.examples.offline`
then learns from one data set, without a plant, and runs what it has learnt on episodes that are
not in the data. A score of 1 is the least possible mean error, 0 that of an idle valve.
"""

from __future__ import annotations

import argparse
import copy
import sys
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

import mptc_gym

LAST_ACTION = 6  # its place in an observation: after three set points and three errors


@dataclass(frozen=True)
class Arguments:
    """What there is to set."""

    steps: int = 3000
    """Gradient steps."""
    batch: int = 256
    """Transitions a step."""
    width: int = 64
    """Nodes of each of two hidden layers."""
    learning_rate: float = 1e-3
    """At the start; it falls linearly to a tenth."""
    gamma: float = 0.97
    """Discount a sample."""
    tau: float = 0.01
    """Share by which target networks follow in a step."""
    alpha: float = 0.05
    """Weight of the value against that of staying near the data; 0 is behaviour cloning."""
    smoothing: float = 0.1
    """Spread of the noise on target actions."""
    clip: float = 0.25
    """Its limit."""
    delay: int = 2
    """Steps of the critics for each of the actor."""


@dataclass(frozen=True)
class Transitions:
    """All transitions of a data set; the first axis counts them."""

    observations: Tensor
    actions: Tensor
    rewards: Tensor
    following: Tensor
    """The next observations. No episode terminates, so that all have a future."""

    @classmethod
    def of(cls, dataset: Any) -> Transitions:
        """Read those of a Minari data set."""
        episodes = list(dataset)
        arrays = (
            [each.observations[:-1] for each in episodes],
            [each.actions for each in episodes],
            [each.rewards.astype(np.float32) for each in episodes],
            [each.observations[1:] for each in episodes],
        )
        return cls(*(torch.as_tensor(np.concatenate(each)) for each in arrays))


class Network(nn.Module):
    """Two hidden layers over temperatures in units of 5 degC and actions as they are."""

    scale: Tensor

    def __init__(self, high: np.ndarray, width: int) -> None:
        super().__init__()
        # Fixed factors are the same in training and in use.
        bounds = torch.as_tensor(high)
        self.register_buffer("scale", torch.where(bounds > 1.0, 0.2, 1.0))
        layers = [nn.Linear(len(high), width), nn.ReLU(), nn.Linear(width, width), nn.ReLU()]
        self.layers = nn.Sequential(*layers, nn.Linear(width, 1))

    def forward(self, values: Tensor) -> Tensor:
        """Return one number a row, shape (n, 1)."""
        result: Tensor = self.layers(values * self.scale)
        return result


class Actor(Network):
    """A policy that changes the last action, as a valve's position is changed."""

    def act(self, observations: Tensor) -> Tensor:
        """Return actions within [-1, 1], shape (n, 1)."""
        last = observations[:, LAST_ACTION, None]
        changed: Tensor = last + self(observations)
        return changed.clamp(-1.0, 1.0)


def learn(data: Transitions, high: np.ndarray, arguments: Arguments, seed: int) -> Actor:
    """Return an actor: TD3+BC (Fujimoto & Gu 2021), or behaviour cloning if alpha is 0.

    Parameters
    ----------
    data
        All that it sees.
    high
        Upper bounds of the observation, shape (n_obs,).
    arguments
        Settings.
    seed
        Of the weights, the batches and the noise.
    """
    torch.manual_seed(seed)
    actor = Actor(high, arguments.width)
    with_action = np.append(high, np.float32(1.0))
    critics = nn.ModuleList(Network(with_action, arguments.width) for _ in range(2))
    target_actor = copy.deepcopy(actor).requires_grad_(False)
    target_critics = copy.deepcopy(critics).requires_grad_(False)
    optimizers = [
        torch.optim.Adam(module.parameters(), arguments.learning_rate)
        for module in (actor, critics)
    ]
    for step in range(arguments.steps):
        for optimizer in optimizers:
            left = 1.0 - step / arguments.steps
            optimizer.param_groups[0]["lr"] = arguments.learning_rate * (0.1 + 0.9 * left)
        rows = torch.randint(len(data.rewards), (arguments.batch,))
        seen, taken, following = (
            each[rows] for each in (data.observations, data.actions, data.following)
        )
        if arguments.alpha > 0.0:
            noise = (torch.randn_like(taken) * arguments.smoothing).clamp(
                -arguments.clip, arguments.clip
            )
            next_action = (target_actor.act(following) + noise).clamp(-1.0, 1.0)
            ahead = torch.hstack((following, next_action))
            worth = torch.min(*(critic(ahead) for critic in target_critics))
            goal = data.rewards[rows, None] + arguments.gamma * worth
            now = torch.hstack((seen, taken))
            _descend(optimizers[1], sum(functional.mse_loss(c(now), goal) for c in critics))
        if step % arguments.delay == 0 or arguments.alpha == 0.0:
            action = actor.act(seen)
            loss = functional.mse_loss(action, taken)
            if arguments.alpha > 0.0:
                value = critics[0](torch.hstack((seen, action)))
                loss = loss - arguments.alpha * value.mean() / value.abs().mean().detach()
            _descend(optimizers[0], loss)
        with torch.no_grad():
            for followers, leaders in zip(
                (target_actor, target_critics), (actor, critics), strict=True
            ):
                pairs = zip(followers.parameters(), leaders.parameters(), strict=True)
                for follower, leader in pairs:
                    follower.lerp_(leader, arguments.tau)
    return actor


def _descend(optimizer: torch.optim.Optimizer, loss: Any) -> None:
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()


def policy_of(actor: Actor) -> Any:
    """Return an actor as a function of observations, for `mptc_gym.evaluate`."""
    return lambda observations: actor.act(torch.as_tensor(observations)).detach().numpy()


def main(arguments: list[str] | None = None) -> int:
    """Learn with the options of a command line, without the program's name."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.examples.offline",
        description=__doc__,
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--data", default="middlepoint/paper/smith-v0", help="data set")
    parser.add_argument("--steps", type=int, default=Arguments.steps, help="gradient steps")
    parser.add_argument("--seeds", type=int, default=5, help="how many runs of each learner")
    options = parser.parse_args(arguments)
    try:
        import minari

        dataset = minari.load_dataset(options.data)
    except ImportError:
        parser.error('it needs Minari: pip install -e ".[data]"')
    except FileNotFoundError:
        parser.error(f"--data: no {options.data}; python -m benchmarks.datasets writes it")
    about = dataset.storage.metadata
    idle, least = about["idle_error"], about["least_possible_error"]
    data, high = Transitions.of(dataset), dataset.observation_space.high
    own = f"the data's own mean |e| {about['behaviour_error']:.3f} degC"
    print(f"{options.data}: {own}, least possible {least:.3f}, idle {idle:.3f}")
    for name, alpha in (("behaviour cloning", 0.0), ("TD3+BC", Arguments.alpha)):
        settings = Arguments(steps=options.steps, alpha=alpha)
        for seed in range(options.seeds):
            policy = policy_of(learn(data, high, settings, seed))
            episodes = len(about["evaluation_seeds"])
            found = mptc_gym.evaluate(policy, dataset.env_spec, episodes=episodes)
            print(f"{name}, seed {seed}: {found}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
