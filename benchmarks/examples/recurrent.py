"""Train a recurrent policy by gradients through the plants of `MiddlePointHard-v0`.

    pip install -e ".[compare,torch]"
    python -m benchmarks.examples.recurrent             # three minutes, writes recurrent.pt
    python -m benchmarks.compare --presets --scenarios hard --agents mpc \
        --agent mine=benchmarks.examples.recurrent:make

The plants of `MiddlePointHard-v0` (preset `hard`) differ between episodes. The policy observes
only the set point and the error, so the network's gated recurrent unit (GRU) has to identify
the plant from past samples. The network's output is a change of the flow, and past flows are
among the network's inputs. Expect a mean error of about 1.43 degC on the validation episodes.
"""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from mptc_gym import IDS, PRESETS, evaluate
from mptc_gym.evaluation import VALIDATION_SEED
from mptc_gym.plant.parameters import EPISODE_STEPS
from mptc_gym.torch_env import MiddlePointTorchEnv

FILE = Path("recurrent.pt")  # the file of the trained network
# Number of samples in a segment, over which gradients are computed. The delay is at most 24
# samples, so a segment contains most of the effect of most flows on the output.
SEGMENT = 150
TEMPERATURE = 5.0  # scale of temperatures, degC, for network inputs of order 1
LARGEST_MOVE = 0.4  # largest change of the action per sample; actions are in [-1, 1]
# Number of past actions among the network's inputs. Even with the longest delay, these actions
# include all flows that have not yet affected the output.
MEMORY = 26
NODES = 64  # nodes of the recurrent unit


class Recurrent(nn.Module):
    """A recurrent policy network for n plants, with a state and past actions of each plant."""

    def __init__(self) -> None:
        super().__init__()
        inputs = 2 + MEMORY  # set point, error and past actions
        self.cell = nn.GRUCell(inputs, NODES)
        self.output = nn.Linear(NODES + inputs, 1)
        self.reset()  # the first call of `act` begins an episode

    def begin(self, n: int) -> None:
        """Set the recurrent state and the past actions of n plants to 0."""
        self.state = torch.zeros(n, NODES)
        self.actions = torch.zeros(n, MEMORY)  # newest first
        self.has_begun = True

    def reset(self) -> None:
        """Let the next call of `act` begin a new episode."""
        self.has_begun = False

    def detach(self) -> None:
        """Cut the PyTorch graph, so that gradients do not flow back to earlier samples."""
        self.state = self.state.detach()
        self.actions = self.actions.detach()

    def forward(self, setpoint: Tensor, error: Tensor) -> Tensor:
        """Return the actions at one sample, shape (n, 1), and update the recurrent state.

        `setpoint` and `error` are the set points and the measured errors, degC, shape (n,).
        """
        measured = torch.stack([setpoint, error], dim=1) / TEMPERATURE
        inputs = torch.cat([measured, self.actions], dim=1)
        self.state = self.cell(inputs, self.state)
        move = torch.tanh(self.output(torch.cat([self.state, inputs], dim=1)))
        action = (self.actions[:, :1] + LARGEST_MOVE * move).clamp(-1.0, 1.0)
        self.actions = torch.cat([action, self.actions[:, :-1]], dim=1)
        return action

    def act(self, observations: Any) -> np.ndarray[Any, Any]:
        """Return the actions for observations of n plants at one sample, shape (n, 1).

        Each row of `observations`, shape (n, size), holds the latest set points and an equal
        number of latest errors, degC, each newest first.
        """
        signals = torch.as_tensor(np.asarray(observations), dtype=torch.float32)
        n, size = signals.shape
        if not self.has_begun:
            self.begin(n)
        with torch.no_grad():
            actions = self(setpoint=signals[:, 0], error=signals[:, size // 2])
        array: np.ndarray[Any, Any] = actions.numpy()
        return array


def train(steps: int = 400, plants: int = 128, seed: int = 0) -> Recurrent:
    """Return a policy network, trained by truncated backpropagation through the plants.

    `steps` is the number of optimiser steps, each with gradients over `SEGMENT` samples of
    `plants` plants, and `seed` is the seed of the network's initial weights.
    """
    torch.manual_seed(seed)
    network = Recurrent()
    optimiser = torch.optim.Adam(network.parameters())
    env = MiddlePointTorchEnv(
        plants, differentiable=True, setpoint_window=1, error_window=1, **PRESETS["hard"]
    )
    for step in range(steps):
        if step % (EPISODE_STEPS // SEGMENT) == 0:
            observations, _ = env.reset(seed=step)
            network.begin(plants)
        # Gradients do not flow back beyond the first sample of this segment.
        env.detach()
        network.detach()
        observations = observations.detach()
        errors = []
        for _ in range(SEGMENT):
            actions = network(observations[:, 0], observations[:, 1])
            observations, _, _, _, infos = env.step(actions)
            errors.append(infos["error"])  # the error without measurement noise
        loss = nn.functional.huber_loss(
            torch.stack(errors), torch.zeros(SEGMENT, plants), delta=0.1
        )
        optimiser.param_groups[0]["lr"] = 3e-3 * (1.0 - step / steps)
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 0.3)
        optimiser.step()
    return network


def make() -> Recurrent:
    """Return the trained policy from the file `recurrent.pt`.

    The command `benchmarks.compare` calls `make` for the option `--agent
    mine=benchmarks.examples.recurrent:make`.
    """
    network = Recurrent()
    network.load_state_dict(torch.load(FILE, weights_only=True))
    return network


if __name__ == "__main__":
    torch.set_num_threads(1)
    trained = train(*map(int, sys.argv[1:]))
    torch.save(trained.state_dict(), FILE)
    print(evaluate(make(), IDS["hard"], episodes=200, seed=VALIDATION_SEED))
