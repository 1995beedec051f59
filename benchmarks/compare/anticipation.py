"""Tell which controllers move before a square wave changes, and score them where it surprises.

The square wave changes as regularly as a clock, and its half period is the longest time that a
random set point holds. So a policy that is trained on random set points can learn from the age
of a level that a change is near. On the square wave it then moves before anything has happened,
and its error is smaller than that of the best controller without foresight. That is no skill in
control, so such a controller is marked, and scored in other runs with the same seeds: there the
levels hold for times that nobody can foresee.
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

MARKED = 0.05  # share of a change from which a movement before it is marked
TIMETABLES = 10  # of surprising runs: each is the set point of a tenth of the seeds
TIMETABLE_SEED = 0  # of the times at which the first timetable changes; it draws no episode


@dataclass(frozen=True)
class Anticipation:
    """What a controller that moves before a square wave changes gains and loses by that."""

    movement: Estimate
    """Share of the change that the output has made before it can have been a response."""
    errors: Array
    """Mean |e| where changes surprise, degC, shape (members, runs)."""
    least: float
    """Least possible mean |e| without foresight where changes surprise, degC."""
    idle: float
    """Mean |e| without control where changes surprise, degC."""

    @property
    def ratio(self) -> float:
        """Mean error where changes surprise as a multiple of the least possible."""
        return float(self.errors.mean() / self.least)

    @property
    def scores(self) -> Array:
        """Scores where changes surprise, shape (members, runs)."""
        return (self.idle - self.errors) / (self.idle - self.least)


def anticipation(
    scenario: Scenario,
    members: Sequence[ControllerSpec],
    trajectories: Sequence[Trajectory],
    runs: int,
    seed: int,
) -> Anticipation | None:
    """Return the anticipation of a controller, or None if it does not move before changes.

    The trajectories are those of its members on the case, with seeds from `seed` on. They may
    hold a single run if all runs are alike.
    """
    if scenario.parameters.setpoint != "square":
        return None
    moved = movement_before_changes(scenario, trajectories)
    if moved is None or moved.low <= 0.0 or moved.value < MARKED:
        return None
    seeds = np.arange(seed, seed + runs)
    are_alike = trajectories[0].output.shape[1] == 1
    return _surprised(scenario, members, moved, seeds, are_alike)


def movement_before_changes(
    scenario: Scenario, trajectories: Sequence[Trajectory]
) -> Estimate | None:
    """Return how far the output moves towards a new set point before it can respond to it.

    A flow shows d + 1 samples later. So until d samples after a change the output is that of
    the same seed with a set point that holds on, whatever the controller does at the change.
    The mean output over these d + 1 samples is compared with the mean over as many samples
    between a quarter and three quarters of the same hold: those in which the mean of all runs
    is nearest to the new set point. So a controller that swings around the set point, or has
    not reached it, is not taken for one that anticipates.

    The result is a share of the change, the mean over all changes. It is None if no level holds
    long enough for such a comparison.
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
        shares = (outputs - setpoint[start]) / step  # 0: the old set point; 1: the new one
        earlier = np.lib.stride_tricks.sliding_window_view(
            shares[start + quarter : change - quarter], window, axis=0
        ).mean(axis=-1)
        nearest = earlier[np.argmax(earlier.mean(axis=1))]
        movements.append(shares[change : change + window].mean(axis=0) - nearest)
    return student(np.mean(movements, axis=0)) if movements else None


def _surprised(
    scenario: Scenario,
    members: Sequence[ControllerSpec],
    movement: Estimate,
    seeds: NDArray[np.int64],
    are_alike: bool,
) -> Anticipation:
    """Run the members where changes surprise; if runs `are_alike`, once for each timetable."""
    from benchmarks.bounds.least import least_possible  # here: SciPy is slow to import

    errors, least, idle = [], [], []
    for number, share in enumerate(np.array_split(seeds, TIMETABLES)):
        if not len(share):  # fewer runs than timetables
            continue
        first = int(share[0])
        count = 1 if are_alike else len(share)
        timetable = surprising_setpoint(scenario, TIMETABLE_SEED + number)
        arguments = {**scenario.arguments, "setpoint": timetable}
        of_members = []
        for member in members:
            # It is made for the published case, so that no argument tells it the timetable.
            controller = member.make(scenario.arguments, count, first)
            trajectory = member.run(arguments, scenario.samples, count, first, controller)
            of_members.append(np.broadcast_to(mean_error(trajectory), len(share)))
        bound = least_possible(
            samples=scenario.samples, episodes=count, seed=first, **arguments
        )
        errors.append(of_members)
        least += [bound.value] * len(share)
        idle += [bound.idle.value] * len(share)
    return Anticipation(
        movement, np.concatenate(errors, axis=1), float(np.mean(least)), float(np.mean(idle))
    )


def surprising_setpoint(scenario: Scenario, seed: int) -> list[float]:
    """Return a square wave whose changes nobody can foresee, degC, one number a sample.

    The levels are those of the published square wave, and hold as long on average. But after
    half of that time a level may end at each sample, always with the same probability, so that
    its age tells nothing about what is left.
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
