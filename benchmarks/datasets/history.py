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
    """Episodes of one plant, each under one controller.

    Attributes
    ----------
    plant
        A name in `PRESETS`.
    controllers
        Name of the controller of each episode.
    seeds
        Of each episode: what `reset(seed=...)` takes.
    observations
        Shape (episodes, SAMPLES + 1, n_obs), float32; from k = 0 on.
    actions
        Shape (episodes, SAMPLES, 1), float32, within [-1, 1].
    rewards
        -|e(k+1)|, degC, shape (episodes, SAMPLES), float64.
    """

    plant: str
    controllers: list[str]
    seeds: list[int]
    observations: NDArray[np.float32]
    actions: NDArray[np.float32]
    rewards: NDArray[np.float64]

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
    """Log a plant under one or several controllers.

    Parameters
    ----------
    plant
        One of `PLANTS`.
    behaviour
        A name in `BEHAVIOURS`.
    episodes
        How many; episode i is the one that the environment draws with seed `seed + i`.
    seed
        Of the first episode.

    Raises
    ------
    ValueError
        If there is no such plant or behaviour, or no episode for one of its controllers.
    """
    for name, value, known in (
        ("plant", plant, PLANTS),
        ("behaviour", behaviour, tuple(BEHAVIOURS)),
    ):
        if value not in known:
            raise ValueError(f"{name} must be one of {', '.join(known)}, got {value!r}")
    names = BEHAVIOURS[behaviour]
    if episodes < len(names):
        raise ValueError(f"episodes must be at least {len(names)}, got {episodes!r}")
    controllers = [names[i % len(names)] for i in range(episodes)]
    seeds = [seed + i for i in range(episodes)]
    arguments = arguments_of(plant)
    size = Parameters(**arguments).observation_size
    history = History(
        plant,
        controllers,
        seeds,
        np.empty((episodes, SAMPLES + 1, size), np.float32),
        np.empty((episodes, SAMPLES, 1), np.float32),
        np.empty((episodes, SAMPLES)),
    )
    for j, name in enumerate(names):
        which = slice(j, episodes, len(names))
        own = seeds[which]
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
        observations, infos = self.env.reset(seed=self._seeds)  # type: ignore[arg-type]
        self.observations.append(observations)
        return observations, infos

    def step(self, actions: NDArray[np.float32]) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        # Beyond +-1 the actuator saturates, so that this changes nothing that the plant does.
        taken = np.clip(actions, -1.0, 1.0).astype(np.float32)
        observations, rewards, terminations, truncations, infos = self.env.step(taken)
        self.observations.append(observations)
        self.actions.append(taken)
        self.rewards.append(rewards)
        return observations, rewards, terminations, truncations, infos
