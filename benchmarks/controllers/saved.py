"""Make controllers from policies saved by Stable-Baselines3: `--agent mine=PPO:model.zip`."""

from __future__ import annotations

import glob
import hashlib
from functools import cache, partial
from importlib import import_module
from importlib.util import find_spec
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
from mptc_gym.sb3 import spec_of
from mptc_gym.wrappers import NUMBERS, Actuator

LIBRARIES = "stable_baselines3", "sb3_contrib"


def policies(location: str) -> list[Factory]:
    """Return a factory for each saved policy at a location, such as `PPO:model.zip`.

    The file may be a pattern, such as `runs/*.zip`. Loading a zip runs the code in it.

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
        partial(SavedPolicy, algorithm, str(file), increments),
        Cost(
            parameters=f"{weights:,} weights a policy",
            samples=f"{model.num_timesteps / 1e6:.3g} M a policy",
        ),
        {name: spec.kwargs.get(name, ARGUMENTS[name].default) for name in WINDOWS},
        provenance={
            "file": file.name,
            "sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
            "trained_on": spec.to_json(),
        },
    )


class SavedPolicy:
    """A deterministic controller from a policy in a zip file.

    `increments` are the arguments of `IncrementalAction` if the policy moves the flow: an
    actuator then turns the resulting flows into actions.
    """

    def __init__(
        self,
        algorithm: str,
        file: str,
        increments: dict[str, Any] | None,
        plant: Parameters,
        runs: int,
        seed: int,
    ) -> None:
        self._model = _loaded(algorithm, file)
        self._actuator = None
        if increments is not None:
            numbers = drawn_numbers(plant, runs, seed).chosen(NUMBERS)
            self._actuator = Actuator(numbers, **increments)
        self._runs = runs
        self.reset()

    def reset(self) -> None:
        """Start an episode."""
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
    """Return the model; raise a ValueError if the zip holds none of this algorithm."""
    there = [import_module(name) for name in LIBRARIES if find_spec(name)]
    found: Any = next(
        (vars(each)[algorithm] for each in there if algorithm in vars(each)), None
    )
    if not hasattr(found, "load"):
        raise ValueError(f"{algorithm!r} is no algorithm of {' or '.join(LIBRARIES)}")
    try:
        return found.load(file, device="cpu")
    except Exception as error:
        raise ValueError(
            f"{file} cannot be loaded as {algorithm}: {type(error).__name__}: {error}"
        ) from error
