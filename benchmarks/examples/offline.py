"""Learn from logged data on one page, in PyTorch alone: behaviour cloning.

First, `python -m benchmarks.datasets` writes the data. `python -m benchmarks.examples.offline`
then learns from one data set, without a plant, and evaluates the policies on episodes that are
not in the data. A score of 1 is the least possible mean error, 0 that without control.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import Any

import cyclopts
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

import mptc_gym

BATCH = 256  # samples per gradient step
LEARNING_RATE = 1e-3  # initial value; falls linearly to a tenth
LAST_ACTION = 6  # index in an observation, after three set points and three errors


class Actor(nn.Module):
    """A policy that moves the valve from where it is, by a network with two hidden layers."""

    def __init__(self, high: np.ndarray) -> None:
        super().__init__()
        # Temperatures over 5 degC, and actions: fixed factors are the same in evaluation.
        self.scale = torch.where(torch.as_tensor(high) > 1.0, 0.2, 1.0)
        layers = nn.Linear(len(high), 64), nn.ReLU(), nn.Linear(64, 64), nn.ReLU()
        self.layers = nn.Sequential(*layers, nn.Linear(64, 1))

    def forward(self, seen: Tensor) -> Tensor:
        """Return actions within [-1, 1], shape (n, 1)."""
        move: Tensor = self.layers(seen * self.scale)
        return (seen[:, LAST_ACTION, None] + move).clamp(-1.0, 1.0)


def clone(episodes: Iterable[Any], high: np.ndarray, *, steps: int, seed: int) -> Actor:
    """Train an actor to do what the controllers in Minari's episodes do.

    `high` are the upper bounds of the observation, shape (n_obs,).
    """
    torch.manual_seed(seed)
    pairs = [(each.observations[:-1], each.actions) for each in episodes]
    seen, taken = (torch.as_tensor(np.concatenate(each)) for each in zip(*pairs, strict=True))
    actor = Actor(high)
    optimizer = torch.optim.Adam(actor.parameters(), LEARNING_RATE)
    for step in range(steps):
        optimizer.param_groups[0]["lr"] = LEARNING_RATE * (1.0 - 0.9 * step / steps)
        batch = torch.randint(len(seen), (BATCH,))
        optimizer.zero_grad()
        functional.mse_loss(actor(seen[batch]), taken[batch]).backward()
        optimizer.step()
    return actor


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
        Number of policies.
    """
    try:
        import minari

        dataset: Any = minari.load_dataset(data)
    except ImportError:
        sys.exit('It needs Minari: pip install -e ".[data]"')
    except FileNotFoundError:
        sys.exit(f"--data: no {data}; python -m benchmarks.datasets writes it")
    about, high = dataset.storage.metadata, dataset.observation_space.high
    print(f"{data}: the data's own mean |e| {about['behaviour_error']:.3f} degC")
    for seed in range(seeds):
        actor = clone(dataset, high, steps=steps, seed=seed)
        episodes = len(about["evaluation_seeds"])
        found = mptc_gym.evaluate(actor, dataset.env_spec, episodes=episodes)
        print(f"behaviour cloning, seed {seed}: {found}", flush=True)


if __name__ == "__main__":
    cyclopts.run(main)
