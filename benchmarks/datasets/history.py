"""Record the history of a plant under a controller, as a log has it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv, VectorWrapper
from numpy.typing import NDArray

from benchmarks.controllers.engineered import Nothing
from benchmarks.controllers.roster import ROSTER
from benchmarks.datasets.options import EPISODES, SAMPLES
from benchmarks.loop.rollout import make_plants, rollout
from mptc_gym import PRESETS, Evaluation, Parameters, evaluate

PLANTS = ("paper", "disturbed", "fouling")  # presets
BEHAVIOURS = {
    "pi": ("pi",),
    "smith": ("smith",),
    "mixed": ("pi", "pi-simc", "smith", "nn"),  # episode i is of the i-th of them, and so on
}
SEED = 9_000_000  # of the first episode; no comparison and no bound uses these
EVALUATIONS = 50  # episodes to judge learners on; others than those of the data

# The past actions make the problem Markov. The reward of a step is -|e| in degC.
ARGUMENTS = {
    "setpoint": "random",
    "reward": "absolute",
    "error_scale": 1.0,
    "action_window": 20,  # the delay and two
}


@dataclass(frozen=True)
class History:
    """Episodes of one plant, each under one controller."""

    plant: str
    """A name in `PRESETS`."""
    controllers: list[str]
    """Of each episode, as the seeds are."""
    seeds: list[int]
    observations: NDArray[np.float32]
    """Shape (episodes, SAMPLES + 1, n_obs); from k = 0 on."""
    actions: NDArray[np.float32]
    """Shape (episodes, SAMPLES, 1), within [-1, 1]."""
    rewards: NDArray[np.float64]
    """-|e(k+1)|, degC, shape (episodes, SAMPLES)."""

    @property
    def error(self) -> float:
        """Mean |e| over k = 1 to SAMPLES, degC."""
        return float(-self.rewards.mean())

    @property
    def sha256(self) -> str:
        """A hash of all that it holds, and of the environment's arguments."""
        about = [arguments_of(self.plant), self.controllers, self.seeds]
        digest = hashlib.sha256(json.dumps(about, sort_keys=True).encode())
        for array in (self.observations, self.actions, self.rewards):
            little = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
            digest.update(repr(array.shape).encode() + little.tobytes())
        return digest.hexdigest()


def arguments_of(plant: str) -> dict[str, Any]:
    """Return the arguments of the environment that a plant's data sets come from."""
    return {**PRESETS[plant], **ARGUMENTS}


def record(plant: str, behaviour: str, episodes: int = EPISODES, seed: int = SEED) -> History:
    """Log one of `PLANTS` under one or several controllers, as `BEHAVIOURS` name them.

    Episode i is the one that the environment draws with seed `seed + i`.

    Raises
    ------
    ValueError
        If there is no such plant or behaviour, or no episode for one of its controllers.
    """
    known = {"plant": (plant, PLANTS), "behaviour": (behaviour, BEHAVIOURS)}
    for argument, (value, values) in known.items():
        if value not in values:
            raise ValueError(f"{argument} must be one of {', '.join(values)}, got {value!r}")
    names = BEHAVIOURS[behaviour]
    if episodes < len(names):
        raise ValueError(f"episodes must be at least {len(names)}, got {episodes!r}")
    arguments = arguments_of(plant)
    size = Parameters(**arguments).observation_size
    history = History(
        plant,
        [names[i % len(names)] for i in range(episodes)],
        [seed + i for i in range(episodes)],
        np.empty((episodes, SAMPLES + 1, size), np.float32),
        np.empty((episodes, SAMPLES, 1), np.float32),
        np.empty((episodes, SAMPLES)),
    )
    for j, name in enumerate(names):
        which = slice(j, episodes, len(names))
        own = history.seeds[which]
        plants = _Recorder(make_plants(len(own), SAMPLES, **arguments), own)
        (factory,) = ROSTER[name].members()
        controller = factory.in_service(arguments, len(own), seed)
        rollout(plants, controller, SAMPLES, seed)
        plants.close()
        history.observations[which] = np.stack(plants.observations, axis=1)
        history.actions[which] = np.stack(plants.actions, axis=1)
        history.rewards[which] = np.stack(plants.rewards, axis=1)
    return history


def scale(plant: str, episodes: int = EVALUATIONS) -> Evaluation:
    """Return what offline learners are judged by: an idle valve on fixed episodes.

    Its `mean_error` scores 0 and its `least_possible` scores 1, as by `mptc_gym.evaluate` of
    any policy on the same environment.
    """
    return evaluate(Nothing(), episodes=episodes, **arguments_of(plant))


class _Recorder(VectorWrapper):
    """Keeps what goes in and what comes out; actions go in as the action space has them."""

    def __init__(self, plants: VectorEnv, seeds: Sequence[int]) -> None:
        super().__init__(plants)
        self._seeds = list(seeds)
        self.observations: list[NDArray[np.float32]] = []
        self.actions: list[NDArray[np.float32]] = []
        self.rewards: list[NDArray[np.float64]] = []

    def reset(self, **_: Any) -> tuple[NDArray[np.float32], dict[str, Any]]:
        found = self.env.reset(seed=self._seeds)  # type: ignore[arg-type]
        self.observations.append(found[0])
        return found

    def step(self, actions: NDArray[np.float32]) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        # Beyond +-1 the actuator saturates, so that this changes nothing that the plant does.
        self.actions.append(np.clip(actions, -1.0, 1.0).astype(np.float32))
        found = self.env.step(self.actions[-1])
        self.observations.append(found[0])
        self.rewards.append(found[1])
        return found
