"""PPO of RLlib on one plant.

`python -m benchmarks.examples.rllib` trains a policy for some iterations and prints its mean
absolute error on the noise-free square wave, without exploration, after each. Nothing is kept.
RLlib asks for one version of Gymnasium, and so for a virtual environment of its own:
`pip install -e ".[bench,rllib]"`.
"""

from __future__ import annotations

import argparse
import sys
from typing import Any

import numpy as np
import ray
import torch
from numpy.typing import NDArray
from ray.rllib.algorithms.ppo import PPOConfig

from benchmarks.metrics import mean_error
from benchmarks.rollout import make_plants, rollout
from mptc_gym import Parameters

OBSERVATION = {"action_window": Parameters().delay + 2}  # with them the problem is Markov
SAMPLES = 1200  # two periods of the square wave


class Predictor:
    """A module of RLlib as a controller, which takes the mean of its distribution."""

    def __init__(self, module: Any) -> None:
        self._module = module

    def reset(self) -> None:
        """Do nothing: the observation holds all that the policy remembers."""

    @torch.no_grad()
    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return actions, shape (runs, 1)."""
        inputs = self._module.forward_inference({"obs": torch.as_tensor(observation)})
        return inputs["action_dist_inputs"][:, :1].numpy()  # mean, then log of the spread


def main(arguments: list[str] | None = None) -> int:
    """Train, and print how far it got.

    Parameters
    ----------
    arguments
        The command line without the program's name.

    Returns
    -------
    int
        0.
    """
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.examples.rllib",
        description=__doc__,
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--steps", type=int, default=200_000, help="in all")
    parser.add_argument("--seed", type=int, default=0, help="of policy and exploration")
    parser.add_argument("--batch", type=int, default=4000, help="an iteration")
    options = parser.parse_args(arguments)

    config = (
        PPOConfig()
        # The name says what to import: RLlib's own processes have not imported mptc_gym.
        # RLlib ignores what the value function learns from errors of more than
        # sqrt(vf_clip_param), about 3, and returns are some -50; error_scale makes them -0.5.
        .environment("mptc_gym:MiddlePoint-v0", env_config={**OBSERVATION, "error_scale": 50.0})
        .env_runners(num_env_runners=0)  # one plant is quickest in this very process
        .training(train_batch_size_per_learner=options.batch, lr=3e-4)
        .debugging(seed=options.seed, log_level="ERROR")
    )
    ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False)
    torch.set_num_threads(1)  # the network is too small for more
    algorithm = config.build_algo()
    plants = make_plants(1, SAMPLES, **OBSERVATION)
    for iteration in range(-(-options.steps // options.batch)):
        algorithm.train()
        runs = rollout(plants, Predictor(algorithm.get_module()), SAMPLES, seed=0)
        error = mean_error(runs)[0]
        print(
            f"{(iteration + 1) * options.batch:9,} steps: mean |e| on the square wave "
            f"{error:.3f} degC", flush=True,
        )  # fmt: skip
    algorithm.stop()
    ray.shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
