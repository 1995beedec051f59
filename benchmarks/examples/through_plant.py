"""Train your own network through the plant: `python -m benchmarks.examples.through_plant`.

The PyTorch environment is differentiable, so the error of a whole run has a gradient with
respect to the policy's weights. Training needs no value function and no exploration, and takes
half a minute on one core. The policy is then tested on the paper's square wave, on which it was
not trained.
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
# Action that holds a temperature, per degC: the plant's gain is -0.6825 degC per t/h, and an
# action of 1 is a flow of 10 t/h.
HOLDS = -0.1465


def act(network: nn.Module, observations: Tensor) -> Tensor:
    """Return actions, shape (n, 1), for observations, shape (n, 49).

    The inputs of the network are all 0 in steady state at the set point.
    """
    setpoint, outputs, actions = observations.split([1, 24, 24], dim=1)
    inputs = torch.cat([0.5 * (setpoint - outputs), actions - HOLDS * setpoint], dim=1)
    action: Tensor = HOLDS * setpoint + network(inputs)
    return action


def run(network: nn.Module, plants: MiddlePointTorchEnv, samples: int, seed: int) -> Tensor:
    """Return the errors of n plants in a run, degC, shape (samples, n)."""
    observations, _ = plants.reset(seed=seed)
    errors = []
    for _ in range(samples):
        observations, _, _, _, infos = plants.step(act(network, observations))
        errors.append(infos["error"])
    return torch.stack(errors)


def main(steps: int = 100, plants: int = 64, samples: int = 300) -> Evaluation:
    """Train a policy, and return its evaluation on the square wave.

    The policy is trained in `steps` updates, each from a run of `samples` samples of `plants`
    plants.
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
