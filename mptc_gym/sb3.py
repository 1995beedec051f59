"""Train with Stable-Baselines3 on a batch of plants, and save models with their spec.

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
import zipfile
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import accumulate, pairwise, starmap
from pathlib import Path
from typing import Any, NoReturn, cast

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env import sync_envs_normalization as synchronise
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from mptc_gym.acting import check_fit, make_one, native_batch, natives, opened, overlap
from mptc_gym.checks import MOST_PLANTS, count, reject
from mptc_gym.evaluation import EPISODES, SEED, WINDOWS, Evaluation, evaluate
from mptc_gym.wrappers import IncrementalAction

__all__ = ["GymnasiumVecEnv", "ScoreCallback", "load", "make_vec_env", "save", "spec_of"]

MEMBER = "mptc_gym.json"  # of a zip
_SAME_STEP = AutoresetMode.SAME_STEP


class GymnasiumVecEnv(VecEnv):
    """Step whole batches at once, where `DummyVecEnv` steps one environment after another.

    All that it returns is bit for bit that of `DummyVecEnv` with the same environments, but for
    infos: `step` lists those of last samples only, as dicts would take longer than the step,
    and `infos` holds the latest of all in Gymnasium's form, as arrays.

    Parameters
    ----------
    batches
        Vector environments of autoreset mode "SameStep" and with the same spaces; their
        environments are numbered one batch after another.
    spec, group
        Spec of one environment with its wrappers, if all are alike; and number of neighbours
        that share a seed, and thus what is drawn.
    """

    def __init__(
        self, *batches: VectorEnv, spec: EnvSpec | None = None, group: int = 1
    ) -> None:
        modes = {batch.metadata.get("autoreset_mode") for batch in batches}
        if modes != {_SAME_STEP}:
            raise ValueError(f"batches must have autoreset_mode 'SameStep', got {modes}")
        self.batches, self.spec, self.group = batches, spec, group
        self.infos: dict[str, Any] = {}
        # Of each environment, the number of its batch and its own number there.
        self._places = [(i, j) for i, each in enumerate(batches) for j in range(each.num_envs)]
        edges = accumulate((batch.num_envs for batch in batches), initial=0)
        self._parts: Any = [*zip(batches, starmap(slice, pairwise(edges)), strict=True)]
        spaces = batches[0].single_observation_space, batches[0].single_action_space
        super().__init__(len(self._places), *spaces)
        self._totals = np.zeros((2, self.num_envs))  # return and length of each episode

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Set the seeds of the next reset: environment i has `seed + i // group`."""
        first, *_ = super().seed(seed)
        self._seeds = [cast("int", first) + i // self.group for i in range(self.num_envs)]
        return self._seeds

    def reset(self) -> NDArray[Any]:
        """Reset all environments, with the seeds set by `seed`."""
        resets = [batch.reset(seed=self._seeds[part]) for batch, part in self._parts]
        self._reset_seeds()
        self._totals[:] = 0.0
        self.reset_infos = [_alone(resets[i][-1], j) for i, j in self._places]
        return self._joined(resets)[0]

    def step_async(self, actions: NDArray[Any]) -> None:
        """Store the actions, shape (num_envs, action size)."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Step with the stored actions."""
        steps = [batch.step(self._actions[part]) for batch, part in self._parts]
        observations, rewards, terminated, truncated = self._joined(steps)
        ended = terminated | truncated
        self._totals[0] += rewards
        self._totals[1] += 1.0
        infos: list[dict[str, Any]] = [{} for _ in ended]
        for place in np.flatnonzero(ended).tolist():
            i, j = self._places[place]
            *_, found = steps[i]
            gained, length = self._totals[:, place].tolist()
            self.reset_infos[place] = _alone(found, j)
            infos[place] = {
                **_alone(found["final_info"], j),
                "terminal_observation": found["final_obs"][j],
                "TimeLimit.truncated": bool(truncated[place] and not terminated[place]),
                "episode": {"r": gained, "l": int(length)},
            }
        self._totals[:, ended] = 0.0
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
        chosen = [self.batches[self._places[i][0]] for i in self._get_indices(indices)]
        return [self.spec if attr_name == "spec" else getattr(b, attr_name) for b in chosen]

    def env_method(self, *args: Any, **kwargs: Any) -> NoReturn:
        """Refuse: an environment of a batch has no methods or attributes of its own."""
        raise NotImplementedError(f"use `batches`, for all at once, got {args or kwargs}")

    set_attr = env_method

    def env_is_wrapped(self, wrapper_class: Any, indices: VecEnvIndices = None) -> list[bool]:
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

    Parameters
    ----------
    env, **arguments
        An id or an `EnvSpec`, and further arguments for it, as in `gymnasium.make`;
        `render_mode` may be "rgb_array".
    n_envs
        Number of plants.
    seed
        Seed of the first plant at the first reset; plant i has `seed + i // group`. The seed of
        a model, if it has one, replaces it.
    group
        Number of neighbouring plants that share a seed: they draw the same noise, load and
        set points, and differ only in what a policy explores.
    wrapper
        Adds `IncrementalAction`: its arguments, or the class itself for its defaults. Others
        cannot take a batch: use `stable_baselines3.common.env_util.make_vec_env`.
    """
    n_envs = count("n_envs", n_envs, 1, MOST_PLANTS)
    group = count("group", group, 1, n_envs)
    mode = arguments.pop("render_mode", None)  # of the batch alone, not of its spec
    single = make_one(env, arguments)
    if isinstance(wrapper, Mapping):
        single = IncrementalAction(single, **wrapper)
    elif callable(wrapper):
        single = wrapper(single)
    elif wrapper is not None:
        reject("wrapper", wrapper, "the arguments of IncrementalAction, or the class itself")
    batch = native_batch(single, n_envs, autoreset_mode=_SAME_STEP, render_mode=mode)
    if batch is None:
        reject("env", single, "of this package, in no wrapper other than IncrementalAction")
    plants = GymnasiumVecEnv(batch, spec=single.spec, group=group)
    plants.seed(seed)
    return plants


def spec_of(policy: Any, env: str | EnvSpec = "MiddlePoint-v0", **arguments: Any) -> EnvSpec:
    """Return the spec of an id or spec with the windows and wrappers of a model's environments.

        evaluate(model, spec_of(model, "MiddlePointHard-v0"))

    Wrappers of Stable-Baselines3, such as `VecNormalize`, are not in a spec. ValueError if the
    model's environments cannot be made from theirs.
    """
    own, (plant, *_) = _spec(policy), natives(policy.get_env())
    windows = dict(zip(WINDOWS, plant.parameters.windows, strict=True))
    spec = cast("EnvSpec", make_one(env, {**windows, **arguments}).spec)
    return dataclasses.replace(spec, additional_wrappers=own.additional_wrappers)


def _spec(model: Any) -> EnvSpec:
    """Return the spec of the first of a model's environments, if that makes one."""
    spec: Any = None
    try:
        spec, *_ = model.get_env().get_attr("spec")
        # Gymnasium cannot make the Monitor that each model adds, and it changes nothing.
        kept = tuple(each for each in spec.additional_wrappers if each.name != "Monitor")
        spec = dataclasses.replace(spec, additional_wrappers=kept)
        gymnasium.make(EnvSpec.from_json(spec.to_json()))
    except Exception as error:  # from wrappers of anybody
        raise ValueError(
            "policy must be a model with its environments (see mptc_gym.sb3.load), which must "
            "come from gymnasium.make or make_vec_env, in wrappers that can be imported and "
            "record their arguments, as gymnasium.utils.RecordConstructorArgs does, got "
            f"{spec}: {error}"
        ) from error
    return cast("EnvSpec", spec)


def save(model: BaseAlgorithm, path: str | Path) -> None:
    """Save a model atomically, with the spec of its environments.

    The zip is that of `model.save` with one more member; `.zip` is added to a name without an
    ending. A `VecEnvWrapper`, such as `VecNormalize`, is no part of a spec: a model in one is
    saved as Stable-Baselines3 does. ValueError if the environments differ or cannot be made
    from their spec, or the file cannot be written.
    """
    path, spec, plants = _zip_path(path), _spec(model), cast("VecEnv", model.get_env())
    if isinstance(plants, VecEnvWrapper) or len({str(s) for s in plants.get_attr("spec")}) > 1:
        raise ValueError(
            "policy must have environments that do not differ, in no VecEnvWrapper, to be "
            f"saved here, got {type(plants).__name__}: save it by model.save(path), and "
            "statistics by model.get_vec_normalize_env().save(path)"
        )
    algorithm = f"{type(model).__module__}:{type(model).__name__}"
    record = json.dumps({"algorithm": algorithm, "spec": spec.to_json()})
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


def load(path: str | Path, **arguments: Any) -> BaseAlgorithm:
    """Load a model that `save` wrote, with as many environments like its own.

    Loading runs code from the zip and the modules that it names: load only what you trust.
    `arguments` are those of the algorithm's own `load`, such as `device="cpu"`. A file that
    cannot be loaded is a ValueError.
    """
    path = _zip_path(path)
    try:
        with zipfile.ZipFile(path) as archive:
            about, data = (json.loads(archive.read(name)) for name in (MEMBER, "data"))
        spec, n = EnvSpec.from_json(about["spec"]), data["n_envs"]
        one = partial(gymnasium.make, spec)
        native = native_batch(one(), 1) is not None
        plants: VecEnv = make_vec_env(spec, n) if native else DummyVecEnv([one] * n)
        algorithm = pkgutil.resolve_name(about["algorithm"])
        return cast("BaseAlgorithm", algorithm.load(path, plants, **arguments))
    except Exception as error:  # of any kind, from a damaged file or the code in it
        raise ValueError(
            f"{path} must be a zip of mptc_gym.sb3.save; others are loaded by their algorithm, "
            f"and scored where you say that they act ({type(error).__name__}: {error})"
        ) from error


def _zip_path(path: str | Path) -> Path:
    """Return the path of a zip, whose ending may be left out, as in Stable-Baselines3."""
    path = Path(path)
    return path if path.suffix else path.with_suffix(".zip")


class ScoreCallback(BaseCallback):
    """Score the policy during training, without exploration, and keep the best.

    The episodes differ from those of `mptc_gym.evaluate`. Where nothing is drawn, as in
    `MiddlePoint-v0`, all are the same: select by another set point, `setpoint_period=500`. The
    log gets `score/mean_error` and, with a bound, `score/score`.

    Parameters
    ----------
    env, **arguments
        Where to score, as in `mptc_gym.evaluate`; never the environments of the training. An id
        or a spec takes the windows and wrappers of the training, see `spec_of`. A
        `VecNormalize` is given the statistics of the training before each score.
    every, episodes
        Samples of experience between scores, the last at the end of training; and episodes per
        score. Where bounds differ by episode, there are only 20 of them.
    path
        Zip in which to keep the policy with the least mean error, if any; see `save`.
    verbose
        1 prints each score, 0 does not.

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
        self.scores: list[tuple[int, Evaluation]] = []
        self.best: Evaluation | None = None
        self._env, self._arguments = env, arguments

    def _init_callback(self) -> None:
        env, arguments = self._env, self._arguments
        if isinstance(env, str | EnvSpec):
            env, arguments = spec_of(self.model, env, **arguments), {}
        elif overlap(env, self.training_env):
            raise ValueError("env must not be the environments of the training: make others")
        self._latest = self.model.num_timesteps
        # Not kept in place of the id: the next model may have other windows.
        self._score_in: Any = partial(evaluate, env=env, **arguments)
        self._hand_over()
        if self.path is not None:  # what cannot be saved, or not there, is said now
            trial = self.path.with_name(f".{self.path.name}")
            save(self.model, trial)
            trial.unlink()
        if isinstance(env, EnvSpec) or callable(env):
            with opened(env, 1) as plants:
                check_fit(self.model, plants)

    def _hand_over(self) -> None:
        """Give the statistics of the training to the environments of the scores."""
        if self.model.get_vec_normalize_env() is None or not isinstance(self._env, VecEnv):
            return
        try:
            synchronise(self.training_env, self._env)
        except (AssertionError, AttributeError) as error:
            raise ValueError(f"env must be wrapped as in training: {error}") from error

    def _on_step(self) -> bool:
        if self.num_timesteps >= self._latest + self.every:
            self._score()
        return True

    def _on_training_end(self) -> None:
        if self.num_timesteps > self._latest:
            self._score()

    def _score(self) -> None:
        self._hand_over()
        self._latest = now = self.num_timesteps
        found = self._score_in(self.model, episodes=self.episodes, seed=SEED + EPISODES)
        self.scores.append((now, found))
        self.logger.record("score/mean_error", found.mean_error)
        if found.score is not None:
            self.logger.record("score/score", found.score)
        best = self.best is None or found.mean_error < self.best.mean_error
        self.best = found if best else self.best
        if best and self.path is not None:
            save(self.model, self.path)
        if self.verbose:
            total = self.locals.get("total_timesteps", now)
            print(f"{now:,} of {total:,} samples: {found}{'; best' * best}", flush=True)
