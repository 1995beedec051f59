"""The paper's network and its PI controller, with Gymnasium and NumPy alone.

`python -m benchmarks.examples.torch_free` runs both on the square wave and prints their mean
absolute errors. Nothing is kept.
"""

from __future__ import annotations

import argparse
import sys

import gymnasium

import mptc_gym  # noqa: F401 (registers the environment)
from agents import Controller, DirectNNController, PIController


def mean_error(controller: Controller, steps: int, seed: int, noise: float) -> float:
    """Return the mean |e| of a controller over `steps` samples, degC."""
    plant = gymnasium.make("MiddlePoint-v0", max_episode_steps=-1, noise_variance=noise)
    observation, info = plant.reset(seed=seed)
    controller.reset()
    errors = 0.0
    for _ in range(steps):
        errors += abs(info["error"])
        observation, _, _, _, info = plant.step(controller.act(observation))
    return errors / steps


def main(arguments: list[str] | None = None) -> int:
    """Run both with the options of a command line, without the program's name."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.examples.torch_free",
        description=__doc__,
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--steps", type=int, default=1200, help="samples of 8 s")
    parser.add_argument("--seed", type=int, default=0, help="of the weights and the noise")
    parser.add_argument("--noise", type=float, default=0.0, help="its variance R, degC^2")
    options = parser.parse_args(arguments)
    controllers = {"NN": DirectNNController(seed=options.seed), "PI": PIController()}
    for name, controller in controllers.items():
        error = mean_error(controller, options.steps, options.seed, options.noise)
        print(f"{name}: mean |e| {error:.3f} degC")
    return 0


if __name__ == "__main__":
    sys.exit(main())
