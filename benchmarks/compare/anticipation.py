"""Find controllers that move before a square wave changes, and score them by other runs.

A square wave changes at regular times, and its half period is the longest time for which a
random set point holds. So a policy that was trained on random set points can learn from the age
of a level that a change is near. On the square wave, such a policy moves before the change, and
its error is smaller than that of the best controller without foresight. Foresight is no skill
in control. So such a controller is marked, and is scored in other runs with the same seeds,
whose levels hold for times that nobody can foresee.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.controllers.spec import ControllerSpec
from benchmarks.lib.statistics import Estimate, student
from benchmarks.loop.rollout import Trajectory, held, mean_error
from benchmarks.loop.scenarios import Scenario

Array = NDArray[np.float64]

MARKED = 0.05  # A controller that makes this share of a change before the change is marked.
TIMETABLES = 10  # of surprising runs; a tenth of the seeds has the same timetable
TIMETABLE_SEED = 0  # of the changes in the first timetable; it seeds no episode


@dataclass(frozen=True)
class Anticipation:
    """What a controller gains and loses by moving before a square wave changes.

    Attributes
    ----------
    movement : Estimate
        Share of a change that the output has made before it can be a response to the change.
    errors : Array
        Mean |e| of the runs where changes surprise, degC, shape (members, runs).
    least : float
        Least possible mean |e| without foresight where changes surprise, degC.
    idle : float
        Mean |e| of an idle valve where changes surprise, degC.
    """

    movement: Estimate
    errors: Array
    least: float
    idle: float

    @property
    def ratio(self) -> float:
        """Mean error where changes surprise, divided by the least possible error there."""
        return float(self.errors.mean() / self.least)

    @property
    def scores(self) -> Array:
        """Scores of the runs where changes surprise, shape (members, runs)."""
        return (self.idle - self.errors) / (self.idle - self.least)


def anticipation(
    scenario: Scenario,
    members: Sequence[ControllerSpec],
    trajectories: Sequence[Trajectory],
    runs: int,
    seed: int,
) -> Anticipation | None:
    """Return the anticipation of a controller; None if it does not move before changes.

    Parameters
    ----------
    scenario
        The scenario; without a square wave, the result is None.
    members
        The members of the controller.
    trajectories
        The runs of each member in the scenario, or one run of each if all runs are equal.
    runs
        Number of runs of a member.
    seed
        Seed of the first run; run i has the seed `seed + i`.
    """
    if scenario.parameters.setpoint != "square":
        return None
    movement = movement_before_changes(scenario, trajectories)
    if movement is None or movement.low <= 0.0 or movement.value < MARKED:
        return None
    if not _follows(trajectories):
        return None
    seeds = np.arange(seed, seed + runs)
    are_equal = trajectories[0].output.shape[1] == 1
    return _run_surprised(scenario, members, movement, seeds, are_equal)


def _follows(trajectories: Sequence[Trajectory]) -> bool:
    """Return whether the mean error is smaller than that of an output that stays at 0.

    A loop that is unstable moves at all times, and anticipates nothing.
    """
    errors = np.concatenate([np.abs(run.next_error).ravel() for run in trajectories])
    setpoints = np.concatenate([np.abs(run.setpoint).ravel() for run in trajectories])
    return bool(errors.mean() < setpoints.mean())


def movement_before_changes(
    scenario: Scenario, trajectories: Sequence[Trajectory]
) -> Estimate | None:
    """Return how far the output moves to a new set point before it can respond to the change.

    A flow shows d + 1 samples later. So until d samples after a change, the output is that of
    the same seed with a set point that does not change, whatever the controller does at the
    change. The mean output over these d + 1 samples is compared with the mean over d + 1
    samples between a quarter and three quarters of the time for which the level before the
    change holds. Of these, the samples are taken in which the mean of all runs is nearest to
    the new set point. So a controller that swings around the set point, or has not reached it,
    does not count as one that anticipates.

    The result is a share of the change, the mean over all changes. It is None if no level holds
    long enough for the comparison. `trajectories` are the runs of each member.
    """
    window = int(scenario.parameters.range_of("delay")[0]) + 1
    setpoint = trajectories[0].setpoint[:, 0]
    outputs = np.hstack([trajectory.output for trajectory in trajectories])
    movements = []
    for (start, change), (_, stop) in itertools.pairwise(held(setpoint)):
        quarter = (change - start) // 4
        if 2 * quarter < window or stop - change < window:
            continue
        step = setpoint[change] - setpoint[start]
        shares = (outputs - setpoint[start]) / step  # 0 at the old set point, 1 at the new one
        earlier = np.lib.stride_tricks.sliding_window_view(
            shares[start + quarter : change - quarter], window, axis=0
        ).mean(axis=-1)
        nearest = earlier[np.argmax(earlier.mean(axis=1))]
        movements.append(shares[change : change + window].mean(axis=0) - nearest)
    if not movements:
        return None
    return student(np.mean(movements, axis=0))


def _run_surprised(
    scenario: Scenario,
    members: Sequence[ControllerSpec],
    movement: Estimate,
    seeds: NDArray[np.int64],
    are_equal: bool,
) -> Anticipation:
    """Run the members of a controller where changes surprise, and return its anticipation.

    If all runs of a member are equal (`are_equal`), it runs once with each timetable.
    """
    from benchmarks.bounds.least import (
        least_possible,
    )  # imported here, as SciPy is slow to import

    errors = []
    least_errors: list[float] = []
    idle_errors: list[float] = []
    for number, seeds_of_timetable in enumerate(np.array_split(seeds, TIMETABLES)):
        runs = len(seeds_of_timetable)
        if runs == 0:  # There are fewer runs than timetables.
            continue
        first_seed = int(seeds_of_timetable[0])
        count = 1 if are_equal else runs
        timetable = surprising_setpoint(scenario, TIMETABLE_SEED + number)
        arguments = {**scenario.arguments, "setpoint": timetable}
        errors_of_members = []
        for member in members:
            # It is made for the published scenario, so that it does not know the timetable.
            controller = member.make(scenario.arguments, count, first_seed)
            trajectory = member.run(arguments, scenario.samples, count, first_seed, controller)
            errors_of_members.append(np.broadcast_to(mean_error(trajectory), runs))
        bound = least_possible(
            samples=scenario.samples, episodes=count, seed=first_seed, **arguments
        )
        errors.append(errors_of_members)
        least_errors += [bound.value] * runs
        idle_errors += [bound.idle.value] * runs
    return Anticipation(
        movement,
        np.concatenate(errors, axis=1),
        float(np.mean(least_errors)),
        float(np.mean(idle_errors)),
    )


def surprising_setpoint(scenario: Scenario, seed: int) -> list[float]:
    """Return a square wave whose changes nobody can foresee, degC, one number a sample.

    Its levels are those of the scenario's square wave, and hold as long on average. From half
    of that time on, a level ends at each sample with the same probability. So the age of a
    level does not tell when the level will end.
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
