"""Roll out a controller on a batch of plants, and measure its runs."""

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, Protocol

import gymnasium
import numpy as np
from numpy.typing import NDArray

from mptc_gym import Parameters  # which registers the environment
from mptc_gym.acting import rollout as run_batch
from mptc_gym.adapters import Plants, adapted
from mptc_gym.parameters import PLANT_NUMBERS, PlantNumbers
from mptc_gym.plant import action_from_command, least_effective
from mptc_gym.signals import Ranges

Array = NDArray[np.float64]

SETTLING_BAND = 0.05  # fraction of the set-point change, or of the set point
START = 300  # samples of the start of a run
CHANGE = 60  # samples that a change of the set point counts
LAST = 50  # samples at the end of a run that decide whether it has settled


class Agent(Protocol):
    """The interface of a controller in a rollout."""

    def reset(self) -> None:
        """Prepare for a new episode."""

    def act(self, observation: Any) -> Any:
        """Return actions, shape (runs, 1), for observations, shape (runs, n_obs)."""


class IdleValve:
    """No control: leave the valve at 0 t/h, with limits for all runs or of shape (runs,)."""

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

    setpoint: Array  # y_d(k), degC
    output: Array  # y(k), degC
    command: Array  # u(k), t/h
    applied: Array  # u_a(k), t/h
    next_error: Array  # e(k + 1), degC, which the reward of sample k is for
    next_setpoint: Array  # y_d(k + 1), degC

    def __getitem__(self, samples: slice) -> "Trajectory":
        """Return the signals of some samples."""
        return Trajectory(*(signal[samples] for signal in vars(self).values()))


def make_plants(num_envs: int, samples: int, **arguments: Any) -> gymnasium.vector.VectorEnv:
    """Make a batch of plants with episodes of `samples` samples."""
    return gymnasium.make_vec(
        "MiddlePoint-v0", num_envs=num_envs, max_episode_steps=samples, **arguments
    )


def drawn_numbers(parameters: Parameters, runs: int, seed: int) -> PlantNumbers[Array]:
    """Return the plant numbers that the environment draws for each run, shape (runs,)."""
    numbers = Ranges(parameters).given.chosen(tuple(PLANT_NUMBERS))
    if parameters.ranges:
        _, info = make_plants(runs, 1, **asdict(parameters)).reset(seed=seed)
        numbers |= {name: info[name] for name in parameters.ranges}
    return PlantNumbers(
        **{name: np.broadcast_to(value, runs).copy() for name, value in numbers.items()}
    )


def is_random(parameters: Parameters) -> bool:
    """Return whether anything is drawn for an episode, even if only its noise."""
    noises = "noise_variance", "measurement_noise_variance"
    noisy = any(parameters.range_of(name)[1] > 0.0 for name in noises)
    drawn = noisy or parameters.is_disturbed or parameters.setpoint == "random"
    return drawn or bool(parameters.ranges)


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
    seeds = [*range(seed, seed + plants.num_envs)]
    agent.reset()
    act = partial(_watched, before, itertools.count(), agent.act) if before else agent.act
    given = plants if isinstance(plants, Plants) else adapted(plants)
    signals, steps = [], run_batch(given, act, samples, seeds)
    for (_, at, _), (_, after, _) in itertools.pairwise(steps):
        # A step reports the command and the applied flow of the sample that it starts at.
        here = at["setpoint"], at["output"], after["command"], after["applied"]
        signals.append(np.array([*here, after["error"], after["setpoint"]]))
    return Trajectory(*np.stack(signals, axis=1))


def _watched(before: Callable[[int], object], clock: Iterator[int], act: Any, seen: Any) -> Any:
    """Call `before` with k, and return the actions for observations."""
    before(next(clock))
    return act(seen)


