"""Save, load and score models of Stable-Baselines3 together with their environments."""

from __future__ import annotations

import copy
import dataclasses
import json
import pkgutil
import tempfile
import uuid
import zipfile
from functools import partial
from pathlib import Path
from typing import Any, cast

import gymnasium
from gymnasium.envs.registration import EnvSpec
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper, VecNormalize

from mptc_gym.environments.layers import is_environment, layers, normaliser_flag, plant_groups
from mptc_gym.environments.making import make_batch, make_one
from mptc_gym.evaluation import VALIDATION_SEED, WINDOWS, Evaluation, evaluate
from mptc_gym.plant.checks import count, reject
from mptc_gym.sb3.vec_env import make_vec_env
from mptc_gym.scoring.copies import Copy
from mptc_gym.scoring.fit import check_fit
from mptc_gym.scoring.opening import opened

SPEC_FILE = "mptc_gym.json"  # name of the file that `save` adds to the zip of a model


def spec_of(policy: Any, env: str | EnvSpec = "MiddlePoint-v0", **arguments: Any) -> EnvSpec:
    """Return an `EnvSpec` with the observation windows and wrappers of a model's training.

    Pass the returned spec to `evaluate`, for example::

        evaluate(model, spec_of(model, "MiddlePointHard-v0"))

    Parameters
    ----------
    policy
        Model of Stable-Baselines3 that has its training environments (`model.get_env()`).
    env
        Id or `EnvSpec` of the environment.
    **arguments
        Further arguments of the environment, as in `gymnasium.make`.

    Returns
    -------
    EnvSpec
        Spec of `env` with the observation windows and the Gymnasium wrappers of the model's
        training environments. A spec cannot hold wrappers of Stable-Baselines3, such as
        `VecNormalize`.

    Raises
    ------
    ValueError
        If the model has no environments, or if `gymnasium.make` cannot make the model's
        environments from their spec.
    """
    wrappers = _spec_of_training(policy).additional_wrappers
    window_sizes = plant_groups(policy.get_env())[0].parameters.windows
    windows = dict(zip(WINDOWS, window_sizes, strict=True))
    spec = cast("EnvSpec", make_one(env, {**windows, **arguments}).spec)
    return dataclasses.replace(spec, additional_wrappers=wrappers)


def _spec_of_training(model: Any) -> EnvSpec:
    """Return the spec of a model's first training environment, without a `Monitor` wrapper."""
    spec: Any = None
    try:
        spec = model.get_env().get_attr("spec")[0]
        # Stable-Baselines3 adds a Monitor, which records only. Gymnasium cannot make a Monitor.
        wrappers = [
            wrapper for wrapper in spec.additional_wrappers if wrapper.name != "Monitor"
        ]
        spec = dataclasses.replace(spec, additional_wrappers=tuple(wrappers))
        # This call raises an error if the spec, in the form of JSON text, does not serve.
        gymnasium.make(EnvSpec.from_json(spec.to_json()))
    except Exception as error:  # whatever a wrapper of another package raises
        raise ValueError(
            "the model must have its environments (as a model from mptc_gym.sb3.load has), "
            "which must come from gymnasium.make or make_vec_env, in wrappers that can be "
            "imported and record their arguments, as gymnasium.utils.RecordConstructorArgs "
            "does, got "
            f"{spec}: {error}"
        ) from error
    return cast("EnvSpec", spec)


