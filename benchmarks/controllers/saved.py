"""Make controllers from policies saved by `mptc_gym.sb3`: `--agent mine=PPO:model.zip`."""

from __future__ import annotations

import glob
import hashlib
from dataclasses import asdict
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.controllers.records import Cost, Factory
from benchmarks.loop.rollout import drawn_numbers
from mptc_gym import Parameters
from mptc_gym.policies import start
from mptc_gym.sb3 import load
from mptc_gym.training import Training, entry_point
from mptc_gym.wrappers import NUMBERS, Actuator, IncrementalAction


def policies(location: str) -> list[Factory]:
    """Return a factory for each saved policy at a location, such as `PPO:model.zip`.

    The file may be a pattern, such as `runs/*.zip`. Loading a zip runs the code in it. A
    ValueError says if there is no such file, if it does not say how its policy was trained, or
    if that was with another algorithm or with wrappers that a comparison cannot give.
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
    training = Training.read(file)
    if training.algorithm.rpartition(":")[2] != algorithm:
        raise ValueError(f"{file} holds a model of {training.algorithm}, not of {algorithm}")
    increments = None
    match training.wrappers:
        case ():
            pass
        case (only,) if only.entry_point == entry_point(IncrementalAction):
            increments = dict(only.kwargs or {})
        case several:
            raise ValueError(
                f"{file} was trained in {', '.join(each.name for each in several)}, and only "
                "IncrementalAction is known here: mptc_gym.evaluate scores it"
            )
    model = _loaded(str(file))
    weights = sum(weight.numel() for weight in model.policy.parameters())
    return Factory(
        partial(SavedPolicy, str(file), increments),
        Cost(
            parameters=f"{weights:,} weights a policy",
            samples=f"{model.num_timesteps / 1e6:.3g} M a policy",
        ),
        training.windows,
        provenance={
            "file": file.name,
            "sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
            "training": asdict(training),
        },
    )


class SavedPolicy:
    """A deterministic controller from a policy in a zip file.

    `increments` are the arguments of `IncrementalAction` if the policy moves the flow: an
    actuator then turns the resulting flows into actions.
    """

    def __init__(
        self,
        file: str,
        increments: dict[str, Any] | None,
        plant: Parameters,
        runs: int,
        seed: int,
    ) -> None:
        self._model = _loaded(file)
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
def _loaded(file: str) -> Any:
    return load(file, device="cpu")
