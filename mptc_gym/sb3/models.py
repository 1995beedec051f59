"""Save and load models of Stable-Baselines3 with their environments, and score trainings."""

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

from mptc_gym.environments.layers import is_environment, layers, plant_groups
from mptc_gym.environments.making import make_batch, make_one
from mptc_gym.evaluation import VALIDATION_SEED, WINDOWS, Evaluation, evaluate
from mptc_gym.plant.checks import MOST_PLANTS, count, reject
from mptc_gym.sb3.vec_env import make_vec_env
from mptc_gym.scoring.copies import Copy
from mptc_gym.scoring.fit import check_fit
from mptc_gym.scoring.opening import opened

SPEC_FILE = "mptc_gym.json"  # name of the file that `save` adds to the zip of a model


def spec_of(policy: Any, env: str | EnvSpec = "MiddlePoint-v0", **arguments: Any) -> EnvSpec:
    """Return the spec of an environment with the windows and wrappers of a model's training.

    The spec is for `evaluate`, as in::

        evaluate(model, spec_of(model, "MiddlePointHard-v0"))

    Parameters
    ----------
    policy
        A model of Stable-Baselines3 with the environments of its training.
    env
        An id or an `EnvSpec`.
    **arguments
        Further arguments for the environment, as in `gymnasium.make`.

    Returns
    -------
    EnvSpec
        The spec of `env` with the window sizes and the wrappers of Gymnasium of the model's
        environments. A spec holds no wrappers of Stable-Baselines3, such as `VecNormalize`.

    Raises
    ------
    ValueError
        If the model has no environments, or if these environments cannot be made from their
        spec.
    """
    wrappers = _spec_of_training(policy).additional_wrappers
    window_sizes = plant_groups(policy.get_env())[0].parameters.windows
    windows = dict(zip(WINDOWS, window_sizes, strict=True))
    spec = cast("EnvSpec", make_one(env, {**windows, **arguments}).spec)
    return dataclasses.replace(spec, additional_wrappers=wrappers)


def _spec_of_training(model: Any) -> EnvSpec:
    """Return the spec of the first environment of a model, without the `Monitor` around it.

    A ValueError is raised if the model has no environments, or if `gymnasium.make` cannot make
    the environment from the spec.
    """
    spec: Any = None
    try:
        spec = model.get_env().get_attr("spec")[0]
        # Gymnasium cannot make the Monitor that each model adds, and a Monitor changes nothing.
        wrappers = [
            wrapper for wrapper in spec.additional_wrappers if wrapper.name != "Monitor"
        ]
        spec = dataclasses.replace(spec, additional_wrappers=tuple(wrappers))
        gymnasium.make(EnvSpec.from_json(spec.to_json()))  # a trial, also of the text form
    except Exception as error:  # whatever a wrapper of another package raises
        raise ValueError(
            "policy must be a model with its environments (see mptc_gym.sb3.load), which must "
            "come from gymnasium.make or make_vec_env, in wrappers that can be imported and "
            "record their arguments, as gymnasium.utils.RecordConstructorArgs does, got "
            f"{spec}: {error}"
        ) from error
    return cast("EnvSpec", spec)


def save(model: BaseAlgorithm, path: str | Path) -> None:
    """Save a model with the spec of its environments, in a zip that `load` reads.

    The zip is that of the method `model.save`, with one more file inside. An existing file at
    `path` is replaced only when the new zip is complete.

    Parameters
    ----------
    model
        A model of Stable-Baselines3 with its environments.
    path
        Where to write the zip; `.zip` is added to a name without an ending.

    Raises
    ------
    ValueError
        If the environments differ from each other, cannot be made from their spec, or are in a
        `VecEnvWrapper`, such as `VecNormalize`, which is not part of a spec; or if the file
        cannot be written.
    """
    path = _zip_path(path)
    spec = _spec_of_training(model)
    plants = cast("VecEnv", model.get_env())
    different_specs = set(map(str, plants.get_attr("spec")))
    if isinstance(plants, VecEnvWrapper) or len(different_specs) > 1:
        raise ValueError(
            "policy must have environments that do not differ, in no VecEnvWrapper, to be "
            f"saved here, got {type(plants).__name__}: save it by model.save(path), and "
            "statistics by model.get_vec_normalize_env().save(path)"
        )
    algorithm = f"{type(model).__module__}:{type(model).__name__}"
    record = json.dumps({"algorithm": algorithm, "spec": spec.to_json()})
    try:
        # The folder is new, so no other program writes to the file while it is incomplete.
        with tempfile.TemporaryDirectory(prefix=".", dir=path.parent) as folder:
            complete = Path(folder, "model.zip")
            model.save(complete)
            with zipfile.ZipFile(complete, "a") as archive:
                archive.writestr(SPEC_FILE, record)
            complete.replace(path)
    except OSError as error:
        raise ValueError(f"{path} cannot be written: {error.strerror}") from error