def measure(trajectory: Trajectory, parameters: Parameters) -> dict[str, Array]:
    """Compute the measures of each run by their names in CSV files, each of shape (runs,).

    - `mae`: mean of |e(k)| over k = 1 to N, the errors in the rewards;
    - `mae_start`, `mae_changes`, `mae_steady`: what it is the sum of: the samples before
      `START`, the `CHANGE` samples from a later change of the set point on, with what reaches
      beyond `START` of an earlier one, and the rest;
    - `ise`: integral of e^2 over the same samples;
    - `itae`: integral of t |e|, with t counted from the latest set-point change;
    - `total_variation`: valve travel, the total variation of the applied flow, from rest at 0;
    - `overshoot`: excursion of the output beyond the new set point, as a percentage of the
      set-point change; the largest over all changes;
    - `settling_time`: time from a set-point change until the error stays within `SETTLING_BAND`
      of the change; the longest over all changes, infinite if the output has not settled by the
      next change or the end of the run;
    - `dead_zone_share`: share of samples with the command inside the dead zone;
    - `saturation_share`: share of samples with the command at or beyond a limit.

    The last two are NaN if the actuator's numbers are drawn from ranges.
    """
    interval = parameters.sampling_interval / 60.0  # min
    command, error = trajectory.command, np.abs(trajectory.next_error)
    inside = saturated = np.full(command.shape, np.nan)
    if not {"dead_zone", "u_min", "u_max"} & set(parameters.ranges):
        zone, u_min, u_max = parameters.dead_zone, parameters.u_min, parameters.u_max
        inside = np.abs(command) < least_effective(zone, u_min, u_max)  # as the plant judges it
        saturated = (command <= u_min) | (command >= u_max)
    k = np.arange(1, len(error) + 1)[:, np.newaxis]
    changed = np.diff(trajectory.next_setpoint, axis=0, prepend=trajectory.setpoint[:1]) != 0.0
    latest = np.maximum.accumulate(np.where(changed, k, -CHANGE), axis=0)
    start, moved = k < START, k < latest + CHANGE
    parts = {"start": start, "changes": ~start & moved, "steady": ~start & ~moved}
    pairs = zip(trajectory.setpoint.T, trajectory.output.T, strict=True)
    itae, overshoot, settling = np.array([_measure_steps(*each) for each in pairs]).T
    moves = np.diff(trajectory.applied, axis=0, prepend=0.0)
    return {
        "mae": mean_error(trajectory),
        **{f"mae_{name}": (error * part).mean(axis=0) for name, part in parts.items()},
        "ise": interval * np.square(error).sum(axis=0),
        "itae": interval**2 * itae,
        "total_variation": np.abs(moves).sum(axis=0),
        "overshoot": 100.0 * overshoot,
        "settling_time": interval * settling,
        "dead_zone_share": 100.0 * inside.mean(axis=0),
        "saturation_share": 100.0 * saturated.mean(axis=0),
    }


def _measure_steps(setpoint: Array, output: Array) -> tuple[float, float, float]:
    """Return one run's ITAE (degC samples^2), overshoot (share), settling time (samples)."""
    itae, overshoot, settling = 0.0, 0.0, 0.0
    before = 0.0  # the set point before k = 0
    for start, stop in held(setpoint):
        error = setpoint[start:stop] - output[start:stop]
        itae += float(np.arange(stop - start) @ np.abs(error))
        change, before = setpoint[start] - before, setpoint[start]
        if change == 0.0:  # a run that begins at set point 0
            continue
        overshoot = max(overshoot, float(np.max(-error / change)))
        last = max(np.flatnonzero(np.abs(error) > SETTLING_BAND * abs(change)), default=-1)
        settling = max(settling, math.inf if last == stop - start - 1 else float(last + 1))
    return itae, overshoot, settling


def held(setpoint: Array) -> list[tuple[int, int]]:
    """Return the start and stop sample of each stretch of constant set point."""
    changes = np.flatnonzero(np.diff(setpoint)) + 1
    return list(itertools.pairwise([0, *changes.tolist(), len(setpoint)]))


def mean_error(trajectory: Trajectory) -> Array:
    """Return the mean of |e(k)| over k = 1 to N of each run, degC, shape (runs,)."""
    return np.asarray(np.abs(trajectory.next_error).mean(axis=0))


def settled(trajectory: Trajectory) -> NDArray[np.bool_]:
    """Return whether the last `LAST` errors of each run are all within `SETTLING_BAND`."""
    setpoint, output = trajectory.setpoint[-LAST:], trajectory.output[-LAST:]
    within = np.abs(setpoint - output) <= SETTLING_BAND * np.abs(setpoint)
    return np.asarray(within.all(axis=0))