def save(model: BaseAlgorithm, path: str | Path) -> None:
    """Save a model and the spec of the model's environments in a zip that `load` reads.

    `model.save` writes the zip, and `mptc_gym.sb3.save` adds a file with the spec. An existing
    file at `path` is replaced only after the new zip is complete.

    Parameters
    ----------
    model
        Model of Stable-Baselines3 that has its training environments.
    path
        Path of the new zip; `.zip` is added to a name without an ending.

    Raises
    ------
    ValueError
        If the model's environments differ from each other or cannot be made from their spec. If
        the model's environments are in a `VecEnvWrapper`, such as `VecNormalize`, which a spec
        cannot hold, or in a wrapper that normalises by running statistics. If the zip cannot be
        written.
    """
    path = _zip_path(path)
    spec = _spec_of_training(model)
    plants = cast("VecEnv", model.get_env())
    different_specs = set(map(str, plants.get_attr("spec")))
    if isinstance(plants, VecEnvWrapper) or len(different_specs) > 1:
        raise ValueError(
            "model must have environments that do not differ, in no VecEnvWrapper, to be "
            f"saved here, got {type(plants).__name__}: save the model by model.save(path). If "
            "the environments are in a VecNormalize, save its statistics by "
            "model.get_vec_normalize_env().save(path)"
        )
    # A Gymnasium wrapper such as NormalizeObservation; a spec holds no statistics.
    if any(map(normaliser_flag, layers(plants))):
        raise ValueError(
            "model must have environments in no wrapper that normalises by running statistics, "
            "as a zip of mptc_gym.sb3.save does not hold the statistics: train in a "
            "VecNormalize, and save the model by model.save(path) and the statistics by "
            "model.get_vec_normalize_env().save(path)"
        )
    algorithm = f"{type(model).__module__}:{type(model).__name__}"
    record = json.dumps({"algorithm": algorithm, "spec": spec.to_json()})
    try:
        # In a new folder, no other program touches the zip while the zip is incomplete.
        with tempfile.TemporaryDirectory(prefix=".", dir=path.parent) as folder:
            complete = Path(folder, "model.zip")
            model.save(complete)
            with zipfile.ZipFile(complete, "a") as archive:
                archive.writestr(SPEC_FILE, record)
            complete.replace(path)
    except OSError as error:
        raise ValueError(f"{path} cannot be written: {error.strerror}") from error


def load(path: str | Path, **arguments: Any) -> BaseAlgorithm:
    """Load a model that `save` has saved, with as many new environments as in the training.

    Loading runs code from the zip and from the modules that the zip names: load only files that
    you trust.

    Parameters
    ----------
    path
        Path of the zip; `.zip` is added to a name without an ending.
    **arguments
        Further arguments of the `load` method of the model's class, such as `device="cpu"`.

    Returns
    -------
    BaseAlgorithm
        The saved model, an object of the same class as before, with new environments.

    Raises
    ------
    ValueError
        If the file at `path` is missing, was not written by `save`, or cannot be loaded.
    """
    path = _zip_path(path)
    if not path.is_file():
        raise ValueError(f"path must be an existing file, got {path}")
    try:
        with zipfile.ZipFile(path) as archive:
            record = json.loads(archive.read(SPEC_FILE))
            n_envs = json.loads(archive.read("data"))["n_envs"]
        algorithm = pkgutil.resolve_name(record["algorithm"])
        spec = EnvSpec.from_json(record["spec"])
        # `make_batch` returns None for plants in wrappers other than IncrementalAction.
        if make_batch(gymnasium.make(spec), 1) is None:
            plants: VecEnv = DummyVecEnv([partial(gymnasium.make, spec)] * n_envs)
        else:
            plants = make_vec_env(spec, n_envs)
        return cast("BaseAlgorithm", algorithm.load(path, plants, **arguments))
    except Exception as error:  # whatever a damaged file or the code in it raises
        raise ValueError(
            f"{path} cannot be loaded as a zip of mptc_gym.sb3.save "
            f"({type(error).__name__}: {error}); load other zips by the class of the model, as "
            "in PPO.load(path), and pass environments to evaluate(model, env)"
        ) from error


def _zip_path(path: str | Path) -> Path:
    """Return a path, with `.zip` added if the path has no ending, as Stable-Baselines3 does."""
    path = Path(path)
    return path if path.suffix else path.with_suffix(".zip")