def load(path: str | Path, **arguments: Any) -> BaseAlgorithm:
    """Load a model that `save` wrote, with as many environments as in its training.

    Loading runs code from the zip and from the modules that the zip names: load only files that
    you trust.

    Parameters
    ----------
    path
        The zip; `.zip` is added to a name without an ending.
    **arguments
        Further arguments of the method `load` of the algorithm's class, such as `device="cpu"`.

    Returns
    -------
    BaseAlgorithm
        The model, of the class that was saved, with new environments.

    Raises
    ------
    ValueError
        If the file is missing, was not written by `save`, or cannot be loaded.
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
        # Only plants in no wrapper other than IncrementalAction can be stepped together.
        if make_batch(gymnasium.make(spec), 1) is None:
            plants: VecEnv = DummyVecEnv([partial(gymnasium.make, spec)] * n_envs)
        else:
            plants = make_vec_env(spec, n_envs)
        return cast("BaseAlgorithm", algorithm.load(path, plants, **arguments))
    except Exception as error:  # whatever a damaged file or the code in it raises
        raise ValueError(
            f"{path} cannot be loaded as a zip of mptc_gym.sb3.save "
            f"({type(error).__name__}: {error}); load other zips by their algorithm, and name "
            "the environments where they act: evaluate(model, env)"
        ) from error


def _zip_path(path: str | Path) -> Path:
    """Return a path with the ending `.zip`, or the path itself if it has an ending.

    Stable-Baselines3 completes the paths of models by the same rule.
    """
    path = Path(path)
    return path if path.suffix else path.with_suffix(".zip")


class ScoreCallback(BaseCallback):
    """Score the policy during a training, without exploration, and keep the best policy.

    The scored episodes have seeds from `VALIDATION_SEED` of `mptc_gym.evaluation` on, which no
    published score uses. In `MiddlePoint-v0`, nothing is random, so the seeds do not matter:
    choose a set point of your own for the scores, such as `setpoint_period=500`. The logger of
    the model records `score/mean_error`, degC, and, where the package has a bound of the mean
    error, `score/score`.

    Parameters
    ----------
    env
        The environments in which the policy is scored, as in `mptc_gym.evaluate`; the training
        environments are allowed. Environments of an id or a spec get the windows and wrappers
        of the training, as by `spec_of`. Environments in a `VecNormalize` get the statistics
        that the training has at the time of a score.
    every
        Samples of experience between two scores, summed over all plants. The last score is at
        the end of the training.
    episodes
        Number of episodes of a score. Where the least possible error differs from episode to
        episode, the package has bounds for 200 episodes at most.
    path
        Zip in which to keep the policy with the least mean error: see `save`. None keeps no
        file. A ValueError is raised if the file exists before the first training.
    verbose
        1 prints each score, 0 does not.
    **arguments
        Further arguments for an id or a spec, as in `gymnasium.make`.

    Attributes
    ----------
    scores : list of (int, Evaluation)
        For each score, the samples of experience at that time, and the result.
    best : Evaluation or None
        The result with the least mean error; None before the first score.
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
        """Raise, before a training, the errors that would come up at the first score.

        Stable-Baselines3 calls this method at the start of each `learn`. A ValueError is raised
        if `path` exists or cannot be written, or if the environments do not fit the model.
        """
        # Samples of experience at the latest score, or at the start of the training.
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
        """Return the argument `env` of `evaluate` for a score, and further arguments.

        If `env` is in a `VecNormalize`, a copy is returned, which has the statistics that the
        training has at present.
        """
        if isinstance(self._env, str | EnvSpec):
            return spec_of(self.model, self._env, **self._arguments), {}
        if not is_environment(self._env):
            return self._env, self._arguments
        env = Copy(self._env).env
        # Further wrappers of either environment stay as they are.
        pairs = zip(_normalisers(env), _normalisers(self.training_env), strict=False)
        for of_copy, of_training in pairs:
            of_copy.ret_rms = copy.deepcopy(of_training.ret_rms)
            if of_training.norm_obs:
                of_copy.obs_rms = copy.deepcopy(of_training.obs_rms)
        return env, self._arguments

    def _on_step(self) -> bool:
        """Score the policy if `every` samples have passed; return True to go on training."""
        if self.num_timesteps >= self._samples_at_score + self.every:
            self._score()
        return True

    def _on_training_end(self) -> None:
        """Score the policy once more, unless there is a score of the present policy."""
        if self.num_timesteps > self._samples_at_score:
            self._score()

    def _score(self) -> None:
        """Score the present policy, record and print the result, and keep the best policy."""
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
            total = self.locals["total_timesteps"]  # of the training
            mark = "; best" if is_best else ""
            print(f"{self.num_timesteps:,} of {total:,} samples: {result}{mark}", flush=True)


def _normalisers(env: Any) -> list[VecNormalize]:
    """Return each `VecNormalize` among the layers of an environment, outermost first."""
    return [layer for layer in layers(env) if isinstance(layer, VecNormalize)]
