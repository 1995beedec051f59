"""PPO of RLlib on one plant.

`python -m benchmarks.examples.rllib` trains a policy for some iterations and prints its score
on the noise-free square wave, without exploration, after each. The policy is not saved.
RLlib asks for one version of Gymnasium, and so for a virtual environment of its own:
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

# With delay + 2 past actions the problem is Markov while the set point holds.
OBSERVATION: dict[str, Any] = {"action_window": 20}


def policy_of(module: Any) -> Callable[[NDArray[np.float32]], NDArray[np.float32]]:
    """Return a module of RLlib as a function of observations, without exploration."""

    @torch.no_grad()
    def act(observations: NDArray[np.float32]) -> NDArray[np.float32]:
        outputs = module.forward_inference({"obs": torch.as_tensor(observations)})
        # The mean of its distribution comes first, then the logarithm of its spread.
        return cast("NDArray[np.float32]", outputs["action_dist_inputs"][:, :1].numpy())

    return act


def main(*, steps: int = 200_000, seed: int = 0, batch: int = 4000) -> None:
    """Train PPO of RLlib on one plant.

    Parameters
    ----------
    steps
        In all.
    seed
        Of policy and exploration.
    batch
        Steps of an iteration.
    """
    config = (
        PPOConfig()
        # The name says what to import: RLlib's own processes have not imported mptc_gym.
        # RLlib ignores what the value function learns from errors of more than
        # sqrt(vf_clip_param), about 3, and returns are some -50; error_scale makes them -0.5.
        .environment("mptc_gym:MiddlePoint-v0", env_config={**OBSERVATION, "error_scale": 50.0})
        .env_runners(num_env_runners=0)  # one plant is quickest in this very process
        .training(train_batch_size_per_learner=batch, lr=3e-4)
        .debugging(seed=seed, log_level="ERROR")
    )
    # "local": a cluster that happens to run here, or that RAY_ADDRESS names, is left alone.
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