class ScoreCallback(BaseCallback):
    """Score a policy at intervals during the policy's training, and save the best policy.

    The policy is scored without exploration. The seeds of the scored episodes begin at
    `VALIDATION_SEED` of `mptc_gym.evaluation`, and differ from the default seeds of `evaluate`.
    `MiddlePoint-v0` has the same episode for all seeds. To choose a policy in another episode,
    pass another set point, such as `setpoint_period=500`. The model's logger records the mean
    absolute error, degC, as `score/mean_error`. If the least possible error is known, the
    logger records the score as `score/score`.

    Parameters
    ----------
    env
        Environments in which the policy is scored, in any form that `mptc_gym.evaluate` takes;
        the training environments are allowed. If `env` is an id or a spec, the environments get
        the observation windows and the wrappers of the training. If `env` is in a
        `VecNormalize`, each score uses the training's present normalisation statistics.
    every
        Least number of training samples between two scores, summed over all plants. The policy
        is also scored at the end of the training.
    episodes
        Number of episodes in which the policy is scored each time. If plants or set points are
        random, a score needs least possible errors, which are known for at most 200 episodes.
    path
        Path of the zip in which `save` keeps the policy with the least mean error; None to
        write no file. A ValueError is raised if the file at `path` exists before the first
        training.
    verbose
        1 to print each score, 0 to print nothing.
    **arguments
        Further arguments of the environment, as in `gymnasium.make`, if `env` is an id or a
        spec.

    Attributes
    ----------
    scores : list of (int, Evaluation)
        For each score, the number of training samples so far and the result of `evaluate`.
    best : Evaluation or None
        Result of `evaluate` with the least mean error so far; None before the first score.
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
        self.episodes = count("episodes", episodes, 2)
        self.path = None if path is None else _zip_path(path)
        self.scores: list[tuple[int, Evaluation]] = []
        self.best: Evaluation | None = None
        self._env = env
        self._arguments = arguments
        self._has_saved = False

    def _init_callback(self) -> None:
        """Check the path and the environments before a training begins.

        A ValueError is raised if the file at `path` exists or cannot be written, or if the
        environments for the scores do not fit the model.
        """
        # Number of training samples at the latest score, or at the start of the training.
        self._samples_at_score = self.model.num_timesteps
        if self.path is not None:
            if self.path.exists() and not self._has_saved:
                allowed = "a file that does not exist yet, as it would be overwritten"
                reject("path", str(self.path), allowed)
            trial = self.path.with_name(f".{uuid.uuid4().hex}.zip")
            save(self.model, trial)
            trial.unlink()
        env, arguments = self._environment()
        with opened(env, 1, self.model, **arguments) as plants:
            check_fit(self.model, plants)

    def _environment(self) -> tuple[Any, dict[str, Any]]:
        """Return an environment, and arguments of the environment, to pass to `evaluate`.

        If `env` is an environment, a copy of `env` is returned, in which each `VecNormalize`
        has the training's present normalisation statistics.
        """
        if isinstance(self._env, str | EnvSpec):
            return spec_of(self.model, self._env, **self._arguments), {}
        if not is_environment(self._env):
            return self._env, self._arguments
        env = Copy(self._env).env
        # If `env` and the training have unequal numbers of VecNormalize wrappers, `zip` leaves
        # out the surplus, innermost wrappers.
        pairs = zip(_normalisers(env), _normalisers(self.training_env), strict=False)
        for of_copy, of_training in pairs:
            of_copy.ret_rms = copy.deepcopy(of_training.ret_rms)
            if of_training.norm_obs:
                of_copy.obs_rms = copy.deepcopy(of_training.obs_rms)
        return env, self._arguments

    def _on_step(self) -> bool:
        """Score the policy if a score is due; return True to continue the training."""
        if self.num_timesteps >= self._samples_at_score + self.every:
            self._score()
        return True

    def _on_training_end(self) -> None:
        """Score the policy that the training ends with, unless it has already been scored."""
        if self.num_timesteps > self._samples_at_score:
            self._score()

    def _score(self) -> None:
        """Score the policy, record and print the result, and save the policy if it is best."""
        self._samples_at_score = self.num_timesteps
        env, arguments = self._environment()
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
            total = self.locals["total_timesteps"]  # samples in the whole training
            mark = "; best" if is_best else ""
            print(f"{self.num_timesteps:,} of {total:,} samples: {result}{mark}", flush=True)


def _normalisers(env: Any) -> list[VecNormalize]:
    """Return the `VecNormalize` wrappers of a wrapped environment, outermost first."""
    return [layer for layer in layers(env) if isinstance(layer, VecNormalize)]
