"""Train RLlib's PPO on one plant.

`python -m benchmarks.examples.rllib` trains a policy for some iterations and prints its score
on the noise-free square wave, without exploration, after each. The policy is not saved.
RLlib pins a version of Gymnasium, so it needs a virtual environment of its own:
`pip install -e ".[bench,rllib]"`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import cyclopts
import numpy as np
import ray
import torch
from numpy.typing import NDArray
from ray.rllib.algorithms.ppo import PPOConfig

from mptc_gym import evaluate

# With delay + 2 past actions the problem is Markov while the set point is constant.
OBSERVATION: dict[str, Any] = {"action_window": 20}


def policy_of(module: Any) -> Callable[[NDArray[np.float32]], NDArray[np.float32]]:
    """Return the policy of an RLlib module, a function of observations, without exploration."""

    @torch.no_grad()
    def act(observations: NDArray[np.float32]) -> NDArray[np.float32]:
        outputs = module.forward_inference({"obs": torch.as_tensor(observations)})
        # The mean of the action distribution comes first, then its log standard deviation.
        return cast("NDArray[np.float32]", outputs["action_dist_inputs"][:, :1].numpy())

    return act


def main(*, steps: int = 200_000, seed: int = 0, batch: int = 4000) -> None:
    """Train RLlib's PPO on one plant.

    Parameters
    ----------
    steps
        Total number of steps.
    seed
        Seed of the policy and the exploration.
    batch
        Steps per iteration.
    """
    config = (
        PPOConfig()
        # The prefix "mptc_gym:" makes RLlib's own processes import the package. RLlib clips the
        # value loss, so errors above sqrt(vf_clip_param), about 3, teach the value function
        # nothing; error_scale reduces returns from about -50 to -0.5.
        .environment("mptc_gym:MiddlePoint-v0", env_config={**OBSERVATION, "error_scale": 50.0})
        .env_runners(num_env_runners=0)  # one plant runs fastest in this process
        .training(train_batch_size_per_learner=batch, lr=3e-4)
        .debugging(seed=seed, log_level="ERROR")
    )
    # "local" ignores any cluster that runs here or that RAY_ADDRESS names.
    ray.init("local", num_cpus=1, include_dashboard=False, log_to_driver=False)
    torch.set_num_threads(1)  # the network is too small for more
    algorithm = config.build_algo()
    for iteration in range(-(-steps // batch)):
        algorithm.train()
        found = evaluate(policy_of(algorithm.get_module()), **OBSERVATION)
        print(f"{(iteration + 1) * batch:9,} steps: {found}", flush=True)
    algorithm.stop()
    ray.shutdown()


if __name__ == "__main__":
    cyclopts.run(main)
