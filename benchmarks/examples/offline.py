"""Learn from logged data on one page, in PyTorch alone: behaviour cloning and TD3+BC.

First, `python -m benchmarks.datasets` writes the data. `python -m benchmarks.examples.offline`
then learns from one data set, without a plant, and evaluates the policies on episodes that are
not in the data. A score of 1 is the least possible mean error, 0 that without control.
"""

from __future__ import annotations

import copy
import sys
from collections.abc import Iterable
from typing import Any

import cyclopts
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.utils.data import TensorDataset

import mptc_gym

BATCH = 256  # transitions per gradient step
LEARNING_RATE = 1e-3  # initial value; falls linearly to a tenth
GAMMA = 0.97  # discount per sample
TAU = 0.01  # update rate of the target networks
ALPHA = 0.05  # weight of the value relative to staying near the data
LAST_ACTION = 6  # index in an observation, after three set points and three errors


def transitions_of(episodes: Iterable[Any]) -> TensorDataset:
    """Return the observations, actions, rewards and next observations of a Minari data set.

    No episode terminates, so every transition is bootstrapped.
    """
    rows = [
        (each.observations[:-1], each.actions, each.rewards[:, None], each.observations[1:])
        for each in episodes
    ]
    columns = (np.concatenate(column) for column in zip(*rows, strict=True))
    return TensorDataset(*(torch.as_tensor(each, dtype=torch.float32) for each in columns))


class Network(nn.Module):
    """A network with two hidden layers; its inputs are temperatures over 5 degC and actions."""

    def __init__(self, high: np.ndarray) -> None:
        super().__init__()
        # Fixed factors are the same in training and evaluation.
        self.scale = torch.where(torch.as_tensor(high) > 1.0, 0.2, 1.0)
        layers = nn.Linear(len(high), 64), nn.ReLU(), nn.Linear(64, 64), nn.ReLU()
        self.layers = nn.Sequential(*layers, nn.Linear(64, 1))

    def forward(self, *columns: Tensor) -> Tensor:
        """Return one number per row, shape (n, 1)."""
        result: Tensor = self.layers(torch.hstack(columns) * self.scale)
        return result


class Actor(Network):
    """A policy whose output is an increment to the last action, like a valve's move."""

    def forward(self, *columns: Tensor) -> Tensor:
        """Return actions within [-1, 1], shape (n, 1)."""
        change = super().forward(*columns)
        return (columns[0][:, LAST_ACTION, None] + change).clamp(-1.0, 1.0)


def learn(
    data: TensorDataset, high: np.ndarray, *, alpha: float, steps: int, seed: int
) -> Actor:
    """Train an actor by TD3+BC (Fujimoto & Gu 2021), or by behaviour cloning if alpha is 0.

    `high` are the upper bounds of the observation, shape (n_obs,).
    """
    torch.manual_seed(seed)
    actor = Actor(high)
    critics = nn.ModuleList(Network(np.append(high, np.float32(1.0))) for _ in range(2))
    networks = nn.ModuleList([actor, critics])
    targets: Any = copy.deepcopy(networks).requires_grad_(False)
    target_actor, target_critics = targets
    optimizers = [torch.optim.Adam(each.parameters(), LEARNING_RATE) for each in networks]

    def descend(optimizer: torch.optim.Optimizer, loss: Any) -> None:
        optimizer.param_groups[0]["lr"] = LEARNING_RATE * (0.1 + 0.9 * (1.0 - step / steps))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    for step in range(steps):
        seen, taken, rewards, following = data[torch.randint(len(data), (BATCH,))]
        if alpha > 0.0:
            noise = (torch.randn_like(taken) * 0.1).clamp(-0.25, 0.25)
            ahead = following, (target_actor(following) + noise).clamp(-1.0, 1.0)
            goal = rewards + GAMMA * torch.min(*(critic(*ahead) for critic in target_critics))
            losses = [functional.mse_loss(critic(seen, taken), goal) for critic in critics]
            descend(optimizers[1], sum(losses))
        if step % 2 == 0 or alpha == 0.0:  # the critics take two steps for one of the actor
            action = actor(seen)
            loss = functional.mse_loss(action, taken)
            if alpha > 0.0:
                value = critics[0](seen, action)
                loss = loss - alpha * value.mean() / value.abs().mean().detach()
            descend(optimizers[0], loss)
        with torch.no_grad():
            for target, each in zip(targets.parameters(), networks.parameters(), strict=True):
                target.lerp_(each, TAU)
    return actor


def policy_of(actor: Actor) -> Any:
    """Return the policy of an actor, a function of observations, for `mptc_gym.evaluate`."""
    return lambda observations: actor(torch.as_tensor(observations)).detach().numpy()


def main(
    *, data: str = "middlepoint/paper/smith-v0", steps: int = 3000, seeds: int = 5
) -> None:
    """Learn offline from a data set, and score the policies.

    Parameters
    ----------
    data
        Name of the data set.
    steps
        Number of gradient steps.
    seeds
        Number of runs of each learner.
    """
    try:
        import minari

        dataset: Any = minari.load_dataset(data)
    except ImportError:
        sys.exit('It needs Minari: pip install -e ".[data]"')
    except FileNotFoundError:
        sys.exit(f"--data: no {data}; python -m benchmarks.datasets writes it")
    about, high = dataset.storage.metadata, dataset.observation_space.high
    idle, least = about["idle_error"], about["least_possible_error"]
    own = f"the data's own mean |e| {about['behaviour_error']:.3f} degC"
    print(f"{data}: {own}, least possible {least:.3f}, idle {idle:.3f}")
    transitions, episodes = transitions_of(dataset), len(about["evaluation_seeds"])
    for name, alpha in (("behaviour cloning", 0.0), ("TD3+BC", ALPHA)):
        for seed in range(seeds):
            actor = learn(transitions, high, alpha=alpha, steps=steps, seed=seed)
            found = mptc_gym.evaluate(policy_of(actor), dataset.env_spec, episodes=episodes)
            print(f"{name}, seed {seed}: {found}", flush=True)


if __name__ == "__main__":
    cyclopts.run(main)
