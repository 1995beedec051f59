"""Learn to control `MiddlePointHard-v0` from reward alone, with algorithms of stock libraries.

    python -m benchmarks.examples.stock ppo --seed 0 --minutes 4 --out curves.csv

An algorithm has its default settings, except those in `TRAININGS`. The policy is scored four
times during its training, and each score becomes a row of the CSV file.
`benchmarks/published/stock_curves.csv` has five seeds of each algorithm.
"""

import argparse
import csv
import time
from pathlib import Path
from typing import Any, Final, NamedTuple

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


class Training(NamedTuple):
    """How an algorithm trains a policy."""

    algorithm: Any  # class of the algorithm
    policy: str  # name of the policy's class
    plants: int  # number of plants that are simulated together
    settings: dict[str, Any]  # arguments of the algorithm's class that are not defaults


TRAININGS: Final = {
    "ppo": Training(PPO, "MlpPolicy", 64, {"n_steps": 64, "batch_size": 1024}),
    "recurrent-ppo": Training(
        RecurrentPPO, "MlpLstmPolicy", 64, {"n_steps": 64, "batch_size": 1024}
    ),
    "sac": Training(SAC, "MlpPolicy", 16, {"gradient_steps": 2}),
    "td3": Training(TD3, "MlpPolicy", 16, {"gradient_steps": 2}),
}


class Curve(BaseCallback):
    """Write the learning curve of a training to a CSV file, and then stop the training.

    The curve has `SCORES` points, at equal intervals of the training's processor time. The time
    that the scores take does not count.

    Parameters
    ----------
    seconds
        Processor time of the training, s.
    labels
        Values for the first columns of each row, by column.
    path
        The CSV file, to which rows are appended.
    """

    def __init__(self, seconds: float, labels: dict[str, Any], path: Path) -> None:
        super().__init__()
        self._labels = labels
        self._path = path
        self._due_times = [seconds * point / SCORES for point in range(1, SCORES + 1)]
        self._start = time.process_time()
        self._scoring_seconds = 0.0  # processor time of all scores so far

    def _on_step(self) -> bool:
        """Score the policy if a score is due; return whether another score is to come."""
        training_seconds = time.process_time() - self._start - self._scoring_seconds
        if training_seconds >= self._due_times[0]:
            del self._due_times[0]
            score_start = time.process_time()
            self._append_score(training_seconds)
            self._scoring_seconds += time.process_time() - score_start
        return bool(self._due_times)

    def _append_score(self, training_seconds: float) -> None:
        """Score the policy on validation episodes, and append a row to the CSV file."""
        spec = spec_of(self.model, IDS["hard"])
        result = evaluate(self.model, spec, episodes=EPISODES, seed=VALIDATION_SEED)
        assert result.score is not None  # the package has bounds of validation episodes
        row = {
            **self._labels,
            "samples": self.num_timesteps,
            "cpu_seconds": round(training_seconds),
            "mean_error": round(result.mean_error, 4),
            "score": round(result.score, 4),
            "travel": round(result.travel),
        }
        is_new = not self._path.exists()
        with self._path.open("a", newline="") as file:
            writer = csv.DictWriter(file, row)
            if is_new:
                writer.writeheader()
            writer.writerow(row)
        print(row, flush=True)


def main() -> None:
    """Train a policy as the command line says, and write its learning curve."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("algorithm", choices=TRAININGS)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=4.0)
    parser.add_argument("--out", type=Path, default=Path("curves.csv"))
    options = parser.parse_args()

    torch.set_num_threads(1)  # the networks are too small for more
    training = TRAININGS[options.algorithm]
    plants = make_vec_env(
        IDS["hard"],
        training.plants,
        seed=options.seed,
        wrapper={"max_move": 2.0},
        reward="absolute",
        **WINDOWS,
    )
    model = training.algorithm(
        training.policy, plants, seed=options.seed, device="cpu", **training.settings
    )
    labels = {"algorithm": options.algorithm, "seed": options.seed}
    curve = Curve(60.0 * options.minutes, labels, options.out)
    model.learn(total_timesteps=10**9, callback=curve)  # the callback ends the training earlier


if __name__ == "__main__":
    main()
