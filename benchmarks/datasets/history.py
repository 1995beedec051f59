"""Record the history of a plant under a controller, as a log would."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.controllers.roster import ROSTER
from benchmarks.datasets.__main__ import BEHAVIOURS, EPISODES, SAMPLES
from benchmarks.loop.rollout import Agent, IdleValve, make_plants
from mptc_gym import PRESETS, Evaluation, Parameters, evaluate
from mptc_gym.policies import rollout

SEED = 9_000_000  # of the first episode; no comparison and no bound uses these seeds
EVALUATIONS = 50  # episodes to evaluate learners on; the data holds none of them

# The past actions make the problem Markov. The reward of a step is -|e| in degC.
ARGUMENTS = {
    "setpoint": "random",
    "reward": "absolute",
    "error_scale": 1.0,
    "action_window": 20,  # delay + 2
}


@dataclass(frozen=True)
class History:
    """Episodes of one plant, each under one controller."""

    plant: str
    """A name in `PRESETS`."""
    controllers: list[str]
    """Name of the controller of each episode, in the order of `seeds`."""
    seeds: list[int]
    observations: NDArray[np.float32]
    """Shape (episodes, SAMPLES + 1, n_obs), from k = 0 on."""
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
        """Hash of all the data and of the environment's arguments."""
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
    """Log one of `PLANTS` under the controllers of one of `BEHAVIOURS`.

    The environment draws episode i with seed `seed + i`. Each controller needs at least one
    episode.
    """
    names, arguments = BEHAVIOURS[behaviour], arguments_of(plant)
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
        own = slice(j, episodes, len(names))
        seeds = history.seeds[own]
        (factory,) = ROSTER[name].members()
        controller = factory.in_service(arguments, len(seeds), seed)
        logged = _log(controller, arguments, seeds)
        history.observations[own], history.actions[own], history.rewards[own] = logged
    return history


def _log(controller: Agent, arguments: dict[str, Any], seeds: list[int]) -> tuple[Any, ...]:
    """Return the observations, actions and rewards of a batch of episodes; see `History`."""
    observations: list[NDArray[np.float32]] = []
    actions: list[NDArray[np.float32]] = []

    def act(observation: NDArray[np.float32]) -> NDArray[np.float32]:
        observations.append(observation)
        # Beyond +-1 the actuator saturates, so clipping does not change what the plant does.
        action = np.clip(controller.act(observation), -1.0, 1.0)
        actions.append(action.astype(np.float32))
        return actions[-1]

    # One more sample, for the final observation.
    plants = make_plants(len(seeds), SAMPLES + 1, **arguments)
    controller.reset()
    steps = rollout(plants, act, SAMPLES + 1, seeds)  # type: ignore[arg-type]
    errors = [after["error"] for _, after, _ in steps]
    plants.close()
    return np.stack(observations, 1), np.stack(actions[:-1], 1), -np.abs(errors[:-1]).T


def scale(plant: str, episodes: int = EVALUATIONS) -> Evaluation:
    """Return the scale for offline learners: an idle valve evaluated on fixed episodes.

    Its `mean_error` scores 0 and its `least_possible` scores 1, as in `mptc_gym.evaluate` of
    any policy on the same environment.
    """
    return evaluate(IdleValve(), episodes=episodes, **arguments_of(plant))
