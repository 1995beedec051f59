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
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, cast

import gymnasium
from gymnasium.envs.registration import EnvSpec
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env import sync_envs_normalization as bring_statistics

from mptc_gym.acting import opened, refuse_the_models_own
from mptc_gym.adapters import adapted
from mptc_gym.checks import MOST_PLANTS, count, reject
from mptc_gym.copies import copied
from mptc_gym.evaluation import VALIDATION_SEED, WINDOWS, Evaluation, evaluate
from mptc_gym.fit import check_fit
from mptc_gym.layers import have_a_layer_in_common, is_environment, plant_groups
from mptc_gym.making import make_batch, make_one
from mptc_gym.sb3_vec_env import GymnasiumVecEnv, make_vec_env

__all__ = ["GymnasiumVecEnv", "ScoreCallback", "load", "make_vec_env", "save", "spec_of"]

MEMBER = "mptc_gym.json"  # of a zip


def spec_of(policy: Any, env: str | EnvSpec = "MiddlePoint-v0", **arguments: Any) -> EnvSpec:
    """Return the spec of an id or spec with the windows and wrappers of a model's environments.

        evaluate(model, spec_of(model, "MiddlePointHard-v0"))

    Wrappers of Stable-Baselines3, such as `VecNormalize`, are not in a spec. ValueError if the
    model's environments cannot be made from theirs.
    """
    spec_of_training = _spec(policy)
    windows = plant_groups(policy.get_env())[0].parameters.windows
    arguments = {**dict(zip(WINDOWS, windows, strict=True)), **arguments}
    spec = cast("EnvSpec", make_one(env, arguments).spec)
    wrappers = spec_of_training.additional_wrappers
    return dataclasses.replace(spec, additional_wrappers=wrappers)


