"""Train and score models of Stable-Baselines3 with many plants at once.

    plants = make_vec_env("MiddlePoint-v0", 64, seed=0, **FOR_LEARNING)
    model = PPO("MlpPolicy", plants, n_steps=64).learn(200_000, ScoreCallback(folder="best"))

Requires `pip install "mptc_gym[sb3]"`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gymnasium.envs.registration import EnvSpec
from gymnasium.error import DependencyNotInstalled

try:
    from stable_baselines3.common.callbacks import BaseCallback
except ImportError as error:
    raise DependencyNotInstalled(
        'mptc_gym.sb3 needs Stable-Baselines3: pip install "mptc_gym[sb3]"'
    ) from error

from mptc_gym.evaluation import VALIDATION_SEED, Evaluation, evaluate
from mptc_gym.sb3_vec_env import GymnasiumVecEnv, like, make_vec_env

__all__ = ["GymnasiumVecEnv", "ScoreCallback", "like", "make_vec_env"]


class ScoreCallback(BaseCallback):
    """Score a policy during its training and at the end, and save the best policy.

    The policy is scored without exploration, in environments of its own, which `like` makes
    with the normalisation statistics that the training has at the time. A training run with a
    `ScoreCallback` is equal, bit for bit, to one without. The seeds of the scored episodes
    begin at `VALIDATION_SEED` of `mptc_gym.evaluation`, and differ from the default seeds of
    `evaluate`. `MiddlePoint-v0` has the same episode for all seeds. To choose a policy in
    another episode, pass another set point, such as `setpoint_period=500`.

    The model's logger records the mean absolute error, degC, as `score/mean_error`, and, if the
    reference error is known, the score as `score/score`.

    Parameters
    ----------
    env
        Id or `EnvSpec` of the environment in which the policy is scored.
    every
        Least number of training samples between two scores, summed over all plants. The policy
        is also scored after its last update. Without an update in between, the policy is not
        scored again.
    episodes
        Number of episodes in which the policy is scored each time. If plants or set points are
        random, a score needs reference errors, which are known for at most 200 episodes.
    folder
        Folder in which the policy with the least mean error is kept as `best_model.zip`, with
        the statistics of a `VecNormalize` in `vecnormalize.pkl`; None to write no files.
        Earlier files with these names are replaced.
    verbose
        1 to print each score, 0 to print nothing.
    **arguments
        Further arguments of the environment, as in `gymnasium.make`.

    Attributes
    ----------
    scores : list of (int, Evaluation)
        For each score, the number of training samples so far and the result of `evaluate`.
    best : Evaluation or None
        Result of `evaluate` with the least mean error so far; None before the first score.
    """

    def __init__(
        self,
        env: str | EnvSpec = "MiddlePoint-v0",
        *,
        every: int = 20_000,
        episodes: int = 20,
        folder: str | Path | None = None,
        verbose: int = 1,
        **arguments: Any,
    ) -> None:
        super().__init__(verbose)
        self.env = env
        self.every = every
        self.episodes = episodes
        self.folder = None if folder is None else Path(folder)
        self.arguments = arguments
        self.scores: list[tuple[int, Evaluation]] = []
        self.best: Evaluation | None = None
        self._scored_updates: int | None = None  # updates before the latest score

    def _on_training_start(self) -> None:
        """Raise an error before the training, and not after it, if `like` cannot work."""
        like(self.model, self.env, 1, **self.arguments).close()
        self._next_score = self.num_timesteps + self.every

    def _on_step(self) -> bool:
        """Score the policy if a score is due; return True to continue the training."""
        if self.num_timesteps >= self._next_score:
            self._score()
        return True

    def _on_training_end(self) -> None:
        """Score the policy that the training ends with."""
        self._score()

    def _score(self) -> None:
        """Score, log and print the policy, and keep it if it is best, unless already scored."""
        # All algorithms count their updates, whereas their weights are on any device, and those
        # of SBX are no tensors.
        updates = self.model._n_updates
        if updates == self._scored_updates:
            return
        self._scored_updates = updates
        self._next_score = self.num_timesteps + self.every
        result = evaluate(
            self.model,
            self.env,
            episodes=self.episodes,
            seed=VALIDATION_SEED,
            **self.arguments,
        )
        self.scores.append((self.num_timesteps, result))
        self.logger.record("score/mean_error", result.mean_error)
        if result.score is not None:
            self.logger.record("score/score", result.score)
        self.logger.dump(self.num_timesteps)
        if self.verbose:
            print(f"{self.num_timesteps:,} samples: {result}", flush=True)
        if self.best is None or result.mean_error < self.best.mean_error:
            self.best = result
            if self.folder is not None:
                self._save(self.folder)

    def _save(self, folder: Path) -> None:
        """Save the model, and the statistics of its `VecNormalize` if it has one."""
        folder.mkdir(parents=True, exist_ok=True)
        self.model.save(folder / "best_model.zip")
        normaliser = self.model.get_vec_normalize_env()
        if normaliser is not None:
            normaliser.save(str(folder / "vecnormalize.pkl"))
