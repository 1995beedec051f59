"""Train with Stable-Baselines3 on a batch of plants, and record how a policy was trained.

    from stable_baselines3 import PPO
    from mptc_gym.sb3 import ScoreCallback, make_vec_env

    plants = make_vec_env("MiddlePoint-v0", 64, seed=0, wrapper={"compensate_dead_zone": True},
                          action_window=20, setpoint="random")
    model = PPO("MlpPolicy", plants, n_steps=64).learn(200_000, ScoreCallback(path="best.zip"))

Requires `pip install "mptc_gym[sb3]"`.
"""

from __future__ import annotations

import copy
import os
import time
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any, cast

import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from mptc_gym.checks import MOST_PLANTS, count, plain, reject
from mptc_gym.evaluation import (
    EPISODES,
    SEED,
    WINDOWS,
    Evaluation,
    evaluate,
    make_one,
    native_batch,
)
from mptc_gym.policies import action_wrappers, trained_on
from mptc_gym.wrappers import IncrementalAction
from mptc_gym.wrappers.vector import IncrementalAction as VectorIncrementalAction


def make_vec_env(
    env: str | EnvSpec = "MiddlePoint-v0",
    n_envs: int = 1,
    *,
    seed: int | None = None,
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
        Seed of the first plant at the first reset; plant i has `seed + i`. The seed of a model,
        if it has one, replaces it.
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
    batch = native_batch(single)
    if batch is None:
        raise ValueError(f"wrapper must be IncrementalAction, got {single}")
    single.close()
    mode = AutoresetMode.SAME_STEP
    many = batch(n_envs, autoreset_mode=mode, render_mode=render_mode)
    plants = GymnasiumVecEnv(many, spec=single.spec)
    plants.seed(seed)
    return plants


class GymnasiumVecEnv(VecEnv):
    """Step whole batches at once, where `DummyVecEnv` steps one environment after another.

    Observations, rewards, episode ends and terminal observations are bit for bit those of
    `DummyVecEnv` with the same environments.

    Parameters
    ----------
    batches
        One or more vector environments of autoreset mode "SameStep" and with the same spaces;
        their environments are numbered one batch after another.
    spec
        Spec of one environment with its wrappers, if all are alike: a model trained on them
        records it.

    Attributes
    ----------
    infos : dict
        The latest infos in Gymnasium's form, as arrays; those that all batches have. The list
        that `step` returns holds only what Stable-Baselines3 itself reads at the end of an
        episode, as a dict for each environment and step would take longer than the step.

    Raises
    ------
    ValueError
        If a batch has another autoreset mode, or spaces differ.
    """

    def __init__(self, *batches: VectorEnv, spec: EnvSpec | None = None) -> None:
        spaces = batches[0].single_observation_space, batches[0].single_action_space
        for batch in batches:
            mode = batch.metadata.get("autoreset_mode")
            if mode is not AutoresetMode.SAME_STEP:
                raise ValueError(f"batches must have autoreset_mode 'SameStep', got {mode}")
            if (batch.single_observation_space, batch.single_action_space) != spaces:
                raise ValueError(f"batches must have the same spaces, got {batches}")
        self.batches, self.spec = batches, spec
        self.infos: dict[str, Any] = {}
        starts = np.cumsum([0, *(batch.num_envs for batch in batches)]).tolist()
        self._parts = list(zip(batches, map(slice, starts, starts[1:]), strict=True))
        super().__init__(starts[-1], *spaces)
        if spec is not None:
            self.observation_space.trained_on = spec.to_json()  # type: ignore[attr-defined]
        self._began = time.time()
        self._returns = np.zeros(self.num_envs)
        self._lengths = np.zeros(self.num_envs, np.int64)

    def reset(self) -> NDArray[Any]:
        """Reset all environments, with the seeds set by `seed`."""
        if any(self._options):
            raise ValueError(f"options must be empty, got {self._options!r}")
        resets = [
            # It takes one seed per environment, despite its annotation.
            batch.reset(seed=cast("int", list(self._seeds[part])))
            for batch, part in self._parts
        ]
        self._reset_seeds()
        self._returns[:], self._lengths[:] = 0.0, 0
        return self._joined(resets)[0]

    def step_async(self, actions: NDArray[Any]) -> None:
        """Store the actions, shape (num_envs, action size)."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Step with the stored actions."""
        steps = [batch.step(self._actions[part]) for batch, part in self._parts]
        observations, rewards, terminated, truncated = self._joined(steps)
        ended = terminated | truncated
        self._returns += rewards
        self._lengths += 1
        infos: list[dict[str, Any]] = [{} for _ in ended]
        if ended.any():
            last = np.concatenate(
                [found.get("final_obs", [None] * len(flags)) for *_, flags, found in steps]
            )
            seconds = round(time.time() - self._began, 6)
            for i in np.flatnonzero(ended).tolist():
                episode = {"r": float(self._returns[i]), "l": int(self._lengths[i])}
                infos[i] = {
                    "terminal_observation": last[i],
                    "TimeLimit.truncated": bool(truncated[i] and not terminated[i]),
                    "episode": {**episode, "t": seconds},
                }
            self._returns[ended], self._lengths[ended] = 0.0, 0
        return observations, rewards.astype(np.float32), ended, infos

    def _joined(self, returned: list[tuple[Any, ...]]) -> list[NDArray[Any]]:
        """Concatenate what the batches returned, and store the infos in `infos`."""
        *arrays, infos = zip(*returned, strict=True)
        self.infos = {
            name: np.concatenate([each[name] for each in infos])
            for name in set.intersection(*map(set, infos))
            if isinstance(infos[0][name], np.ndarray)
        }
        return [np.concatenate(each) for each in arrays]

    def get_images(self) -> list[NDArray[np.uint8]]:
        """Return a picture of each environment, if the batch has the mode "rgb_array"."""
        return [image for batch in self.batches for image in cast("Any", batch.render() or ())]

    def close(self) -> None:
        """Close the batches."""
        for batch in self.batches:
            batch.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of each environment's batch."""
        if attr_name == "render_mode":
            # Asked by an outer wrapper, which may change what a model sees: the space then no
            # longer tells how the model was trained, and only `save` records it.
            vars(self.observation_space).pop("trained_on", None)
        if attr_name == "spec" and self.spec is not None:
            return [self.spec for _ in self._get_indices(indices)]
        of_each = [batch for batch in self.batches for _ in range(batch.num_envs)]
        return [getattr(of_each[i], attr_name) for i in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Refuse: an environment of a batch has no attributes of its own."""
        raise NotImplementedError(f"{attr_name} can be set on `batches` only, for all at once")

    def env_method(
        self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any
    ) -> list[Any]:
        """Refuse: an environment of a batch has no methods of its own."""
        raise NotImplementedError(
            f"{method_name} can be called on `batches` only, for all at once"
        )

    def env_is_wrapped(self, wrapper_class: Any, indices: VecEnvIndices = None) -> list[bool]:
        """Return False for each index: a batch holds no wrapped environments."""
        return [False for _ in self._get_indices(indices)]


def save(model: BaseAlgorithm, path: str | Path) -> None:
    """Save a model atomically, with the spec of its training environment.

    For a model trained on `make_vec_env` without further wrappers, `model.save` keeps the spec,
    too. This function also saves the statistics of `VecNormalize`.

    Parameters
    ----------
    model
        A model with its training environment.
    path
        Path of the zip.

    Raises
    ------
    ValueError
        If it is unknown how the model was trained, or its spec cannot be written as JSON.
    """
    spec = trained_on(model)
    if spec is None:
        reject("model", model, "trained on make_vec_env or on environments that have a spec")
    path = Path(path)
    partial = path.with_name(f".{path.stem}.{os.getpid()}.zip")
    # A model saves its space with all attributes.
    space: Any = model.observation_space
    kept: Any = copy.deepcopy(space)
    kept.trained_on = spec.to_json()
    normaliser = model.get_vec_normalize_env()
    if normaliser is not None and normaliser.norm_obs:
        statistics = cast("RunningMeanStd", normaliser.obs_rms)
        kept.normalised = {
            "mean": statistics.mean.tolist(),
            "var": statistics.var.tolist(),
            "epsilon": normaliser.epsilon,
            "clip_obs": normaliser.clip_obs,
        }
    model.observation_space = kept
    try:
        model.save(partial)
        partial.replace(path)
    finally:
        model.observation_space = space
        partial.unlink(missing_ok=True)


def spec_of(policy: Any, env: str | EnvSpec = "MiddlePoint-v0", **arguments: Any) -> EnvSpec:
    """Return the spec of an environment with the windows and wrappers of a policy's training.

        evaluate(model, spec_of(model, "MiddlePointHard-v0"))

    Parameters
    ----------
    policy
        A model, or the path of a zip. No code from the zip is run.
    env
        The environment to evaluate on: an id or an `EnvSpec`.
    **arguments
        Further arguments for the environment.

    Raises
    ------
    ValueError
        If it is unknown how the policy was trained.
    """
    trained = trained_on(policy)
    if trained is None:
        allowed = (
            "one that knows how it was trained: train it on mptc_gym.sb3.make_vec_env, or save "
            "it by mptc_gym.sb3.save"
        )
        in_file = isinstance(policy, str | Path)
        reject("policy", str(policy) if in_file else type(policy).__name__, allowed)
    windows: dict[str, Any] = {n: trained.kwargs[n] for n in WINDOWS if n in trained.kwargs}
    with closing(make_one(env, {**windows, **arguments})) as single:
        spec = cast("EnvSpec", single.spec)
    spec.additional_wrappers = tuple(action_wrappers(trained))
    return spec


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
        self._next = self.num_timesteps + self.every

    def _on_step(self) -> bool:
        if self.num_timesteps >= self._next:
            self._next += self.every
            self._score()
        return True

    def _on_training_end(self) -> None:
        if not self.scores or self.scores[-1][0] < self.num_timesteps:
            self._score()

    def _score(self) -> None:
        found = evaluate(self.model, self._spec, episodes=self.episodes, seed=SEED + EPISODES)
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
