"""Find controllers that anticipate a square wave, and score these at random set points.

A controller anticipates if the controller acts before a change of the set point. Random set
points are constant for at most half a period of the square wave, so that a policy that was
trained with random set points can learn to expect a change after half a period. On the square
wave, a policy that expects the changes can have a smaller mean error than the best controller
without foresight. Since foresight is no skill in control, a report marks controllers that
anticipate, and scores the marked controllers in runs in which nobody can foresee when the set
point changes.
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

# A controller anticipates if the temperature makes at least the share `LEAST_MOVEMENT` of a
# set-point change before the temperature can respond to the change, and if the 95 % confidence
# interval of this share lies above 0.
LEAST_MOVEMENT = 0.05
# Largest number of different unforeseeable set points. As the least possible error for a set
# point takes long to compute, the runs are divided into this many groups, and all runs of a
# group have the same set point.
TIMETABLES = 10
TIMETABLE_SEED = 0  # seed of the first unforeseeable set point, not of an episode


@dataclass(frozen=True)
class Anticipation:
    """How much a controller anticipates set-point changes, and its errors without foresight.

    The errors are mean absolute errors of runs in which nobody can foresee the set point.

    Attributes
    ----------
    movement : Estimate
        Share of a set-point change that the temperature makes before the temperature can
        respond to the change, a mean over the changes of the square wave.
    errors : Array
        Mean absolute errors of the controller in runs with unforeseeable set points, degC,
        shape (members, runs). The members of a controller are its trained networks; a
        controller without trained networks has one member.
    least : float
        Least possible error at unforeseeable set points, degC, a mean over the runs.
    idle : float
        Error of an idle valve (a flow of 0 t/h) at unforeseeable set points, degC, a mean over
        the runs.
    """

    movement: Estimate
    errors: Array
    least: float
    idle: float

    @property
    def ratio(self) -> float:
        """Mean error at unforeseeable set points, divided by the least possible error."""
        return float(self.errors.mean() / self.least)

    @property
    def scores(self) -> Array:
        """Score of each run with an unforeseeable set point, shape (members, runs).

        A score is 0 for the error of an idle valve, and 1 for the least possible error.
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

    A controller that acts before the changes runs again with set points whose changes nobody
    can foresee. The result is None if the controller does not act before the changes, if its
    error is not smaller than with an output of 0 degC, or if the set point of the scenario is
    not a square wave.

    `members` has a record of the controller for each trained network, and `trajectories` has
    the signals of each member in the scenario. Each member has `runs` runs. If all runs are
    equal, the trajectory has only one of them. Run i has the seed `seed + i`.
    """
    if scenario.parameters.setpoint != "square":
        return None
    movement = movement_before_changes(scenario, trajectories)
    if movement is None or movement.low <= 0.0 or movement.value < LEAST_MOVEMENT:
        return None
    # A controller with an unstable loop changes the temperature at all times, but does not
    # anticipate.
    if not follows_setpoint(trajectories):
        return None
    seeds = np.arange(seed, seed + runs)
    are_equal = trajectories[0].output.shape[1] == 1
    return run_surprised(scenario, members, movement, seeds, are_equal)


def follows_setpoint(trajectories: Sequence[Trajectory]) -> bool:
    """Return whether a controller's mean |error| is smaller than with an output of 0 degC."""
    errors = np.concatenate([np.abs(batch.next_error).ravel() for batch in trajectories])
    setpoints = np.concatenate([np.abs(batch.setpoint).ravel() for batch in trajectories])
    return bool(errors.mean() < setpoints.mean())


def movement_before_changes(
    scenario: Scenario, trajectories: Sequence[Trajectory]
) -> Estimate | None:
    """Return how far the output moves to a new set point before it can respond to the change.

    The result is a share of the set-point change, a mean over all changes and all runs. The
    result is None if the set point never changes, or too often for measuring the movement.

    In a plant with a delay of d samples, a flow first affects the output d + 1 samples later.
    Hence the output in the d + 1 samples from a set-point change on does not depend on the
    flows at or after the change. The movement is the mean output in these d + 1 samples, minus
    the mean output in a window of d + 1 samples before the change. If the delay of the plant is
    drawn from a range, d is the smallest delay. The window lies between a quarter and three
    quarters of the time for which the old set point is constant. Of all such windows, the
    movement uses the window in which the mean output is nearest to the new set point. A
    controller whose output oscillates around the old set point, or has not reached the old set
    point, has little or no movement, and does not count as a controller that anticipates.

    The set point of `scenario` must be a square wave, and `trajectories` has the signals of all
    runs of each of the controller's members.
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

    The set point of `scenario` must be a square wave, `members` are the records of the
    controller's members, `movement` is the result of `movement_before_changes`, and `seeds` has
    the seed of each run, shape (runs,). If `are_equal` is true, runs with the same set point
    are equal, so that each member runs only once with each set point.
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
            # The controller is made for the square wave, so that the controller cannot know the
            # times of the set-point changes.
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

    The set point alternates between the two values of the scenario's square wave, and has each
    value for half a period of the square wave on average. When a quarter of the period has
    passed after a change, the set point changes at each sample with the same probability, so
    that the time since the last change does not tell when the next change comes. `seed` is the
    seed of the random times of the changes.
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
