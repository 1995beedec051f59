"""Train with Stable-Baselines3 on a batch of plants, and record how a policy was trained.

    from stable_baselines3 import PPO
    from mptc_gym.sb3 import ScoreCallback, make_vec_env

    plants = make_vec_env("MiddlePoint-v0", 64, seed=0, wrapper={"compensate_dead_zone": True},
                          action_window=20, setpoint="random")
    model = PPO("MlpPolicy", plants, n_steps=64).learn(200_000, ScoreCallback(path="best.zip"))

Requires `pip install "mptc_gym[sb3]"`.
"""

from __future__ import annotations

import functools
import os
import pkgutil
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, cast

import gymnasium
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from mptc_gym.checks import MOST_PLANTS, count, plain, reject
from mptc_gym.evaluation import EPISODES, SEED, Evaluation, evaluate, native_batch
from mptc_gym.sb3_training import GymnasiumVecEnv, restored, training_of
from mptc_gym.training import MEMBER, Training, make_one, zip_path
from mptc_gym.wrappers import IncrementalAction
from mptc_gym.wrappers.vector import IncrementalAction as VectorIncrementalAction

__all__ = ["GymnasiumVecEnv", "ScoreCallback", "load", "make_vec_env", "save", "spec_of"]


def make_vec_env(
    env: str | EnvSpec = "MiddlePoint-v0",
    n_envs: int = 1,
    *,
    seed: int | None = None,
    group: int = 1,
    wrapper: Mapping[str, Any] | Callable[..., Any] | None = None,
    **arguments: Any,
) -> GymnasiumVecEnv:
    """Make plants that are stepped together, for the algorithms of Stable-Baselines3.

    A model trained on them records how it was trained: `model.save` saves this, and `spec_of`
    reads it. At the end of an episode, its infos hold the return, as with `Monitor`.

    Parameters
    ----------
    env
        An id or an `EnvSpec`.
    n_envs
        Number of plants.
    seed
        Seed of the first plant at the first reset; plant i has `seed + i // group`. The seed of
        a model, if it has one, replaces it.
    group
        Number of neighbouring plants that share a seed: they draw the same noise, load and
        set points, and differ only in what a policy explores.
    wrapper
        Adds `IncrementalAction`: its arguments, or the class itself for its defaults.
    **arguments
        Further arguments for the id, as in `gymnasium.make`; `render_mode` may be "rgb_array".

    Raises
    ------
    ValueError
        If an argument is out of range, or the wrapper is another, which cannot take a batch:
        for those, use `stable_baselines3.common.env_util.make_vec_env`.
    """
    n_envs = count("n_envs", n_envs, 1, MOST_PLANTS)
    group = count("group", group, 1, n_envs)
    arguments = {name: plain(value) for name, value in arguments.items()}
    render_mode = arguments.pop("render_mode", None)  # not part of a policy's training
    single = make_one(env, arguments)
    if getattr(wrapper, "func", wrapper) is VectorIncrementalAction:
        wrapper = getattr(wrapper, "keywords", {})
    if isinstance(wrapper, Mapping):
        single = IncrementalAction(single, **wrapper)
    elif callable(wrapper):
        single = wrapper(single)
    elif wrapper is not None:
        reject("wrapper", wrapper, "the arguments of IncrementalAction, or the class itself")
    plants = _step_together(single, n_envs, render_mode, group)
    if plants is None:
        raise ValueError(f"wrapper must be IncrementalAction, got {single}")
    plants.seed(seed)
    return plants


def _step_together(
    single: gymnasium.Env[Any, Any], n: int, render_mode: str | None = None, group: int = 1
) -> GymnasiumVecEnv | None:
    """Close an environment and return n like it, or None where a batch cannot be."""
    batch = native_batch(single)
    single.close()
    if batch is None:
        return None
    many = batch(n, autoreset_mode=AutoresetMode.SAME_STEP, render_mode=render_mode)
    return GymnasiumVecEnv(many, spec=single.spec, group=group)


def save(model: BaseAlgorithm, path: str | Path) -> None:
    """Save a model atomically, with a record of how it was trained.

    The zip is that of `model.save` with one more member, `mptc_gym.json`: the environment, its
    arguments and wrappers, the statistics of `VecNormalize`, the number of frames of
    `VecFrameStack`, and the spaces.

    Parameters
    ----------
    model
        A model with its training environments.
    path
        Path of the zip; `.zip` is added to a name without an ending.

    Raises
    ------
    ValueError
        If it is unknown how the model was trained, if an argument of a wrapper cannot be
        written as JSON, or if the file cannot be written.
    """
    record = training_of(model).to_json()
    path = zip_path(path)
    partial = path.with_name(f".{path.stem}.{os.getpid()}.zip")
    try:
        model.save(partial)
        with zipfile.ZipFile(partial, "a") as archive:
            archive.writestr(MEMBER, record)
        partial.replace(path)
    except OSError as error:
        raise ValueError(f"{path} cannot be written: {error.strerror}") from error
    finally:
        if partial.exists():
            partial.unlink()


