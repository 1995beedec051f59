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

import gymnasium
import ray
import torch
from ray.rllib.algorithms.ppo import PPOConfig

import mptc_gym  # noqa: F401 (registers the environment)

# With delay + 2 past actions the problem is Markov while the set point holds.
OBSERVATION: dict[str, Any] = {"action_window": 20}


@torch.no_grad()
def square_error(module: Any) -> float:
    """Return the mean |e| of a module of RLlib on the noise-free square wave, degC."""
    plant = gymnasium.make("MiddlePoint-v0", **OBSERVATION)
    observation, info = plant.reset(seed=0)
    total, samples, ended = 0.0, 0, False
    while not ended:
        total += abs(info["error"])
        samples += 1
        inputs = {"obs": torch.as_tensor(observation)[None]}
        # The mean of its distribution comes first, then the logarithm of its spread.
        action = module.forward_inference(inputs)["action_dist_inputs"][0, :1].numpy()
        observation, _, _, ended, info = plant.step(action)
    return total / samples


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
    # "local": a cluster that happens to run here, or that RAY_ADDRESS names, is left alone.
    ray.init("local", num_cpus=1, include_dashboard=False, log_to_driver=False)
    torch.set_num_threads(1)  # the network is too small for more
    algorithm = config.build_algo()
    for iteration in range(-(-options.steps // options.batch)):
        algorithm.train()
        error = square_error(algorithm.get_module())
        print(
            f"{(iteration + 1) * options.batch:9,} steps: mean |e| on the square wave "
            f"{error:.3f} degC", flush=True,
        )  # fmt: skip
    algorithm.stop()
    ray.shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
