"""Roll out a controller on a batch of plants, and measure its runs."""

import itertools
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple, Protocol

import gymnasium
import numpy as np
from numpy.typing import NDArray

from mptc_gym import Parameters  # which registers the environment
from mptc_gym.draws import Ranges
from mptc_gym.parameters import PLANT_NUMBERS, PlantNumbers
from mptc_gym.plant import action_from_command, least_effective
from mptc_gym.scoring.rollout import rollout as run_batch

Array = NDArray[np.float64]

SETTLING_BAND = 0.05  # fraction of the set-point change, or of the set point
START = 300  # samples that count as the start of a run
CHANGE = 60  # samples that count as a response to a change of the set point
LAST = 50  # samples at the end of a run that decide whether it has settled


class Agent(Protocol):
    """The interface of a controller in a rollout."""

    def reset(self) -> None:
        """Prepare for a new episode."""

    def act(self, observation: Any) -> Any:
        """Return actions, shape (runs, 1), for observations, shape (runs, n_obs)."""


class IdleValve:
    """No control: the valve stays at 0 t/h.

    `u_min` and `u_max` are the limits of the actuator, t/h, of shape (runs,) or the same for
    all runs.
    """

    def __init__(self, u_min: Any = -10.0, u_max: Any = 10.0) -> None:
        self.action = np.reshape(action_from_command(0.0, u_min, u_max), (-1, 1))

    def reset(self) -> None:
        """Remember nothing."""

    def act(self, observation: NDArray[np.float32]) -> Array:
        """Return the actions that keep the flow at 0 t/h, shape (runs, 1)."""
        return np.broadcast_to(self.action, (len(observation), 1))


@dataclass(frozen=True)
class Trajectory:
    """The signals of a batch of runs, k = 0 to N - 1; every array has shape (N, runs)."""

    setpoint: Array  # y_d(k), degC
    output: Array  # y(k), degC
    command: Array  # u(k), t/h
    applied: Array  # u_a(k), t/h
    next_error: Array  # e(k + 1), degC, which the reward of sample k is for
    next_setpoint: Array  # y_d(k + 1), degC

    def __getitem__(self, samples: slice) -> "Trajectory":
        """Return the trajectory of a slice of the samples."""
        return Trajectory(*(signal[samples] for signal in vars(self).values()))


def make_plants(num_envs: int, samples: int, **arguments: Any) -> gymnasium.vector.VectorEnv:
    """Return a vector environment of `num_envs` plants with episodes of `samples` samples."""
    return gymnasium.make_vec(
        "MiddlePoint-v0", num_envs=num_envs, max_episode_steps=samples, **arguments
    )


def drawn_numbers(parameters: Parameters, runs: int, seed: int) -> PlantNumbers[Array]:
    """Return the plant numbers of run i = 0 to runs - 1, as drawn with the seed `seed + i`.

    Each number is an array of shape (runs,), also if it is the same for all runs.
    """
    numbers = Ranges(parameters).lowest.chosen(PLANT_NUMBERS)
    if parameters.ranges:
        _, info = make_plants(runs, 1, **asdict(parameters)).reset(seed=seed)
        for name in parameters.ranges:
            numbers[name] = info[name]
    return PlantNumbers(
        **{name: np.broadcast_to(values, runs).copy() for name, values in numbers.items()}
    )


def is_random(parameters: Parameters) -> bool:
    """Return whether anything is drawn for an episode, even if only its noise."""
    _, largest_noise = parameters.range_of("noise_variance")
    _, largest_measurement_noise = parameters.range_of("measurement_noise_variance")
    return (
        largest_noise > 0.0
        or largest_measurement_noise > 0.0
        or parameters.is_disturbed
        or parameters.setpoint == "random"
        or bool(parameters.ranges)
    )


def rollout(
    plants: Any,
    agent: Agent,
    samples: int,
    seed: int,
    before: Callable[[int], object] | None = None,
) -> Trajectory:
    """Run a controller on a batch of plants for k = 0 to samples - 1. Both are reset first.

    Parameters
    ----------
    plants
        A vector environment.
    agent
        The controller.
    samples
        Length of the runs.
    seed
        Run i has the noise and the set point of seed `seed + i`.
    before
        Called with k before the controller acts at sample k, to observe or to damage it.
    """
    clock = itertools.count()

    def act(observations: Any) -> Any:
        if before:
            before(next(clock))
        return agent.act(observations)

    agent.reset()
    seeds = [*range(seed, seed + plants.num_envs)]
    signals = []
    steps = run_batch(plants, act, samples, seeds)
    for sample, next_sample in itertools.pairwise(steps):
        info = sample.infos
        next_info = next_sample.infos
        # A step reports the command and the applied flow of the sample at which it starts.
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


