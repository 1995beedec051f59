"""Train with Stable-Baselines3 on a batch of plants, and save models with their spec.

    from stable_baselines3 import PPO
    from mptc_gym.sb3 import ScoreCallback, make_vec_env

    plants = make_vec_env("MiddlePoint-v0", 64, seed=0, wrapper={"compensate_dead_zone": True},
                          action_window=20, setpoint="random")
    model = PPO("MlpPolicy", plants, n_steps=64).learn(200_000, ScoreCallback(path="best.zip"))

Requires `pip install "mptc_gym[sb3]"`.
"""

from __future__ import annotations

import dataclasses
import json
import pkgutil
import tempfile
import time
import zipfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, cast

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecEnv,
    VecEnvWrapper,
    sync_envs_normalization,
)  # fmt: skip
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from mptc_gym import environments
from mptc_gym.checks import MOST_PLANTS, count, plain, reject
from mptc_gym.evaluation import (
    EPISODES,
    SEED,
    WINDOWS,
    Evaluation,
    evaluate,
    make_one,
    native_batch,
)  # fmt: skip
from mptc_gym.wrappers import IncrementalAction
from mptc_gym.wrappers.vector import IncrementalAction as VectorIncrementalAction

__all__ = ["GymnasiumVecEnv", "ScoreCallback", "load", "make_vec_env", "save", "spec_of"]

MEMBER = "mptc_gym.json"  # of a zip


