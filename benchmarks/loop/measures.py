"""Compute measures of runs from their signals, such as mean errors and settling times."""

import itertools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.loop.runs import Trajectory
from mptc_gym import Parameters
from mptc_gym.scores import mean_absolute_error, valve_travel

Array = NDArray[np.float64]

# Largest error of a settled output, divided by the set-point change (in `measure`) or by the
# set point (in `settled`).
SETTLING_BAND = 0.05
LAST_SAMPLES = 50  # number of last samples of a run from which `settled` decides


def measure(trajectory: Trajectory, parameters: Parameters) -> dict[str, Array]:
    """Return the measures of each run by their names in CSV files, each of shape (runs,).

    `parameters` are the arguments of the environment in which the controller ran. The measure
    `mae` uses the errors e(k) at the samples k = 1 to N, and the other measures use the signals
    at the samples k = 0 to N - 1. A set point other than 0 at k = 0 counts as a set-point
    change for `overshoot` and `settling_time`. The measures are:

    - `mae`: mean of |e(k)|, degC;
    - `itae`: integral of t |e| over time, degC min^2, where t is the time since the latest
      set-point change, or since k = 0 before the first change;
    - `total_variation`: valve travel, the sum of the magnitudes of all changes of the applied
      flow, t/h, including the first change from 0 t/h;
    - `overshoot`: largest distance of the output beyond a new set point, in percent of the
      set-point change; the maximum over all changes;
    - `settling_time`: time from a set-point change until the error stays within `SETTLING_BAND`
      times the change, min; the maximum over all changes, and infinite if the output has not
      settled before the next change or the end of the run;
    - `saturation_share`: share of samples with the command at or beyond a limit, %.
    """
    interval = parameters.sampling_interval / 60.0  # min
    limits = parameters.lowest  # u_min and u_max are never ranges
    command = trajectory.command
    is_at_limit = (command <= limits.u_min) | (command >= limits.u_max)
    step_measures = [
        _measure_steps(setpoint, output)
        for setpoint, output in zip(trajectory.setpoint.T, trajectory.output.T, strict=True)
    ]
    return {
        "mae": mean_error(trajectory),
        "itae": interval**2 * np.array([run.itae for run in step_measures]),
        "total_variation": valve_travel(trajectory.applied),
        "overshoot": 100.0 * np.array([run.overshoot for run in step_measures]),
        "settling_time": interval * np.array([run.settling_time for run in step_measures]),
        "saturation_share": 100.0 * is_at_limit.mean(axis=0),
    }


class _StepMeasures(NamedTuple):
    """Measures of one run that depend on the times of set-point changes."""

    itae: float  # integral of time since the change times |error|, degC samples^2
    overshoot: float  # largest overshoot, divided by the set-point change
    settling_time: float  # longest settling time, samples; may be infinite


def _measure_steps(setpoint: Array, output: Array) -> _StepMeasures:
    """Return the measures of one run that depend on the times of set-point changes.

    `setpoint` has the set points and `output` the temperatures of the run, degC, both of shape
    (samples,).
    """
    itae = 0.0
    overshoot = 0.0
    settling_time = 0.0
    previous_setpoint = 0.0  # before k = 0
    for first, stop in held(setpoint):
        errors = setpoint[first:stop] - output[first:stop]
        itae += float(np.arange(stop - first) @ np.abs(errors))
        change = setpoint[first] - previous_setpoint
        previous_setpoint = setpoint[first]
        if change == 0.0:  # The first set point is 0.
            continue
        # The output minus the set point, in the direction of the change.
        overshoot = max(overshoot, float(np.max(-errors / change)))
        outside = np.flatnonzero(np.abs(errors) > SETTLING_BAND * abs(change))
        if len(outside) == 0:
            continue
        samples_outside = float(outside[-1] + 1)  # up to the last error outside the band
        if samples_outside == stop - first:  # The output has not settled at the end.
            samples_outside = math.inf
        settling_time = max(settling_time, samples_outside)
    return _StepMeasures(itae, overshoot, settling_time)


def held(setpoint: Array) -> list[tuple[int, int]]:
    """Return a pair (start, stop) for each period in which the set point is constant.

    The pair (start, stop) stands for the samples k = start to stop - 1. `setpoint` has the set
    points of one run, degC, shape (samples,).
    """
    changes = np.flatnonzero(np.diff(setpoint)) + 1
    return list(itertools.pairwise([0, *changes.tolist(), len(setpoint)]))


def mean_error(trajectory: Trajectory) -> Array:
    """Return the mean absolute error of each run, degC, shape (runs,)."""
    return mean_absolute_error(trajectory.next_error)


def settled(trajectory: Trajectory) -> NDArray[np.bool_]:
    """Return whether the output of each run has settled at the end of the run, shape (runs,).

    The output has settled if the magnitude of each of the last `LAST_SAMPLES` errors of the run
    is at most `SETTLING_BAND` times the magnitude of the set point.
    """
    setpoint = trajectory.setpoint[-LAST_SAMPLES:]
    output = trajectory.output[-LAST_SAMPLES:]
    is_within = np.abs(setpoint - output) <= SETTLING_BAND * np.abs(setpoint)
    return np.asarray(is_within.all(axis=0))
