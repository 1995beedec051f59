"""Train a recurrent policy through the plants of `hard`: a start for an entry of your own.

    python -m benchmarks.examples.recurrent             # three minutes, writes recurrent.pt
    python -m benchmarks.compare --presets --scenarios hard --agents mpc \
        --agent mine=benchmarks.examples.recurrent:make

The policy sees set points and errors alone. A gated recurrent unit has to find out what the
plant is. Its last layer moves the flow, and past flows are among its inputs.
"""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from mptc_gym import IDS, PRESETS, evaluate
from mptc_gym.evaluation import VALIDATION_SEED
from mptc_gym.torch_env import MiddlePointTorchEnv

FILE = Path("recurrent.pt")
SAMPLES = 1200  # of an episode
SEGMENT = 150  # samples that gradients reach back; a flow shows after up to 25
TEMPERATURE = 5.0  # degC, which inputs are divided by
LARGEST_MOVE = 0.4  # of half the actuator's range, per sample
MEMORY = 26  # samples: flows that may be on their way to the output


class Recurrent(nn.Module):
    """The policy of n loops with its state: from set points and errors to actions."""

    def __init__(self, nodes: int = 64) -> None:
        super().__init__()
        self.cell = nn.GRUCell(2 + MEMORY, nodes)
        self.output = nn.Linear(nodes + 2 + MEMORY, 1)
        self.begin(1)

    def begin(self, n: int) -> None:
        """Forget the episode, and begin those of n plants at rest."""
        self.state = torch.zeros(n, self.cell.hidden_size)
        self.actions = torch.zeros(n, MEMORY)  # newest first

    def detach(self) -> None:
        """Cut the graph that leads to earlier samples."""
        self.state = self.state.detach()
        self.actions = self.actions.detach()

    def forward(self, setpoint: Tensor, error: Tensor) -> Tensor:
        """Return actions, shape (n, 1), for set points and errors of a sample, degC, (n,)."""
        measured = torch.stack([setpoint, error], dim=1) / TEMPERATURE
        inputs = torch.cat([measured, self.actions], dim=1)
        self.state = self.cell(inputs, self.state)
        move = torch.tanh(self.output(torch.cat([self.state, inputs], dim=1)))
        action = (self.actions[:, :1] + LARGEST_MOVE * move).clamp(-1.0, 1.0)
        self.actions = torch.cat([action, self.actions[:, :-1]], dim=1)
        return action


class Policy:
    """The trained policy in the form that `evaluate` and `compare` take: `reset`, `act`."""

    def __init__(self, network: Recurrent) -> None:
        self._network = network
        self._begun = False

    def reset(self) -> None:
        """Forget the episode."""
        self._begun = False

    def act(self, observations: Any) -> np.ndarray[Any, Any]:
        """Return actions, shape (n, 1), for observations, (n, size)."""
        seen = torch.as_tensor(np.asarray(observations), dtype=torch.float32)
        if not self._begun:
            self._network.begin(len(seen))
            self._begun = True
        with torch.no_grad():
            actions = self._network(seen[:, 0], seen[:, seen.shape[1] // 2])
        array: np.ndarray[Any, Any] = actions.numpy()
        return array


def train(steps: int = 400, plants: int = 128, seed: int = 0) -> Recurrent:
    """Train by truncated backpropagation through the plants, and return the network."""
    torch.manual_seed(seed)
    network = Recurrent()
    optimiser = torch.optim.Adam(network.parameters())
    env = MiddlePointTorchEnv(
        plants, differentiable=True, setpoint_window=1, error_window=1, **PRESETS["hard"]
    )
    for step in range(steps):
        if step % (SAMPLES // SEGMENT) == 0:
            observations, _ = env.reset(seed=step)
            network.begin(plants)
        # What was before this segment is constant: plants, network and observation.
        env.detach()
        network.detach()
        observations = observations.detach()
        errors = []
        for _ in range(SEGMENT):
            actions = network(observations[:, 0], observations[:, 1])
            observations, _, _, _, infos = env.step(actions)
            errors.append(infos["error"])  # the true one; the observed one has noise
        loss = nn.functional.huber_loss(
            torch.stack(errors), torch.zeros(SEGMENT, plants), delta=0.1
        )
        optimiser.param_groups[0]["lr"] = 3e-3 * (1.0 - step / steps)
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 0.3)
        optimiser.step()
    return network


def make() -> Policy:
    """Return the saved policy, as `--agent NAME=MODULE:FACTORY` of `compare` calls it."""
    network = Recurrent()
    network.load_state_dict(torch.load(FILE, weights_only=True))
    return Policy(network)


if __name__ == "__main__":
    torch.set_num_threads(1)
    trained = train(*map(int, sys.argv[1:]))
    torch.save(trained.state_dict(), FILE)
    print(evaluate(make(), IDS["hard"], episodes=200, seed=VALIDATION_SEED))
