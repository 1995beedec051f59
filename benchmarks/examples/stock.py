"""Learn to control `MiddlePointHard-v0` from reward alone, with algorithms of stock libraries.

    python -m benchmarks.examples.stock ppo --seed 0 --minutes 4 --out curves.csv

The algorithm has its default settings, except those in `ALGORITHMS`. Every quarter of the time,
the policy is scored on 100 validation episodes, and a row is added to the CSV file.
`benchmarks/published/stock_curves.csv` has five seeds of each algorithm.
"""

import argparse
import csv
import time
from pathlib import Path
from typing import Any, Final

import torch
from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.callbacks import BaseCallback

from mptc_gym import IDS, evaluate
from mptc_gym.evaluation import VALIDATION_SEED
from mptc_gym.sb3 import make_vec_env, spec_of

EPISODES: Final = 100  # number of episodes over which a score is averaged
SCORES: Final = 4  # number of scores in a training, at equal intervals of processor time
# Arguments of the environment that determine the observation: the set point, eight errors, and
# past actions over a time that is longer than the longest delay.
WINDOWS: Final = {"setpoint_window": 1, "error_window": 8, "action_window": 31}
# For each algorithm its class, the number of plants that are simulated together, and arguments
# of the class that differ from its defaults.
ALGORITHMS: Final[dict[str, tuple[Any, int, dict[str, Any]]]] = {
    "ppo": (PPO, 64, {"n_steps": 64, "batch_size": 1024}),
    "recurrent-ppo": (RecurrentPPO, 64, {"n_steps": 64, "batch_size": 1024}),
    "sac": (SAC, 16, {"gradient_steps": 2}),
    "td3": (TD3, 16, {"gradient_steps": 2}),
}
POLICIES: Final = {"recurrent-ppo": "MlpLstmPolicy"}  # the others have "MlpPolicy"


class Curve(BaseCallback):
    """A callback that scores a policy during its training, at equal intervals of time.

    After the last score, the callback stops the training.

    Parameters
    ----------
    seconds
        Processor time of the training, without the time for the scores, s.
    row
        Values for the first columns of each row in the CSV file, by column.
    path
        The CSV file, to which a row is appended for each score.
    """

    def __init__(self, seconds: float, row: dict[str, Any], path: Path) -> None:
        super().__init__()
        self._seconds = seconds
        self._row = row
        self._path = path
        self._scores = 0
        self._began = time.process_time()

    def _on_step(self) -> bool:
        """Score the policy if it is time, and return whether to go on with the training."""
        spent = time.process_time() - self._began
        if spent < self._seconds * (self._scores + 1) / SCORES:
            return True
        self._score(spent)
        self._began = time.process_time() - spent  # as a score is no part of the training
        return self._scores < SCORES

    def _score(self, spent: float) -> None:
        """Score the policy on validation episodes, and append a row to the CSV file.

        `spent` is the processor time of the training so far, s.
        """
        self._scores += 1
        spec = spec_of(self.model, IDS["hard"])
        result = evaluate(self.model, spec, episodes=EPISODES, seed=VALIDATION_SEED)
        row = {
            **self._row,
            "samples": self.num_timesteps,
            "cpu_seconds": round(spent),
            "mean_error": round(result.mean_error, 4),
            "score": round(result.score or 0.0, 4),
            "travel": round(result.travel),
        }
        is_new = not self._path.exists()
        with self._path.open("a", newline="") as file:
            writer = csv.DictWriter(file, row)
            if is_new:
                writer.writeheader()
            writer.writerow(row)
        print(row, flush=True)


def train(algorithm: str, seed: int, minutes: float, path: Path) -> None:
    """Train a policy for some processor time, and append its scores to a CSV file.

    Parameters
    ----------
    algorithm
        Key of `ALGORITHMS`.
    seed
        Seed of the initial weights, the exploration and the plants.
    minutes
        Processor time of the training, without the time for the scores.
    path
        The CSV file.
    """
    kind, n, settings = ALGORITHMS[algorithm]
    plants = make_vec_env(
        IDS["hard"],
        n,
        seed=seed,
        wrapper={"max_move": 2.0},
        reward="absolute",
        **WINDOWS,
    )
    policy = POLICIES.get(algorithm, "MlpPolicy")
    model = kind(policy, plants, seed=seed, device="cpu", **settings)
    row = {"algorithm": algorithm, "seed": seed}
    model.learn(10**9, callback=Curve(60.0 * minutes, row, path))


def main() -> None:
    """Read the command line, and train a policy."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("algorithm", choices=ALGORITHMS)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=4.0)
    parser.add_argument("--out", type=Path, default=Path("curves.csv"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # the networks are too small for more
    train(arguments.algorithm, arguments.seed, arguments.minutes, arguments.out)


if __name__ == "__main__":
    main()
