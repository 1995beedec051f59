"""Roll out a controller on a batch of plants, in the loop that all comparisons share."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from typing import Any, Protocol

import gymnasium
import numpy as np
from numpy.typing import NDArray

from mptc_gym import Parameters  # which registers the environment
from mptc_gym.acting import rollout as run_batch
from mptc_gym.parameters import PLANT_NUMBERS, PlantNumbers
from mptc_gym.plant import action_from_command
from mptc_gym.signals import Ranges

Array = NDArray[np.float64]


class Agent(Protocol):
    """The interface of a controller in a rollout."""

    def reset(self) -> None:
        """Prepare for a new episode."""

    def act(self, observation: Any) -> Any:
        """Return actions, shape (runs, 1), for observations, shape (runs, n_obs)."""


class IdleValve:
    """No control: leave the valve at 0 t/h.

    The actuator's limits are in t/h, the same for all runs or of shape (runs,).
    """

    def __init__(self, u_min: Any = -10.0, u_max: Any = 10.0) -> None:
        self.action = np.reshape(action_from_command(0.0, u_min, u_max), (-1, 1))

    def reset(self) -> None:
        """Remember nothing."""

    def act(self, observation: NDArray[np.float32]) -> Array:
        """Return the actions that keep the flow, shape (runs, 1)."""
        return np.broadcast_to(self.action, (len(observation), 1))


@dataclass(frozen=True)
class Trajectory:
    """The signals of a batch of runs, k = 0 to N - 1; every array has shape (N, runs)."""

    setpoint: Array
    """y_d(k), degC."""
    output: Array
    """y(k), degC."""
    command: Array
    """u(k), t/h."""
    applied: Array
    """u_a(k), t/h."""
    noise: Array
    """n(k), degC."""
    next_error: Array
    """e(k + 1), degC, which the reward of sample k is for. Mean errors are over k = 1 to N."""
    next_setpoint: Array
    """y_d(k + 1), degC."""


def make_plants(num_envs: int, samples: int, **arguments: Any) -> gymnasium.vector.VectorEnv:
    """Make a batch of plants with episodes of `samples` samples."""
    return gymnasium.make_vec(
        "MiddlePoint-v0", num_envs=num_envs, max_episode_steps=samples, **arguments
    )


def drawn_numbers(parameters: Parameters, runs: int, seed: int) -> PlantNumbers[Array]:
    """Return the plant numbers that the environment draws for each run, shape (runs,)."""
    numbers = Ranges(parameters).given.chosen(tuple(PLANT_NUMBERS))
    if parameters.ranges:
        plants = make_plants(runs, 1, **asdict(parameters))
        _, info = plants.reset(seed=seed)
        plants.close()
        numbers |= {name: np.array(info[name]) for name in parameters.ranges}
    return PlantNumbers(
        **{name: np.broadcast_to(value, runs).copy() for name, value in numbers.items()}
    )


def is_random(parameters: Parameters) -> bool:
    """Return whether anything is drawn for an episode, even if only its noise."""
    noises = "noise_variance", "measurement_noise_variance"
    noisy = any(parameters.range_of(name)[1] > 0.0 for name in noises)
    drawn = bool(parameters.ranges) or parameters.setpoint == "random"
    return drawn or noisy or parameters.is_disturbed


def rollout(
    plants: Any,
    agent: Agent,
    samples: int,
    seed: int,
    before: Callable[[int], object] | None = None,
) -> Trajectory:
    """Run a controller on a batch of plants for k = 0 to samples - 1. Both are reset first.

    Plants are a vector environment, or given ones as `mptc_gym.acting` opens them. Run i
    has the noise and the set point of seed `seed + i`. `before` is called with k before
    the controller acts at sample k, to observe or to damage it.
    """
    shape = samples, plants.num_envs
    trajectory = Trajectory(*(np.empty(shape) for _ in fields(Trajectory)))
    agent.reset()
    clock = itertools.count()

    def act(observations: Any) -> Any:
        if before is not None:
            before(next(clock))
        return agent.act(observations)

    for k, (at, after, _) in enumerate(
        run_batch(plants, act, samples, [*range(seed, seed + shape[1])])
    ):
        trajectory.setpoint[k] = at["setpoint"]
        trajectory.output[k] = at["output"]
        trajectory.noise[k] = at["noise"]
        # A step reports the command and the applied input of the sample that it starts at.
        trajectory.command[k] = after["command"]
        trajectory.applied[k] = after["applied"]
        trajectory.next_error[k] = after["error"]
        trajectory.next_setpoint[k] = after["setpoint"]
    return trajectory