def _spec(model: Any) -> EnvSpec:
    """Return the spec of the first of a model's environments, if that makes one."""
    spec: Any = None
    try:
        spec = model.get_env().get_attr("spec")[0]
        # Gymnasium cannot make the Monitor that each model adds, and it changes nothing.
        wrappers = [
            wrapper for wrapper in spec.additional_wrappers if wrapper.name != "Monitor"
        ]
        spec = dataclasses.replace(spec, additional_wrappers=tuple(wrappers))
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
    ending. ValueError if the environments differ or cannot be made from their spec, of which a
    `VecEnvWrapper`, such as `VecNormalize`, is no part; or if the file cannot be written.
    """
    path = _zip_path(path)
    with _zip_of(model, path) as complete:
        complete.replace(path)


@contextmanager
def _zip_of(model: BaseAlgorithm, path: Path) -> Iterator[Path]:
    """Yield a complete zip of a model, in a new folder beside `path`, which is then deleted."""
    spec, plants = _spec(model), cast("VecEnv", model.get_env())
    if isinstance(plants, VecEnvWrapper) or len({*map(str, plants.get_attr("spec"))}) > 1:
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
            complete = Path(folder, "model.zip")
            model.save(complete)
            with zipfile.ZipFile(complete, "a") as archive:
                archive.writestr(MEMBER, record)
            yield complete
    except OSError as error:
        raise ValueError(f"{path} cannot be written: {error.strerror}") from error


def load(path: str | Path, **arguments: Any) -> BaseAlgorithm:
    """Load a model that `save` wrote, with as many environments like its own.

    Loading runs code from the zip and the modules that it names: load only what you trust.
    `arguments` are those of the algorithm's own `load`, such as `device="cpu"`. ValueError if
    the file is missing, is none of `save`, or cannot be loaded.
    """
    path = _zip_path(path)
    if not path.is_file():
        raise ValueError(f"path must be an existing file, got {path}")
    try:
        with zipfile.ZipFile(path) as archive:
            record = json.loads(archive.read(MEMBER))
            n_envs = json.loads(archive.read("data"))["n_envs"]
        make = partial(gymnasium.make, EnvSpec.from_json(record["spec"]))
        algorithm = pkgutil.resolve_name(record["algorithm"])
    except Exception as error:  # of any kind, from a damaged file or the code in it
        raise ValueError(
            f"{path} must be a zip of mptc_gym.sb3.save; load others by their algorithm, and "
            "say where they act: evaluate(model, env) "
            f"({type(error).__name__}: {error})"
        ) from error
    try:
        is_native = make_batch(make(), 1) is not None
        plants: VecEnv = DummyVecEnv([make] * n_envs)
        if is_native:
            plants = make_vec_env(EnvSpec.from_json(record["spec"]), n_envs)
        return cast("BaseAlgorithm", algorithm.load(path, plants, **arguments))
    except Exception as error:  # of any kind, from an algorithm or a wrapper of anybody
        raise ValueError(
            f"{path} cannot be loaded here ({type(error).__name__}: {error})"
        ) from error


def _zip_path(path: str | Path) -> Path:
    """Return the path of a zip, whose ending may be left out, as in Stable-Baselines3."""
    path = Path(path)
    return path if path.suffix else path.with_suffix(".zip")


class ScoreCallback(BaseCallback):
    """Score the policy during training, without exploration, and keep the best.

    The episodes are those of `VALIDATION_SEED`, which no published score uses. Where nothing is
    random, as in `MiddlePoint-v0`, all are the same: select by another set point,
    `setpoint_period=500`. The log gets `score/mean_error` and, with a bound, `score/score`.

    Parameters
    ----------
    env, **arguments
        Where to score, as in `mptc_gym.evaluate`; it may also be the environment of the
        training. An id or a spec takes the windows and wrappers of the training, see `spec_of`.
        A copy of a `VecNormalize` takes its statistics.
    every, episodes
        Samples of experience between scores, the last at the end of training; and episodes per
        score. Where bounds differ by episode, there are only 200 of them.
    path
        Zip in which to keep the policy with the least mean error, if any; see `save`. A file
        that exists before the first training is not overwritten: it is a ValueError.
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
        self._env = env
        self._arguments = arguments
        self._has_saved = False

    def _init_callback(self) -> None:
        self._latest = self.model.num_timesteps  # of the latest score
        if self.path is not None:
            if self.path.exists() and not self._has_saved:
                allowed = "a file that does not exist yet, as it would be overwritten"
                reject("path", str(self.path), allowed)
            with _zip_of(self.model, self.path):
                pass  # it can be saved
        self._check_environment()

    def _check_environment(self) -> None:
        """Refuse, before the training, environments that the model cannot be scored in."""
        if not is_environment(self._env):
            env, arguments = self._where()
            if isinstance(env, EnvSpec) or callable(env):
                with opened(env, 1, **arguments) as plants:
                    check_fit(self.model, plants)
            return
        copy = copied(self._env)
        refuse_the_models_own(copy, self.model)
        self._bring_statistics(copy.env)
        check_fit(self.model, adapted(copy.env))

    def _where(self) -> tuple[Any, dict[str, Any]]:
        """Return where to score, and arguments for `evaluate`."""
        if isinstance(self._env, str | EnvSpec):
            return spec_of(self.model, self._env, **self._arguments), {}
        if not is_environment(self._env):
            return self._env, self._arguments
        env = copied(self._env).env
        self._bring_statistics(env)
        return env, self._arguments

    def _bring_statistics(self, env: Any) -> None:
        """Bring the statistics of the training to a copy of environments."""
        if have_a_layer_in_common(self._env, self.training_env):
            return  # which the copy has
        if self.model.get_vec_normalize_env() is None or not isinstance(env, VecEnv):
            return
        try:
            bring_statistics(self.training_env, env)
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
        self._latest = self.num_timesteps
        env, arguments = self._where()
        result = evaluate(
            self.model, env, episodes=self.episodes, seed=VALIDATION_SEED, **arguments
        )
        self.scores.append((self.num_timesteps, result))
        self.logger.record("score/mean_error", result.mean_error)
        if result.score is not None:
            self.logger.record("score/score", result.score)
        is_best = self.best is None or result.mean_error < self.best.mean_error
        if is_best:
            self.best = result
            if self.path is not None:
                save(self.model, self.path)
                self._has_saved = True
        if self.verbose:
            total = self.locals.get("total_timesteps", self.num_timesteps)
            mark = "; best" if is_best else ""
            print(f"{self.num_timesteps:,} of {total:,} samples: {result}{mark}", flush=True)
