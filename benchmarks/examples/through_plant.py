"""Train a network by gradients through the plant, as an example to copy and change.

The command `python -m benchmarks.examples.through_plant` runs the example. The PyTorch
environment is differentiable, so the error of a whole run has a gradient with respect to the
policy's weights. Training by gradients needs no value function and no exploration, and takes
half a minute on one core. The trained policy is tested on the paper's square wave of set
points, which was not used in the training.
"""

import sys
from typing import Any

import torch
from torch import Tensor, nn

from mptc_gym import Evaluation, evaluate
from mptc_gym.torch_env import MiddlePointTorchEnv

WINDOWS: Any = {
    "setpoint_window": 1,
    "error_window": 0,
    "output_window": 24,
    "action_window": 24,
}
SETPOINTS: Any = {"setpoint": "random", "setpoint_amplitude": 6.0, "setpoint_period": 400}
# Action that keeps the temperature at 1 degC in steady state: the plant's gain is -0.6825 degC
# per t/h, and an action of 1 is a flow of 10 t/h.
STEADY_ACTION = -0.1465


def act(network: nn.Module, observations: Tensor) -> Tensor:
    """Return the actions of the policy for n plants, shape (n, 1).

    An action is the network's output plus the action that keeps the temperature at the set
    point in steady state. All inputs of the network are 0 if the plant has been in steady
    state at the set point for 24 samples.

    Parameters
    ----------
    network
        Policy network with 48 inputs and one output.
    observations
        Observations: the set point, 24 outputs and 24 actions of each plant, shape (n, 49).
    """
    setpoint, outputs, actions = observations.split([1, 24, 24], dim=1)
    steady_action = STEADY_ACTION * setpoint
    errors = 0.5 * (setpoint - outputs)  # in units of 2 degC, to be of order 1
    action: Tensor = steady_action + network(torch.cat([errors, actions - steady_action], 1))
    return action


def run(network: nn.Module, plants: MiddlePointTorchEnv, samples: int, seed: int) -> Tensor:
    """Return the temperature errors of the policy on n plants, degC, shape (samples, n)."""
    observations, _ = plants.reset(seed=seed)
    errors = []
    for _ in range(samples):
        observations, _, _, _, infos = plants.step(act(network, observations))
        errors.append(infos["error"])
    return torch.stack(errors)


def main(steps: int = 100, plants: int = 64, samples: int = 300) -> Evaluation:
    """Train a policy, and return its evaluation on the paper's square wave of set points.

    `steps` is the number of weight updates, each of which uses one run of `plants` plants for
    `samples` samples.
    """
    torch.manual_seed(0)
    layers = nn.Linear(48, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, 1)
    network = nn.Sequential(*layers)
    batch = MiddlePointTorchEnv(plants, differentiable=True, **WINDOWS, **SETPOINTS)
    optimiser = torch.optim.Adam(network.parameters())
    for step in range(steps):
        optimiser.param_groups[0]["lr"] = 3e-3 * (1.0 - step / steps)
        errors = run(network, batch, samples, seed=step)
        loss = nn.functional.huber_loss(errors, torch.zeros_like(errors), delta=0.02)
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
    network.requires_grad_(False)
    return evaluate(
        lambda observations: act(network, torch.as_tensor(observations)).numpy(), **WINDOWS
    )


if __name__ == "__main__":
    torch.set_num_threads(1)
    print(main(*map(int, sys.argv[1:])))
