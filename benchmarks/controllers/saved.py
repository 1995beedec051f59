"""Make controllers from policies of Stable-Baselines3: `--agent mine=PPO:model.zip`."""

from __future__ import annotations

import glob
import hashlib
import importlib
import zipfile
from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.controllers.records import Cost, Factory
from benchmarks.loop.rollout import drawn_numbers
from mptc_gym import MiddlePointEnv, Parameters
from mptc_gym.evaluation import WINDOWS
from mptc_gym.policies import start
from mptc_gym.sb3 import MEMBER, load, spec_of
from mptc_gym.wrappers import NUMBERS, Actuator

_ADVICE = (
    "write a function that returns the policy, or the policy and the environment that it acts "
    "in, and give --agent NAME=MODULE:FUNCTION"
)


def policies(location: str) -> list[Factory]:
    """Return a factory for each saved policy at a location, such as `PPO:model.zip`.

    The file may be a pattern, such as `runs/*.zip`. Loading a zip runs the code in it. A
    ValueError says if there is no such file, if it is of another algorithm, or if its policy
    acts in an environment that a comparison cannot give.
    """
    algorithm, _, pattern = location.partition(":")
    if not pattern:
        raise ValueError(f"{location!r} must be ALGORITHM:FILE.zip, such as PPO:{location}")
    found = glob.glob(pattern)  # noqa: PTH207 (patterns of absolute paths, too)
    files = [pattern] if Path(pattern).is_file() else sorted(found)
    if not files:
        raise ValueError(f"{location!r}: there is no file {pattern}")
    return [_policy(algorithm, Path(file).resolve()) for file in files]


def _policy(algorithm: str, file: Path) -> Factory:
    model, windows, increments = _loaded(algorithm, str(file))
    weights = sum(weight.numel() for weight in model.policy.parameters())
    return Factory(
        partial(SavedPolicy, algorithm, str(file)),
        Cost(
            parameters=f"{weights:,} weights a policy",
            samples=f"{model.num_timesteps / 1e6:.3g} M a policy",
        ),
        windows,
        provenance={
            "file": file.name,
            "sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
            "increments": increments,
        },
    )


class SavedPolicy:
    """A deterministic controller from a policy in a zip file.

    If the policy moves the flow, an actuator turns the resulting flows into actions.
    """

    def __init__(
        self, algorithm: str, file: str, plant: Parameters, runs: int, seed: int
    ) -> None:
        self._model, _, increments = _loaded(algorithm, file)
        self._actuator = None
        if increments is not None:
            numbers = drawn_numbers(plant, runs, seed).chosen(NUMBERS)
            self._actuator = Actuator(numbers, **increments)
        self._runs = runs
        self.reset()

    def reset(self) -> None:
        """Start an episode."""
        self._act = start(self._model, self._runs)
        self._flows = np.zeros(self._runs)

    def act(self, observations: NDArray[np.float32]) -> NDArray[Any]:
        """Return actions, shape (runs, 1), for observations, shape (runs, n_obs)."""
        actions: NDArray[Any] = np.asarray(self._act(observations))
        if self._actuator is None:
            return actions
        self._flows = self._actuator.moved(self._flows, actions[:, 0])
        moved = self._actuator.action(self._flows)
        return np.asarray(moved, np.float32)[:, np.newaxis]


@cache
def _loaded(algorithm: str, file: str) -> tuple[Any, dict[str, int], dict[str, Any] | None]:
    """Return a model, its windows and, if it has any, the arguments of `IncrementalAction`."""
    kept = False
    with suppress(zipfile.BadZipFile), zipfile.ZipFile(file) as archive:
        kept = MEMBER in archive.namelist()
    if not kept:
        return _plain(algorithm, file), _windows(Parameters()), None
    model = load(file, device="cpu")
    if type(model).__name__ != algorithm:
        raise ValueError(f"{file} holds a model of {type(model).__name__}, not of {algorithm}")
    spec = spec_of(model)
    match spec.additional_wrappers:
        case ():
            increments = None
        case (only,) if only.name == "IncrementalAction":
            increments = dict(only.kwargs or {})
        case several:
            names = ", ".join(each.name for each in several)
            raise ValueError(
                f"{file} acts in {names}, not in IncrementalAction alone: {_ADVICE}"
            )
    return model, _windows(Parameters.of_environment(spec.kwargs)), increments


def _plain(algorithm: str, file: str) -> Any:
    """Return a model that does not say where it acts, if the plain environment fits it."""
    for package in ("stable_baselines3", "sb3_contrib"):
        with suppress(ImportError):
            if kind := getattr(importlib.import_module(package), algorithm, None):
                model = kind.load(file, device="cpu")
                plain = MiddlePointEnv()
                spaces = plain.observation_space, plain.action_space
                if (model.observation_space, model.action_space) != spaces:
                    raise ValueError(f"{file} does not act in the plain environment: {_ADVICE}")
                return model
    raise ValueError(f"{algorithm} must be an algorithm of Stable-Baselines3, such as PPO")


def _windows(parameters: Parameters) -> dict[str, int]:
    """Return the windows by their names."""
    return {name: getattr(parameters, name) for name in WINDOWS}
