"""Train with Stable-Baselines3 on a batch of plants, and keep how a policy was trained.

    from stable_baselines3 import PPO
    from mptc_gym.sb3 import ScoreCallback, make_vec_env

    plants = make_vec_env("MiddlePoint-v0", 64, seed=0, wrapper={"undo_dead_zone": True},
                          action_window=20, setpoint="random")
    model = PPO("MlpPolicy", plants, n_steps=64).learn(200_000, ScoreCallback(path="best.zip"))

It needs `pip install "mptc_gym[sb3]"`.
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
    """Make plants that are stepped at once, for the algorithms of Stable-Baselines3.

    A model that is trained on them knows how, and `model.save` saves it: `spec_of` reads it.
    The infos of an episode's end have its return, as `Monitor` has it.

    Parameters
    ----------
    env
        An id or an `EnvSpec`.
    n_envs
        How many plants.
    seed
        Of the first plant at the first reset; plant i has `seed + i`. A model with a seed sets
        it, too.
    wrapper
        Asks for `IncrementalAction`: its arguments, or the class for its defaults.
    **arguments
        More arguments for the id, as of `gymnasium.make`; `render_mode` may be "rgb_array".

    Raises
    ------
    ValueError
        If an argument is out of range, or there is another wrapper, which does not take a
        batch; `stable_baselines3.common.env_util.make_vec_env` is for those.
    """
    n_envs = count("n_envs", n_envs, 1, MOST_PLANTS)
    arguments = {name: plain(value) for name, value in arguments.items()}
    render_mode = arguments.pop("render_mode", None)  # no part of how a policy is trained
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
    """Steps a whole batch at once where `DummyVecEnv` goes from one environment to the next.

    Observations, rewards, ends and terminal observations are, to the bit, those of
    `DummyVecEnv` with the same environments.

    Parameters
    ----------
    batches
        One or more, of autoreset mode "SameStep" and with the same spaces; their environments
        are numbered one batch after the other.
    spec
        Of one of the environments with its wrappers, if they are all alike: what a model that
        is trained on them remembers.

    Attributes
    ----------
    infos : dict
        The last infos as Gymnasium gives them, in arrays; those that all batches have. The list
        that `step` returns holds only what Stable-Baselines3 itself reads at the end of an
        episode, as dicts for each environment and step would take longer than the step.

    Raises
    ------
    ValueError
        If an autoreset mode is another one, or spaces differ.
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
        """Reset all environments, with the seeds that were set by `seed`."""
        if any(self._options):
            raise ValueError(f"options must be empty, got {self._options!r}")
        resets = [
            # It takes a seed for each environment, whatever its annotation says.
            batch.reset(seed=cast("int", list(self._seeds[part])))
            for batch, part in self._parts
        ]
        self._reset_seeds()
        self._returns[:], self._lengths[:] = 0.0, 0
        return self._joined(resets)[0]

    def step_async(self, actions: NDArray[Any]) -> None:
        """Take note of the actions, shape (num_envs, action size)."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Step with them."""
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
        """Put what the batches returned one after the other, the infos in `infos`."""
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
            # Asked by a wrapper that is put around these: a model may see something else then,
            # so that it does not know how it was trained from its space, but by `save` alone.
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
    """Save a model with the spec of what it was trained on, whole or not at all.

    A model that was trained on `make_vec_env`, in no other wrapper, does so by its own `save`.
    This one also saves the statistics of `VecNormalize`.

    Parameters
    ----------
    model
        Has its training environment.
    path
        Of the zip.

    Raises
    ------
    ValueError
        If it is not known how the model was trained, or a zip could not hold it.
    """
    spec = trained_on(model)
    if spec is None:
        reject("model", model, "trained on make_vec_env or on environments that have a spec")
    path = Path(path)
    partial = path.with_name(f".{path.stem}.{os.getpid()}.zip")
    # Models save their space with all its attributes.
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
    """Return an environment as a policy sees it: with the windows and wrappers of its training.

        evaluate(model, spec_of(model, "MiddlePointHard-v0"))

    Parameters
    ----------
    policy
        A model, or the path of a zip. No code of the zip is run.
    env
        The environment to judge it on, an id or an `EnvSpec`.
    **arguments
        More arguments for it.

    Raises
    ------
    ValueError
        If it is not known how the policy was trained.
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
    """Scores the policy while it is trained, without exploration, and keeps the best.

    The episodes are others than those of `mptc_gym.evaluate`, so that they may choose the
    policy. Where nothing is drawn, as in `MiddlePoint-v0`, all episodes are the same: choose by
    another set point, such as `setpoint_period=500`. The log gets `score/mean_error` and, where
    there is a bound, `score/score`.

    Parameters
    ----------
    env
        What to score it on: an id, or an `EnvSpec`. Windows and wrappers are those of the
        training.
    every
        Samples of experience from one score to the next; there is one at the end, too.
    episodes
        How many a score is the mean of, up to 20 where episodes have bounds of their own.
    path
        Where the best policy is kept, by mean error, if anywhere: a zip.
    verbose
        1 prints each score, 0 does not.
    **arguments
        More arguments for `env`.

    Attributes
    ----------
    scores : list of (int, Evaluation)
        What was found, after how many samples.
    best : Evaluation or None
        The best of them.
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