class GymnasiumVecEnv(VecEnv):
    """Step whole batches at once, where `DummyVecEnv` steps one environment after another.

    Observations, rewards, episode ends, terminal observations, and the infos of the last sample
    and of a reset are bit for bit those of `DummyVecEnv` with the same environments.

    Parameters
    ----------
    batches
        One or more vector environments of autoreset mode "SameStep" and with the same spaces;
        their environments are numbered one batch after another.
    spec
        Spec of one environment with its wrappers, if all are alike.
    group
        Number of neighbouring environments that share a seed, and thus what is drawn.

    Attributes
    ----------
    infos : dict
        The latest infos in Gymnasium's form, as arrays. The list that `step` returns holds
        infos only where an episode ends, as dicts would take longer than the step.

    Raises
    ------
    ValueError
        If a batch has another autoreset mode, or spaces differ.
    """

    def __init__(
        self, *batches: VectorEnv, spec: EnvSpec | None = None, group: int = 1
    ) -> None:
        spaces = batches[0].single_observation_space, batches[0].single_action_space
        for batch in batches:
            mode = batch.metadata.get("autoreset_mode")
            if mode is not AutoresetMode.SAME_STEP:
                raise ValueError(f"batches must have autoreset_mode 'SameStep', got {mode}")
            if (batch.single_observation_space, batch.single_action_space) != spaces:
                raise ValueError(f"batches must have the same spaces, got {batches}")
        self.batches, self.spec, self.group = batches, spec, group
        self.infos: dict[str, Any] = {}
        starts = np.cumsum([0, *(batch.num_envs for batch in batches)]).tolist()
        self._parts = list(zip(batches, map(slice, starts, starts[1:]), strict=True))
        super().__init__(starts[-1], *spaces)
        self._began = time.time()
        self._returns = np.zeros(self.num_envs)
        self._lengths = np.zeros(self.num_envs, np.int64)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Set the seeds of the next reset: environment i has `seed + i // group`."""
        first, *_ = super().seed(seed)
        self._seeds = [cast("int", first) + i // self.group for i in range(self.num_envs)]
        return self._seeds

    def reset(self) -> NDArray[Any]:
        """Reset all environments, with the seeds set by `seed`."""
        if any(self._options):
            raise ValueError(f"options must be empty, got {self._options!r}")
        # A batch takes one seed per environment, despite its annotation.
        resets = [batch.reset(seed=cast("int", self._seeds[own])) for batch, own in self._parts]
        self._reset_seeds()
        self._returns[:], self._lengths[:] = 0.0, 0
        self.reset_infos = [
            _alone(infos, i)
            for batch, (_, infos) in zip(self.batches, resets, strict=True)
            for i in range(batch.num_envs)
        ]
        return self._joined(resets)[0]

    def step_async(self, actions: NDArray[Any]) -> None:
        """Store the actions, shape (num_envs, action size)."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Step with the stored actions."""
        steps = [batch.step(self._actions[own]) for batch, own in self._parts]
        observations, rewards, terminated, truncated = self._joined(steps)
        ended = terminated | truncated
        self._returns += rewards
        self._lengths += 1
        infos: list[dict[str, Any]] = [{} for _ in ended]
        for (_, own), (*_, found) in zip(self._parts, steps, strict=True):
            for j in np.flatnonzero(ended[own]).tolist():
                i = own.start + j
                self.reset_infos[i] = _alone(found, j)
                episode = {"r": float(self._returns[i]), "l": int(self._lengths[i])}
                infos[i] = {
                    **_alone(found["final_info"], j),
                    "terminal_observation": found["final_obs"][j],
                    "TimeLimit.truncated": bool(truncated[i] and not terminated[i]),
                    "episode": {**episode, "t": round(time.time() - self._began, 6)},
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
        """Return an attribute of each environment's batch, but its own `spec`."""
        of_each = [batch for batch in self.batches for _ in range(batch.num_envs)]
        if attr_name == "spec":
            return [self.spec for _ in self._get_indices(indices)]
        return [getattr(of_each[i], attr_name) for i in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Refuse: an environment of a batch has no attributes of its own."""
        raise NotImplementedError(f"{attr_name} can be set on `batches` only, for all at once")

    def env_method(
        self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any
    ) -> list[Any]:
        """Refuse: an environment of a batch has no methods of its own."""
        raise NotImplementedError(f"{method_name} can be called on `batches` only")

    def env_is_wrapped(
        self, wrapper_class: type[Any], indices: VecEnvIndices = None
    ) -> list[bool]:
        """Return False for each index: a batch holds no wrapped environments."""
        return [False for _ in self._get_indices(indices)]


def _alone(infos: Mapping[str, Any], i: int) -> dict[str, Any]:
    """Return the infos of environment i of a batch, as it would give them alone."""
    return {
        name: values[i].item() if isinstance(values[i], np.generic) else values[i]
        for name, values in infos.items()
        if f"_{name}" in infos and infos[f"_{name}"][i] and not name.startswith("final_")
    }


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

    At the end of an episode, its infos hold the return, as with `Monitor`.

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
    render_mode = arguments.pop("render_mode", None)  # of the batch alone, not of its spec
    single = make_one(env, arguments)
    if getattr(wrapper, "func", wrapper) is VectorIncrementalAction:
        wrapper = getattr(wrapper, "keywords", {})
    if isinstance(wrapper, Mapping):
        single = IncrementalAction(single, **wrapper)
    elif callable(wrapper):
        single = wrapper(single)
    elif wrapper is not None:
        reject("wrapper", wrapper, "the arguments of IncrementalAction, or the class itself")
    with closing(single):
        batch, spec = native_batch(single), single.spec
    if batch is None:
        raise ValueError(f"wrapper must be IncrementalAction, got {single}")
    many = batch(n_envs, autoreset_mode=AutoresetMode.SAME_STEP, render_mode=render_mode)
    plants = GymnasiumVecEnv(many, spec=spec, group=group)
    plants.seed(seed)
    return plants


def spec_of(policy: Any, env: str | EnvSpec = "MiddlePoint-v0", **arguments: Any) -> EnvSpec:
    """Return the spec of an environment with the windows and wrappers of a model's own.

        evaluate(model, spec_of(model, "MiddlePointHard-v0"))

    Those of Stable-Baselines3, such as `VecNormalize`, are not among them.

    Parameters
    ----------
    policy
        A model that has its environments.
    env
        An id or an `EnvSpec`, whose own windows and wrappers are replaced.
    **arguments
        Further arguments for the environment, other than windows.

    Raises
    ------
    ValueError
        If the model has no environments, if these cannot be made from a spec, or if an argument
        is another window than theirs.
    """
    own = _spec(policy)
    with closing(make_one(own, {})) as single:
        (plant,) = environments.plants_of(single)
    windows = {name: getattr(plant.parameters, name) for name in WINDOWS}
    for name, value in windows.items():
        if arguments.get(name, value) != value:
            raise ValueError(
                f"{name} must be that of policy's training, {value}, got {arguments[name]}"
            )
    if isinstance(env, EnvSpec):
        env = dataclasses.replace(env, additional_wrappers=())
    with closing(make_one(env, {**arguments, **windows})) as single:
        spec = cast("EnvSpec", single.spec)  # gymnasium.make sets it
    return dataclasses.replace(spec, additional_wrappers=own.additional_wrappers)


def _spec(model: Any) -> EnvSpec:
    """Return the spec of one of a model's environments, if that makes one like it."""
    plants = model.get_env() if isinstance(model, BaseAlgorithm) else None
    if plants is None:
        raise ValueError(
            "policy must be a model with its environments: load it by mptc_gym.sb3.load, or "
            "give it some by set_env"
        )
    spec, *_ = plants.get_attr("spec")
    try:
        # Gymnasium cannot make the Monitor that each model adds, and it changes nothing.
        kept = [each for each in spec.additional_wrappers if each.name != "Monitor"]
        spec = dataclasses.replace(spec, additional_wrappers=tuple(kept))
        with closing(gymnasium.make(EnvSpec.from_json(spec.to_json()))) as single:
            made = single.observation_space, single.action_space
            own = plants.unwrapped
            if made != (own.observation_space, own.action_space):
                raise ValueError(f"it makes {single}")
    except Exception as error:  # from wrappers of anybody
        raise ValueError(
            "policy's environments must come from gymnasium.make or make_vec_env, in wrappers "
            "that can be imported and record their arguments "
            f"(gymnasium.utils.RecordConstructorArgs), got {spec}: {error}"
        ) from error
    return cast("EnvSpec", spec)


def save(model: BaseAlgorithm, path: str | Path) -> None:
    """Save a model atomically, with the spec of its environments.

    The zip is that of `model.save` with one more member, `mptc_gym.json`.

    Parameters
    ----------
    model
        A model with its environments. A `VecEnvWrapper` around them, such as `VecNormalize` or
        `VecFrameStack`, is no part of a spec: save such a model as Stable-Baselines3 does, by
        `model.save` and `VecNormalize.save`.
    path
        Path of the zip; `.zip` is added to a name without an ending.

    Raises
    ------
    ValueError
        If the environments cannot be made from their spec, or the file cannot be written.
    """
    record, path = _record(model), _zip_path(path)
    try:
        # A folder of its own: whatever the name, nobody else writes there.
        with tempfile.TemporaryDirectory(prefix=".", dir=path.parent) as folder:
            partial_zip = Path(folder, "model.zip")
            model.save(partial_zip)
            with zipfile.ZipFile(partial_zip, "a") as archive:
                archive.writestr(MEMBER, record)
            partial_zip.replace(path)
    except OSError as error:
        raise ValueError(f"{path} cannot be written: {error.strerror}") from error


def _record(model: BaseAlgorithm) -> str:
    """Return what `save` adds to a model's zip."""
    spec = _spec(model)
    if isinstance(outermost := model.get_env(), VecEnvWrapper):
        raise ValueError(
            f"policy must not be in {type(outermost).__name__} to be saved here: save it by "
            "model.save(path), and the statistics by model.get_vec_normalize_env().save(path)"
        )
    kind = type(model)
    return json.dumps(
        {"algorithm": f"{kind.__module__}:{kind.__name__}", "spec": spec.to_json()}
    )


def load(path: str | Path, **arguments: Any) -> BaseAlgorithm:
    """Load a model that `save` wrote, with as many environments like its own.

    Loading runs code from the zip and from the modules that it names: load only what you trust.

    Parameters
    ----------
    path
        Path of the zip.
    **arguments
        Further arguments for the `load` of the algorithm, such as `device="cpu"`.

    Raises
    ------
    ValueError
        If the zip cannot be read, has no spec, or cannot be loaded.
    """
    path = _zip_path(path)
    try:
        with zipfile.ZipFile(path) as archive:
            if MEMBER not in archive.namelist():
                raise ValueError(
                    "it was not saved by mptc_gym.sb3.save: load it by its algorithm, and give "
                    "evaluate the environment that it acts in"
                )
            about, n = (
                json.loads(archive.read(MEMBER)),
                json.loads(archive.read("data"))["n_envs"],
            )
        spec, kind = EnvSpec.from_json(about["spec"]), pkgutil.resolve_name(about["algorithm"])
        with closing(make_one(spec, {})) as single:
            native = native_batch(single)
        plants: Any = (
            make_vec_env(spec, n)
            if native
            else DummyVecEnv([partial(gymnasium.make, spec)] * n)
        )
        return cast("BaseAlgorithm", kind.load(path, plants, **arguments))
    except Exception as error:  # of any kind, from a damaged file or the code in it
        raise ValueError(f"{path} cannot be loaded: {type(error).__name__}: {error}") from error


def _zip_path(path: str | Path) -> Path:
    """Return the path of a zip, whose ending may be left out, as in Stable-Baselines3."""
    path = Path(path)
    return path if path.suffix else path.with_suffix(".zip")


class ScoreCallback(BaseCallback):
    """Score the policy during training, without exploration, and keep the best.

    The default episodes of `mptc_gym.evaluate` are not used, so they stay free for the final
    score. Where nothing is drawn, as in `MiddlePoint-v0`, all episodes are the same: select by
    another set point, such as `setpoint_period=500`. The log gets `score/mean_error` and, where
    there is a bound, `score/score`.

    Parameters
    ----------
    env
        Where to score, as in `mptc_gym.evaluate`; never the environments of the training. An id
        or a spec takes the windows and wrappers of the training, see `spec_of`. A
        `VecNormalize` is given the statistics of the training before each score.
    every
        Samples of experience between scores; the end of training is scored, too.
    episodes
        Number of episodes per score. Where bounds differ by episode, there are only 20 of them.
    path
        Zip in which to keep the policy with the least mean error, if any; see `save`.
    verbose
        1 prints each score, 0 does not.
    **arguments
        More arguments for an id or a spec.

    Attributes
    ----------
    scores : list of (int, Evaluation)
        Samples of experience and result of each score.
    best : Evaluation or None
        The result with the least mean error.
    """

    def __init__(
        self,
        env: Any = "MiddlePoint-v0",
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
        self.path = None if path is None else _zip_path(path)
        if path and (Path(path).is_dir() or not Path(path).parent.is_dir()):
            reject("path", path, "the name of a zip in a folder that exists, not a folder")
        self.scores: list[tuple[int, Evaluation]] = []
        self.best: Evaluation | None = None
        self._env, self._arguments = env, arguments

    def _init_callback(self) -> None:
        self._where, self._further = self._env, self._arguments
        if isinstance(self._env, str | EnvSpec):
            self._where, self._further = spec_of(self.model, self._env, **self._arguments), {}
        elif not callable(self._env) and environments.shared(self._env, self.training_env):
            raise ValueError("env must not be the environments of the training: make others")
        self._synchronise()
        if self.path is not None:
            _record(self.model)  # now, rather than when it is to be saved

    def _synchronise(self) -> None:
        """Give the statistics of the training to the environments of the scores."""
        if isinstance(self._where, VecEnv) and environments.stacks_and_normalisers(
            self.training_env
        ):
            try:
                sync_envs_normalization(self.training_env, self._where)
            except (AssertionError, AttributeError) as error:
                raise ValueError(
                    f"env must be wrapped like the environments of the training: {error}"
                ) from error

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
        self._synchronise()
        seed = SEED + EPISODES
        found = evaluate(
            self.model, self._where, episodes=self.episodes, seed=seed, **self._further
        )
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
