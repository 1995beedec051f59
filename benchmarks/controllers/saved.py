"""Make controllers of policies that Stable-Baselines3 saved: `--agent mine=PPO:model.zip`."""

from __future__ import annotations

import glob
import hashlib
import importlib.util
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.controllers.records import Cost, Factory
from benchmarks.loop.rollout import drawn_numbers
from mptc_gym import Parameters
from mptc_gym.evaluation import WINDOWS
from mptc_gym.parameters import ARGUMENTS
from mptc_gym.policies import acting
from mptc_gym.wrappers import NUMBERS, Actuator

LIBRARIES = "stable_baselines3", "sb3_contrib"


def policies(location: str) -> list[Factory]:
    """Return a factory for each saved policy of a location, such as `PPO:model.zip`.

    The file may be a pattern, `runs/*.zip`. Loading a zip runs the code that is in it.

    Raises
    ------
    ValueError
        If there is no such algorithm or file, or a file does not say how its policy was
        trained.
    """
    algorithm, _, pattern = location.partition(":")
    if not pattern:
        raise ValueError(f"{location!r} must be ALGORITHM:FILE.zip, such as PPO:{location}")
    files = sorted(glob.glob(pattern))  # noqa: PTH207 (patterns of absolute paths, too)
    if not files:
        raise ValueError(f"{location!r}: there is no file {pattern}")
    return [_policy(algorithm, Path(file).resolve()) for file in files]


def _policy(algorithm: str, file: Path) -> Factory:
    try:
        from mptc_gym.sb3 import spec_of
    except ImportError as error:
        raise ValueError(
            f'{file.name} needs Stable-Baselines3: pip install -e ".[sb3]" ({error})'
        ) from error
    spec = spec_of(file)
    wrappers = [wrapper.name for wrapper in spec.additional_wrappers]
    if wrappers not in ([], ["IncrementalAction"]):
        raise ValueError(
            f"{file} was trained in {', '.join(wrappers)}, and only IncrementalAction is known "
            "here: mptc_gym.evaluate scores it"
        )
    increments = dict(spec.additional_wrappers[0].kwargs or {}) if wrappers else None
    model = _loaded(algorithm, str(file))
    weights = sum(weight.numel() for weight in model.policy.parameters())
    return Factory(
        partial(_made, algorithm, str(file), increments),
        {name: spec.kwargs.get(name, ARGUMENTS[name].default) for name in WINDOWS},
        code=__name__,
        provenance={
            "file": file.name,
            "sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
            "trained_on": spec.to_json(),
        },
        cost=Cost(
            parameters=f"{weights:,} weights a policy",
            samples=f"{model.num_timesteps / 1e6:.3g} M a policy",
        ),
    )


def _made(
    algorithm: str,
    file: str,
    increments: dict[str, Any] | None,
    plant: Parameters,
    runs: int,
    seed: int,
) -> SavedPolicy:
    """Return a controller of a zip; `increments` are the arguments of `IncrementalAction`."""
    actuator = None
    if increments is not None:
        actuator = Actuator(drawn_numbers(plant, runs, seed).chosen(NUMBERS), **increments)
    return SavedPolicy(_loaded(algorithm, file), actuator, runs)


class SavedPolicy:
    """A policy as a controller, deterministic.

    The actuator turns wanted flows into actions, if the policy moves them; see
    `IncrementalAction`.
    """

    def __init__(self, model: Any, actuator: Actuator | None, runs: int) -> None:
        self._model, self._actuator, self._runs = model, actuator, runs
        self.reset()

    def reset(self) -> None:
        """Begin an episode."""
        self._act = acting(self._model)
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
def _loaded(algorithm: str, file: str) -> Any:
    """Return the model; ValueError if the zip does not hold one of this algorithm."""
    there = [name for name in LIBRARIES if importlib.util.find_spec(name)]
    modules = [importlib.import_module(name) for name in there]
    found: Any = next((getattr(m, algorithm) for m in modules if hasattr(m, algorithm)), None)
    if not hasattr(found, "load"):
        raise ValueError(f"{algorithm!r} is no algorithm of {' or '.join(LIBRARIES)}")
    try:
        return found.load(file, device="cpu")
    except Exception as error:
        raise ValueError(
            f"{file} cannot be loaded as {algorithm}: {type(error).__name__}: {error}"
        ) from error
