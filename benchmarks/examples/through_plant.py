"""Train your own network through the plant: `python -m benchmarks.examples.through_plant`.

The PyTorch environment is differentiable, so the error of a whole run has a gradient with
respect to the policy's weights: no value function, no exploration. Training takes half a minute
on one core. The policy is then tested on the paper's square wave, which it was not trained on.
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
HOLDS = -0.1465  # steady-state action per degC: the plant's gain is -0.6825 degC per t/h


def act(network: nn.Module, seen: Tensor) -> Tensor:
    """Return actions, shape (n, 1). In steady state at the set point all inputs are 0."""
    setpoint, outputs, actions = seen[:, :1], seen[:, 1:25], seen[:, 25:]
    steady = torch.cat([0.5 * (setpoint - outputs), actions - HOLDS * setpoint], dim=1)
    action: Tensor = HOLDS * setpoint + network(steady)
    return action


def run(network: nn.Module, plants: MiddlePointTorchEnv, samples: int, seed: int) -> Tensor:
    """Return the errors of a run, degC, shape (samples, n)."""
    seen, _ = plants.reset(seed=seed)
    errors = []
    for _ in range(samples):
        seen, _, _, _, infos = plants.step(act(network, seen))
        errors.append(infos["error"])
    return torch.stack(errors)


def main(steps: int = 100, plants: int = 64, samples: int = 300) -> Evaluation:
    """Train a policy, and evaluate it on the square wave."""
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
    return evaluate(lambda seen: act(network, torch.as_tensor(seen)).numpy(), **WINDOWS)


if __name__ == "__main__":
    torch.set_num_threads(1)
    print(main(*map(int, sys.argv[1:])))
