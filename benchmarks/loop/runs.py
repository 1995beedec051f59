"""Run controllers on batches of plants, and keep the signals of the runs."""

import itertools
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Protocol

import gymnasium
import numpy as np
from numpy.typing import NDArray

from mptc_gym import Parameters  # which registers the environment
from mptc_gym.plant.actuator import action_from_command
from mptc_gym.plant.parameters import PLANT_NUMBERS, PlantNumbers
from mptc_gym.rollout import Act, rollout, start

Array = NDArray[np.float64]


class Agent(Protocol):
    """The interface of a controller that `simulate` runs on a batch of plants."""

    def reset(self) -> None:
        """Prepare for a new episode."""

    def act(self, observation: Any) -> Any:
        """Return the actions of one sample, from -1 to 1, shape (runs, 1).

        `observation` has the observations of the environment, shape (runs, elements).
        """


class IdleValve:
    """A controller that commands a flow of 0 t/h at every sample.

    Parameters
    ----------
    u_min, u_max
        Limits of the actuator, t/h: arrays of shape (runs,), or numbers that apply to all runs.
    """

    def __init__(self, u_min: Any = -10.0, u_max: Any = 10.0) -> None:
        self.action = np.reshape(action_from_command(0.0, u_min, u_max), (-1, 1))

    def reset(self) -> None:
        """Do nothing, since an idle valve does not depend on earlier samples."""

    def act(self, observation: NDArray[np.float32]) -> Array:
        """Return the actions that command a flow of 0 t/h, shape (runs, 1)."""
        return np.broadcast_to(self.action, (len(observation), 1))


@dataclass(frozen=True)
class Trajectory:
    """The signals of a batch of runs at the samples k = 0 to N - 1, each of shape (N, runs)."""

    setpoint: Array  # the set point y_d(k), degC
    output: Array  # the temperature y(k), degC
    command: Array  # the commanded flow u(k), t/h
    applied: Array  # the flow u_a(k) that the actuator applies, t/h
    next_error: Array  # the error e(k + 1), degC, which determines the reward of step k
    next_setpoint: Array  # the set point y_d(k + 1), degC

    def __getitem__(self, index: slice | tuple[slice, slice]) -> "Trajectory":
        """Return the signals at some samples of some runs, such as `trajectory[-50:]`.

        `index` is a slice of the samples, or a slice of the samples and a slice of the runs.
        """
        return Trajectory(*(signal[index] for signal in vars(self).values()))


def make_plants(num_envs: int, samples: int, **arguments: Any) -> gymnasium.vector.VectorEnv:
    """Return a vector environment of `num_envs` plants with episodes of `samples` samples.

    `arguments` are the keyword arguments of the environment `MiddlePoint-v0`.
    """
    return gymnasium.make_vec(
        "MiddlePoint-v0", num_envs=num_envs, max_episode_steps=samples, **arguments
    )


def drawn_numbers(parameters: Parameters, runs: int, seed: int) -> PlantNumbers[Array]:
    """Return the parameter values that the environment draws for the plants of a batch.

    The result has an array of shape (runs,) for each parameter of a plant, such as the delay,
    even if all runs have the same value.

    Parameters
    ----------
    parameters
        Arguments of the environment, some of which may be ranges.
    runs
        Number of runs in the batch.
    seed
        Seed of the first run; run i has the seed `seed + i`.
    """
    # The low end of a range is replaced by the drawn values below.
    numbers: dict[str, Any] = parameters.lowest.select(PLANT_NUMBERS)
    if parameters.ranges:
        # The infos of a reset have the values that it draws; these plants make no step.
        _, info = make_plants(runs, 1, **asdict(parameters)).reset(seed=seed)
        for name in parameters.ranges:
            numbers[name] = info[name]
    for name, values in numbers.items():
        numbers[name] = np.broadcast_to(values, runs).copy()
    return PlantNumbers(**numbers)


def is_random(parameters: Parameters) -> bool:
    """Return whether noise, load, set points or plants are random, so that episodes differ."""
    _, largest_noise_variance = parameters.range_of("noise_variance")
    _, largest_reading_variance = parameters.range_of("measurement_noise_variance")
    return (
        largest_noise_variance > 0.0
        or largest_reading_variance > 0.0
        or parameters.is_disturbed
        or parameters.setpoint == "random"
        or bool(parameters.ranges)
    )


def simulate(plants: Any, agent: Any, samples: int, seed: int) -> Trajectory:
    """Reset a controller and a batch of plants, run them together, and return the signals.

    Parameters
    ----------
    plants
        Vector environment of the plants.
    agent
        Controller, or a policy in another form that `mptc_gym.evaluate` takes, which acts at
        the samples k = 0 to `samples - 1`.
    samples
        Length of a run, samples.
    seed
        Seed of the first run. The environment draws the random numbers of run i, such as the
        noise, with the seed `seed + i`.
    """
    seeds = range(seed, seed + plants.num_envs)
    return _trajectory_of(plants, start(agent, plants.num_envs), samples, seeds)


def simulate_together(
    agents: Sequence[Any], runs: int, samples: int, seed: int, **arguments: Any
) -> list[Trajectory]:
    """Run several controllers on the same episodes, and return the signals of each controller.

    The result equals that of `simulate` for each controller, but takes less time, since the
    plants of all controllers are one batch.

    Parameters
    ----------
    agents
        Controllers, or policies in another form that `mptc_gym.evaluate` takes.
    runs
        Number of runs of each controller.
    samples, seed
        Arguments of `simulate`.
    arguments
        Arguments of the environment.
    """
    acts = [start(agent, runs) for agent in agents]

    def act(observations: Any) -> Array:
        """Return the actions of all controllers, each from the observations of its runs."""
        # The plants of a controller follow those of the controller before, as in `seeds` below.
        parts = zip(acts, np.split(observations, len(acts)), strict=True)
        return np.concatenate([act_of_agent(part) for act_of_agent, part in parts])

    plants = make_plants(len(agents) * runs, samples, **arguments)
    seeds = [*range(seed, seed + runs)] * len(agents)
    trajectory = _trajectory_of(plants, act, samples, seeds)
    # The columns of each controller's runs.
    return [trajectory[:, i : i + runs] for i in range(0, len(seeds), runs)]


def _trajectory_of(plants: Any, act: Act, samples: int, seeds: Sequence[int]) -> Trajectory:
    """Reset plants with `seeds`, run them with the actions of `act`, and return the signals."""
    signals = []
    steps = rollout(plants, act, samples, seeds)
    for sample, next_sample in itertools.pairwise(steps):
        info = sample.infos
        next_info = next_sample.infos
        # The signals are in the order of the fields of `Trajectory`. The infos after a step
        # have the command and the applied flow of the sample at which the step started.
        signals_of_sample = [
            info["setpoint"],
            info["output"],
            next_info["command"],
            next_info["applied"],
            next_info["error"],
            next_info["setpoint"],
        ]
        signals.append(np.array(signals_of_sample))
    return Trajectory(*np.stack(signals, axis=1))
