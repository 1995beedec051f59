"""Train a recurrent policy through the plants of `hard`: a start for an entry of your own.

    python -m benchmarks.examples.recurrent             # three minutes, writes recurrent.pt
    python -m benchmarks.compare --presets --scenarios hard --agents mpc \
        --agent mine=benchmarks.examples.recurrent:make

`hard` is the preset of `MiddlePointHard-v0`, with plants that differ between episodes. The
policy observes set point and error only, so a gated recurrent unit has to identify the plant.
The last layer of the network changes the flow, and past flows are among the network's inputs.
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

FILE = Path("recurrent.pt")  # the file of the trained network
SAMPLES = 1200  # length of an episode
# Samples that gradients reach back. A flow first shows in the output after up to 25 samples, so
# a segment contains most of a flow's effect.
SEGMENT = 150
TEMPERATURE = 5.0  # temperatures are divided by this, degC, to be of order 1
LARGEST_MOVE = 0.4  # largest change of the action per sample; half the actuator's range is 1
# Number of past actions among the inputs: enough for all flows that have not yet shown in the
# output, for the longest delay.
MEMORY = 26
NODES = 64  # nodes of the recurrent unit


class Recurrent(nn.Module):
    """A recurrent policy for n control loops, which remembers its state and its past actions.

    With the methods `reset` and `act`, the network is a policy for `mptc_gym.evaluate` and for
    the command `benchmarks.compare`.
    """

    def __init__(self) -> None:
        super().__init__()
        inputs = 2 + MEMORY  # set point, error and past actions
        self.cell = nn.GRUCell(inputs, NODES)
        self.output = nn.Linear(NODES + inputs, 1)
        self.reset()

    def begin(self, n: int) -> None:
        """Set the state and the past actions to 0, for n plants at rest."""
        self.state = torch.zeros(n, NODES)
        self.actions = torch.zeros(n, MEMORY)  # newest first
        self.has_begun = True

    def reset(self) -> None:
        """Forget the episode: the next call of `act` begins a new episode."""
        self.has_begun = False

    def detach(self) -> None:
        """Cut the PyTorch graph, so that later gradients do not reach earlier samples."""
        self.state = self.state.detach()
        self.actions = self.actions.detach()

    def forward(self, setpoint: Tensor, error: Tensor) -> Tensor:
        """Return the actions of a sample, shape (n, 1), and update the state.

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
        """Return the actions of a sample, shape (n, 1).

        `observations` is an array of shape (n, size): equal numbers of latest set points and
        latest errors, degC, newest first.
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
    """Train a network by truncated backpropagation through the plants, and return it.

    Parameters
    ----------
    steps
        Number of steps of the optimiser, each from a segment of `SEGMENT` samples.
    plants
        Number of plants that are simulated together.
    seed
        Seed of the initial weights.
    """
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
        # For the gradient, all that happened before this segment is constant.
        env.detach()
        network.detach()
        observations = observations.detach()
        errors = []
        for _ in range(SEGMENT):
            actions = network(observations[:, 0], observations[:, 1])
            observations, _, _, _, infos = env.step(actions)
            errors.append(infos["error"])  # without the noise of the observed error
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
    """Return the policy that is saved in `FILE`.

    The command `benchmarks.compare` calls this function for its option
    `--agent mine=benchmarks.examples.recurrent:make`.
    """
    network = Recurrent()
    network.load_state_dict(torch.load(FILE, weights_only=True))
    return network


if __name__ == "__main__":
    torch.set_num_threads(1)
    trained = train(*map(int, sys.argv[1:]))
    torch.save(trained.state_dict(), FILE)
    print(evaluate(make(), IDS["hard"], episodes=200, seed=VALIDATION_SEED))
