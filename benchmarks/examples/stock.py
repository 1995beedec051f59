"""Train policies for `MiddlePointHard-v0` by PPO, recurrent PPO, SAC and TD3.

    python -m benchmarks.examples.stock ppo --seed 0 --minutes 4 --out curves.csv

Each algorithm of Stable-Baselines3 or sb3-contrib has the default settings, except for the
settings in `TRAININGS`. Each policy is scored four times during the training, and each score
becomes a row of a CSV file. The file `benchmarks/published/stock_curves.csv` holds the scores
of five seeds of each algorithm.
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
    """Settings for the training of a policy by one algorithm."""

    algorithm: Any  # class of the algorithm
    policy: str  # name of the policy's class
    plants: int  # number of plants that are simulated at the same time
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
    """A callback that writes a learning curve to a CSV file, and then stops the training.

    The learning curve has `SCORES` points, at equal intervals of the training's processor time,
    which does not include the time for the scores.

    Parameters
    ----------
    seconds
        Processor time after which the training stops, s.
    labels
        Values of the first columns in each CSV row, by column name.
    path
        Path of the CSV file, to which rows are appended.
    """

    def __init__(self, seconds: float, labels: dict[str, Any], path: Path) -> None:
        super().__init__()
        self._labels = labels
        self._path = path
        self._due_times = [seconds * point / SCORES for point in range(1, SCORES + 1)]
        self._start = time.process_time()
        self._scoring_seconds = 0.0  # processor time of all scores so far

    def _on_step(self) -> bool:
        """Score the policy if a score is due, and return whether the training goes on."""
        training_seconds = time.process_time() - self._start - self._scoring_seconds
        if training_seconds >= self._due_times[0]:
            del self._due_times[0]
            score_start = time.process_time()
            self._append_score(training_seconds)
            self._scoring_seconds += time.process_time() - score_start
        return bool(self._due_times)

    def _append_score(self, training_seconds: float) -> None:
        """Score the policy on validation episodes, and append the score to the CSV file."""
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
    """Train a policy with the options of the command line, and write the learning curve."""
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