def measure(trajectory: Trajectory, parameters: Parameters) -> dict[str, Array]:
    """Return the measures of each run by their names in CSV files, each of shape (runs,).

    `parameters` are the arguments of the environment in which the controller ran.

    - `mae`: mean of |e(k)| over k = 1 to N, degC;
    - `mae_start`, `mae_changes`, `mae_steady`: three parts, degC, whose sum is `mae`: the part
      of the samples before `START`, the part of the later samples that lie less than `CHANGE`
      after a change of the set point, and the part of the remaining samples;
    - `ise`: integral of e^2 over k = 1 to N, degC^2 min;
    - `itae`: integral of t |e|, degC min^2, with t counted from the latest set-point change;
    - `total_variation`: valve travel, the total variation of the applied flow, from rest at 0,
      t/h;
    - `overshoot`: excursion of the output beyond the new set point, as a percentage of the
      set-point change; the largest over all changes;
    - `settling_time`: time from a set-point change until the error stays within `SETTLING_BAND`
      of the change, min; the longest over all changes, infinite if the output has not settled
      by the next change or the end of the run;
    - `dead_zone_share`: share of samples with the command inside the dead zone, %;
    - `saturation_share`: share of samples with the command at or beyond a limit, %.

    The two shares are NaN if the dead zone or a limit is drawn from a range.
    """
    interval = parameters.sampling_interval / 60.0  # min
    errors = np.abs(trajectory.next_error)
    steps = [
        _measure_steps(setpoint, output)
        for setpoint, output in zip(trajectory.setpoint.T, trajectory.output.T, strict=True)
    ]
    moves = np.diff(trajectory.applied, axis=0, prepend=0.0)
    return {
        "mae": mean_error(trajectory),
        **_parts_of_error(trajectory),
        "ise": interval * np.square(errors).sum(axis=0),
        "itae": interval**2 * np.array([step.itae for step in steps]),
        "total_variation": np.abs(moves).sum(axis=0),
        "overshoot": 100.0 * np.array([step.overshoot for step in steps]),
        "settling_time": interval * np.array([step.settling for step in steps]),
        **_actuator_shares(trajectory.command, parameters),
    }


def _parts_of_error(trajectory: Trajectory) -> dict[str, Array]:
    """Return the three parts of the mean error by name, degC, each of shape (runs,)."""
    errors = np.abs(trajectory.next_error)
    k = np.arange(1, len(errors) + 1)[:, np.newaxis]
    setpoint_moves = np.diff(trajectory.next_setpoint, axis=0, prepend=trajectory.setpoint[:1])
    latest_change = np.maximum.accumulate(np.where(setpoint_moves != 0.0, k, -CHANGE), axis=0)
    is_start = k < START
    is_change = k < latest_change + CHANGE
    return {
        "mae_start": (errors * is_start).mean(axis=0),
        "mae_changes": (errors * (~is_start & is_change)).mean(axis=0),
        "mae_steady": (errors * (~is_start & ~is_change)).mean(axis=0),
    }


def _actuator_shares(command: Array, parameters: Parameters) -> dict[str, Array]:
    """Return the shares of commands in the dead zone and at a limit, %, each of shape (runs,).

    `command` is in t/h, of shape (N, runs).
    """
    if {"dead_zone", "u_min", "u_max"} & set(parameters.ranges):
        unknown = np.full(command.shape[1], np.nan)
        return {"dead_zone_share": unknown, "saturation_share": unknown}
    u_min, u_max = parameters.u_min, parameters.u_max
    # The smallest command, t/h, that the plant does not take to be inside the dead zone.
    edge = least_effective(parameters.dead_zone, u_min, u_max)
    is_inside = np.abs(command) < edge
    is_at_limit = (command <= u_min) | (command >= u_max)
    return {
        "dead_zone_share": 100.0 * is_inside.mean(axis=0),
        "saturation_share": 100.0 * is_at_limit.mean(axis=0),
    }


class _Steps(NamedTuple):
    """Measures of the responses to the steps of the set point in one run; see `measure`."""

    itae: float  # degC samples^2
    overshoot: float  # share of the step
    settling: float  # samples


def _measure_steps(setpoint: Array, output: Array) -> _Steps:
    """Return the measures of one run from y_d(k) and y(k), degC, each of shape (N,)."""
    itae = 0.0
    overshoot = 0.0
    settling = 0.0
    previous_setpoint = 0.0  # before k = 0
    for start, stop in held(setpoint):
        errors = setpoint[start:stop] - output[start:stop]
        itae += float(np.arange(stop - start) @ np.abs(errors))
        change = setpoint[start] - previous_setpoint
        previous_setpoint = setpoint[start]
        if change == 0.0:  # a run that begins at set point 0
            continue
        overshoot = max(overshoot, float(np.max(-errors / change)))
        outside = np.flatnonzero(np.abs(errors) > SETTLING_BAND * abs(change))
        if len(outside) == 0:
            continue
        if outside[-1] == stop - start - 1:  # not settled at the end
            settling = math.inf
        settling = max(settling, float(outside[-1] + 1))
    return _Steps(itae, overshoot, settling)


def held(setpoint: Array) -> list[tuple[int, int]]:
    """Return the stretches of constant set point, as the slices start:stop of the samples.

    `setpoint` is y_d(k), degC, of one run, shape (samples,).
    """
    changes = np.flatnonzero(np.diff(setpoint)) + 1
    return list(itertools.pairwise([0, *changes.tolist(), len(setpoint)]))


def mean_error(trajectory: Trajectory) -> Array:
    """Return the mean of |e(k)| over k = 1 to N of each run, degC, shape (runs,)."""
    return np.asarray(np.abs(trajectory.next_error).mean(axis=0))


def settled(trajectory: Trajectory) -> NDArray[np.bool_]:
    """Return whether each run has settled, shape (runs,).

    A run has settled if its last `LAST` errors are all within `SETTLING_BAND` of the set point.
    """
    setpoint = trajectory.setpoint[-LAST:]
    output = trajectory.output[-LAST:]
    is_within = np.abs(setpoint - output) <= SETTLING_BAND * np.abs(setpoint)
    return np.asarray(is_within.all(axis=0))