def load(path: str | Path, **arguments: Any) -> BaseAlgorithm:
    """Load a model that `save` wrote, with environments like those of its training.

    Wrappers that change nothing but rewards are left out.

    Loading runs code from the zip and from the modules that it names: load only what you trust.

    Parameters
    ----------
    path
        Path of the zip.
    **arguments
        Further arguments for the `load` of the algorithm, such as `device="cpu"`.

    Returns
    -------
    model
        The model, which `evaluate` can score and `learn` trains further. Its plants all have
        the arguments of the first one in training, and seeds of their own.

    Raises
    ------
    ValueError
        If the zip cannot be read, if it has no record of its training, or if its algorithm or
        its weights cannot be loaded.
    """
    record = Training.read(path)
    if "env" in arguments:
        raise ValueError(
            "env must not be given to load, but by set_env to the model it returns"
        )
    try:
        spec = record.spec(record.env, record.arguments)
        spec.max_episode_steps = record.max_episode_steps
        plants: VecEnv = _step_together(make_one(spec, {}), record.n_envs) or DummyVecEnv(
            [functools.partial(gymnasium.make, spec)] * record.n_envs
        )
        for each in record.vec_wrappers:
            plants = restored(plants, **each)
        algorithm = pkgutil.resolve_name(record.algorithm)
        if not issubclass(algorithm, BaseAlgorithm):
            raise TypeError(f"{record.algorithm} is no algorithm of Stable-Baselines3")
        return cast("BaseAlgorithm", algorithm.load(path, env=plants, **arguments))
    except Exception as error:
        text = f"{type(error).__name__}: {error}"
        raise ValueError(f"{path} cannot be loaded as {record.algorithm}: {text}") from error


def spec_of(policy: Any, env: str | EnvSpec = "MiddlePoint-v0", **arguments: Any) -> EnvSpec:
    """Return the spec of an environment with the windows and wrappers of a policy's training.

        evaluate(model, spec_of(model, "MiddlePointHard-v0"))

    Parameters
    ----------
    policy
        A model, or the path of a zip. No code from the zip is run.
    env
        The environment to evaluate on: an id or an `EnvSpec`, whose own windows and wrappers
        are replaced.
    **arguments
        Further arguments for the environment, other than windows.

    Raises
    ------
    ValueError
        If it is unknown how the policy was trained, or if an argument is another window than
        that of the training.
    """
    in_file = isinstance(policy, str | Path)
    training = Training.read(policy) if in_file else training_of(policy)
    return training.spec(env, arguments)


class ScoreCallback(BaseCallback):
    """Score the policy during training, without exploration, and keep the best.

    The default episodes of `mptc_gym.evaluate` are not used, so they stay free for the final
    score. Where nothing is drawn, as in `MiddlePoint-v0`, all episodes are the same: select by
    another set point, such as `setpoint_period=500`. The log gets `score/mean_error` and, where
    there is a bound, `score/score`.

    Parameters
    ----------
    env
        The environment to score on: an id or an `EnvSpec`. Windows and wrappers are those of
        the training.
    every
        Samples of experience between scores; the end of training is scored, too.
    episodes
        Number of episodes per score. Where bounds differ by episode, there are only 20 of them.
    path
        Zip in which to keep the policy with the least mean error, if any.
    verbose
        1 prints each score, 0 does not.
    **arguments
        More arguments for `env`.

    Attributes
    ----------
    scores : list of (int, Evaluation)
        Samples of experience and result of each score.
    best : Evaluation or None
        The result with the least mean error.
    """

    def __init__(
        self,
        env: str | EnvSpec = "MiddlePoint-v0",
        *,
        every: int = 20_000,
        episodes: int = 20,
        path: str | Path | None = None,
        verbose: int = 1,
        **arguments: Any,
    ) -> None:
        super().__init__(verbose)
        self.every = count("every", every, 1, 10**12)
        self.episodes = count("episodes", episodes, 2, MOST_PLANTS)
        self.path = None if path is None else Path(path)
        if self.path is not None and self.path.is_dir():
            reject("path", path, "the name of a zip, not a folder")
        self.scores: list[tuple[int, Evaluation]] = []
        self.best: Evaluation | None = None
        self._env, self._arguments = env, arguments

    def _init_callback(self) -> None:
        self._spec = spec_of(self.model, self._env, **self._arguments)
        if self.path is not None:
            training_of(self.model).to_json()  # now, rather than when it is to be saved

    def _on_training_start(self) -> None:
        self._latest, self._next = -1, self.num_timesteps + self.every

    def _on_step(self) -> bool:
        if self.num_timesteps >= self._next:
            self._next += self.every
            self._score()
        return True

    def _on_training_end(self) -> None:
        if self._latest < self.num_timesteps:
            self._score()

    def _score(self) -> None:
        found = evaluate(self.model, self._spec, episodes=self.episodes, seed=SEED + EPISODES)
        self._latest = self.num_timesteps
        self.scores.append((self.num_timesteps, found))
        self.logger.record("score/mean_error", found.mean_error)
        if found.score is not None:
            self.logger.record("score/score", found.score)
        best = self.best is None or found.mean_error < self.best.mean_error
        if best:
            self.best = found
            if self.path is not None:
                save(self.model, self.path)
        if self.verbose:
            total = self.locals.get("total_timesteps", 0)
            share = f" of {total:,}" if total else ""
            print(
                f"{self.num_timesteps:,}{share} samples: {found}{'; best' * best}", flush=True
            )
