"""Find controllers that act before a square wave changes, and score them in other runs.

A controller anticipates if it acts before a change of the set point. A policy that was trained
with random set points can learn to expect a change after half a period of the square wave, as
this is the longest time for which a random set point is constant. On the square wave, a policy
that expects the changes can have a smaller mean error than the best controller without
foresight. Since foresight is no skill in control, a report marks controllers that anticipate,
and scores them in surprising runs: runs with the same seeds, in which nobody can foresee when
the set point changes.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.bounds.least import least_possible
from benchmarks.controllers.spec import ControllerSpec
from benchmarks.lib.statistics import Estimate, student
from benchmarks.loop.rollout import Trajectory, held, mean_error
from benchmarks.loop.scenarios import Scenario

Array = NDArray[np.float64]

# A controller counts as one that anticipates if the temperature makes at least this share of a
# set-point change before it can respond to the change.
LEAST_MOVEMENT = 0.05
# Number of timetables, which say when the set point changes in surprising runs. As the least
# possible error takes long to compute, a tenth of the runs has the same timetable.
TIMETABLES = 10
TIMETABLE_SEED = 0  # of the random times in the first timetable, not of an episode


@dataclass(frozen=True)
class Anticipation:
    """How much a controller anticipates on a square wave, and its errors in surprising runs.

    In surprising runs, nobody can foresee when the set point changes. The error of a run is the
    mean of |e|, the absolute error, over the samples.

    Attributes
    ----------
    movement : Estimate
        On the square wave: the share of a set-point change that the output has made before the
        output can respond to the change.
    errors : Array
        Errors of the controller in surprising runs, degC, shape (members, runs). The members
        are the trained networks of the controller.
    least : float
        Least possible error in surprising runs without foresight, degC, a mean over the runs.
    idle : float
        Error of an idle valve in surprising runs, degC, a mean over the runs.
    """

    movement: Estimate
    errors: Array
    least: float
    idle: float

    @property
    def ratio(self) -> float:
        """Mean error in surprising runs, divided by the least possible error in these runs."""
        return float(self.errors.mean() / self.least)

    @property
    def scores(self) -> Array:
        """Score of each surprising run, shape (members, runs).

        The score is 0 for the error of an idle valve, and 1 for the least possible error.
        """
        return (self.idle - self.errors) / (self.idle - self.least)


def anticipation(
    scenario: Scenario,
    members: Sequence[ControllerSpec],
    trajectories: Sequence[Trajectory],
    runs: int,
    seed: int,
) -> Anticipation | None:
    """Return how much a controller anticipates the changes of a square wave.

    If the controller does not act before the changes, or the set point is no square wave, the
    result is None. Otherwise, the controller runs again, with set points whose changes nobody
    can foresee.

    Parameters
    ----------
    members
        The records of the controller's members, one for each trained network.
    trajectories
        The signals of each member's runs in the scenario. If all runs of a member are equal,
        the signals are those of a single run.
    runs
        Number of runs of a member.
    seed
        Seed of the first run; run i has the seed `seed + i`.
    """
    if scenario.parameters.setpoint != "square":
        return None
    movement = movement_before_changes(scenario, trajectories)
    if movement is None or movement.low <= 0.0 or movement.value < LEAST_MOVEMENT:
        return None
    # The output of an unstable loop moves at all times, and anticipates nothing.
    if not follows_setpoint(trajectories):
        return None
    seeds = np.arange(seed, seed + runs)
    are_equal = trajectories[0].output.shape[1] == 1
    return run_surprised(scenario, members, movement, seeds, are_equal)


def follows_setpoint(trajectories: Sequence[Trajectory]) -> bool:
    """Return whether the mean error is smaller than that of an output that stays at 0 degC."""
    errors = np.concatenate([np.abs(batch.next_error).ravel() for batch in trajectories])
    setpoints = np.concatenate([np.abs(batch.setpoint).ravel() for batch in trajectories])
    return bool(errors.mean() < setpoints.mean())


def movement_before_changes(
    scenario: Scenario, trajectories: Sequence[Trajectory]
) -> Estimate | None:
    """Return how far the output moves to a new set point before it can respond to the change.

    The result is a share of the set-point change, a mean over all changes. The result is None
    if the set point changes too often for the following comparison.

    With the delay d of the plant, in samples, a flow changes the output d + 1 samples later. So
    the output in the first d + 1 samples after a set-point change does not depend on what the
    controller does at the change or later. The mean output in these d + 1 samples is compared
    with the mean output in a window of d + 1 samples before the change. The window lies between
    a quarter and three quarters of the time for which the old set point is constant. Of all
    windows in this time, the comparison takes the window in which the output, a mean over all
    runs, is nearest to the new set point. Hence a controller whose output oscillates around the
    set point, or has not reached the set point, does not count as a controller that
    anticipates.

    The scenario has a square wave, and `trajectories` has the signals of the runs of each
    member of the controller.
    """
    window = int(scenario.parameters.range_of("delay")[0]) + 1
    setpoint = trajectories[0].setpoint[:, 0]
    outputs = np.hstack([batch.output for batch in trajectories])
    movements = []
    for (start, change), (_, stop) in itertools.pairwise(held(setpoint)):
        quarter = (change - start) // 4
        if 2 * quarter < window or stop - change < window:
            continue
        step = setpoint[change] - setpoint[start]
        shares = (outputs - setpoint[start]) / step  # 0 at the old set point, 1 at the new one
        shares_before = shares[start + quarter : change - quarter]
        windows_before = np.lib.stride_tricks.sliding_window_view(shares_before, window, axis=0)
        means_before = windows_before.mean(axis=-1)  # shape (windows, runs)
        nearest = means_before[np.argmax(means_before.mean(axis=1))]
        shares_after = shares[change : change + window]
        movements.append(shares_after.mean(axis=0) - nearest)
    if not movements:
        return None
    return student(np.mean(movements, axis=0))


def run_surprised(
    scenario: Scenario,
    members: Sequence[ControllerSpec],
    movement: Estimate,
    seeds: NDArray[np.int64],
    are_equal: bool,
) -> Anticipation:
    """Run a controller with set points that nobody can foresee, and return the errors.

    Parameters
    ----------
    scenario
        A scenario with a square wave, which gives the plant of the surprising runs.
    members
        The records of the controller's members, one for each trained network.
    movement
        The result of `movement_before_changes`, which becomes part of the returned object.
    seeds
        The seeds of the runs, shape (runs,).
    are_equal
        Whether nothing but the set point differs between runs, so that one run of each member
        with each set point is enough.
    """
    errors = []
    least_errors: list[float] = []
    idle_errors: list[float] = []
    groups = np.array_split(seeds, min(TIMETABLES, len(seeds)))
    for number, seeds_of_group in enumerate(groups):
        runs = len(seeds_of_group)
        simulated_runs = 1 if are_equal else runs
        first_seed = int(seeds_of_group[0])
        setpoint = surprising_setpoint(scenario, TIMETABLE_SEED + number)
        arguments = {**scenario.arguments, "setpoint": setpoint}
        errors_of_group = []
        for member in members:
            # The controller is made for the scenario with the square wave, so that it cannot
            # know the timetable.
            controller = member.make(scenario.arguments, simulated_runs, first_seed)
            trajectory = member.run(
                arguments, scenario.samples, simulated_runs, first_seed, controller
            )
            errors_of_group.append(np.broadcast_to(mean_error(trajectory), runs))
        least = least_possible(
            samples=scenario.samples, episodes=simulated_runs, seed=first_seed, **arguments
        )
        errors.append(errors_of_group)
        least_errors += [least.value] * runs
        idle_errors += [least.idle.value] * runs
    return Anticipation(
        movement=movement,
        errors=np.concatenate(errors, axis=1),
        least=float(np.mean(least_errors)),
        idle=float(np.mean(idle_errors)),
    )


def surprising_setpoint(scenario: Scenario, seed: int) -> list[float]:
    """Return a set point whose changes nobody can foresee, degC, one number for each sample.

    The set point has the two values of the scenario's square wave, in turn, and stays at each
    value for half a period of the square wave on average. From a quarter of the period after a
    change on, the set point changes at each sample with the same probability. So the time since
    a change does not show when the next change comes. `seed` is the seed of the random times.
    """
    generator = np.random.default_rng(seed)
    parameters = scenario.parameters
    shortest = max(1, parameters.setpoint_period // 4)
    level = parameters.setpoint_amplitude
    setpoint: list[float] = []
    while len(setpoint) <= scenario.samples:
        length = shortest + int(generator.geometric(1.0 / shortest))
        setpoint += [level] * length
        level = -level
    return setpoint[: scenario.samples + 1]
