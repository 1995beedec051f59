"""Generate the external signals of an episode: set point, noise and load disturbance.

Every signal class has three methods. `reset` begins an episode of some plants at sample k = 0.
`next` returns the next sample of all plants. `ahead` takes the place of `next` where there is
one plant only, and returns the next `BLOCK` samples of this plant.

Noise and load disturbance are generated a block of samples at a time: drawing many random
numbers in one call is much faster than drawing the random numbers one by one, and gives the
same random numbers.

The names in formulas are those of the paper: set point y_d(k), temperature y(k), coloured noise
n(k) = C(z^-1) xi(k) with white noise xi, and, not in the paper, load disturbance w(k).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mptc_gym.plant.draws import EpisodeStream, Streams
from mptc_gym.plant.parameters import Parameters, PlantNumbers

# One element per plant, shape (n,); a plant number that all plants share has the shape ().
Values = NDArray[np.float64]
Indices = NDArray[np.intp]  # the indices of some plants, in ascending order
StreamsOfPlants = Mapping[int, Streams] | Sequence[Streams]  # by the index of the plant

BLOCK = 600  # samples of a signal that are generated together, as single draws are slow
FOREVER = 1 << 62  # samples: longer than any episode, and small enough to add to another int64
PLANTS_AT_A_TIME = 32  # so few that their random numbers stay in the processor's cache
LOAD_INTERVAL = 10  # samples between two changes of the load disturbance, which is slow
# Values of the load disturbance that are generated together: those of `BLOCK` samples.
LEVELS_AT_A_TIME = BLOCK // LOAD_INTERVAL
ONE = np.zeros(1, np.intp)  # `which` for an environment with one plant: the index 0


def colours(parameters: Parameters) -> dict[str, Sequence[float]]:
    """Return the coefficients that colour each noise which is not always 0, by name.

    "noise" has the coefficients of the polynomial C of equation (28) of the paper, from z^0 on.
    The transmitter's "measurement_noise" is white: its only coefficient is 1. A noise whose
    variance in the arguments `parameters` is 0 is left out.
    """
    coefficients = {"noise": parameters.c, "measurement_noise": (1.0,)}
    return {
        name: c
        for name, c in coefficients.items()
        if parameters.range_of(f"{name}_variance")[1] > 0.0
    }


class Noise:
    """The plant's noise or the transmitter's noise, for many plants; 0 at k = 0.

    Parameters
    ----------
    name
        "noise" for the coloured noise n(k) = C(z^-1) xi(k) of equation (28) of the paper, with
        white noise xi; or "measurement_noise" for the noise of the transmitter.
    c
        The coefficients of C, from z^0 on.
    num_envs
        Number n of plants.
    block
        How many samples are generated at a time.
    """

    def __init__(self, name: str, c: Sequence[float], num_envs: int, block: int) -> None:
        self._name = name
        self._c = np.array(c)[:, np.newaxis, np.newaxis]
        # Coefficients of C times the standard deviation of the white noise xi, degC, shape
        # (number of coefficients, num_envs, 1).
        self._scaled_c = np.zeros((len(c), num_envs, 1))
        # The latest white noise of each plant, the oldest first, as multiples of the standard
        # deviation.
        self._past = np.zeros((num_envs, len(c) - 1))
        # The noise of a block, degC: one row per sample, so that the values that all plants
        # need at once are contiguous.
        self._block = np.zeros((block, num_envs))
        self._row = 0  # the row of the next sample

    def reset(
        self, which: Indices, streams: StreamsOfPlants, numbers: PlantNumbers[Values]
    ) -> None:
        """Begin an episode of some plants.

        Parameters
        ----------
        which
            The indices of the plants.
        streams
            The random number streams of all plants, by index.
        numbers
            The plant numbers of these plants, which hold the variance of the noise.
        """
        deviations = np.sqrt(getattr(numbers, f"{self._name}_variance"))
        self._scaled_c[:, which] = deviations[..., np.newaxis] * self._c
        self._past[which] = 0.0
        self._streams = streams
        for i in which.tolist():
            getattr(streams[i], self._name).next_episode()
        if len(which) == len(self._past):
            self._row = len(self._block)
        else:
            self._fill(which, self._row)

    def next(self) -> Values:
        """Return the noise of all plants at the next sample, degC, shape (num_envs,).

        The caller must not modify the result.
        """
        if self._row == len(self._block):
            self._fill(np.arange(len(self._past)), 0)
            self._row = 0
        row: Values = self._block[self._row]
        self._row += 1
        return row

    def ahead(self) -> list[float]:
        """Return the noise at the samples of the next block, degC, for the only plant."""
        self._fill(ONE, 0)
        noise: list[float] = self._block[:, 0].tolist()
        return noise

    def _fill(self, which: Indices, first_row: int) -> None:
        """Generate noise of the plants `which`, from `first_row` to the end of the block."""
        order = len(self._c) - 1
        samples = len(self._block) - first_row
        for start in range(0, len(which), PLANTS_AT_A_TIME):
            plants = which[start : start + PLANTS_AT_A_TIME]
            xi = np.empty((len(plants), order + samples))
            xi[:, :order] = self._past[plants]
            for i, row in zip(plants.tolist(), xi[:, order:], strict=True):
                getattr(self._streams[i], self._name).generator.standard_normal(out=row)
            self._past[plants] = xi[:, samples:]
            # A slice is much faster than indices, but needs plants without gaps.
            has_gaps = plants[-1] - plants[0] >= len(plants)
            columns = plants if has_gaps else slice(plants[0], plants[-1] + 1)
            c = self._scaled_c[:, columns]
            noise = c[0] * xi[:, order:]
            for lag, coefficient in enumerate(c[1:], start=1):
                noise += coefficient * xi[:, order - lag : -lag]
            self._block[first_row:, columns] = noise.T


class Levels:
    """The levels of a set point, in degC, and for how many samples each level is held.

    Parameters
    ----------
    parameters
        The arguments of the environment, of which `setpoint`, `setpoint_amplitude` and
        `setpoint_period` matter.

    Attributes
    ----------
    random : bool
        Whether levels are random: uniform within +-`amplitude`, degC, and each held for a
        random number of samples from `shortest` to `longest`, both included.
    values, lengths : list
        The levels, degC, and for how many samples each level holds. After the last level, the
        first level follows again. Of no use if levels are random.
    """

    values: list[float]
    lengths: list[int]

    def __init__(self, parameters: Parameters) -> None:
        setpoint = parameters.setpoint
        period = parameters.setpoint_period
        self.random = setpoint == "random"
        self.amplitude = parameters.setpoint_amplitude
        self.shortest = max(1, math.ceil(period / 6))
        self.longest = max(self.shortest, period // 2)
        if isinstance(setpoint, str):  # "square"
            self.values = [self.amplitude, -self.amplitude]
            self.lengths = [(period + 1) // 2, period // 2]
        elif isinstance(setpoint, float):  # a constant
            self.values = [setpoint]
            self.lengths = [FOREVER]
        else:  # one number per sample, the last one held
            self.values = list(setpoint)
            self.lengths = [1] * (len(self.values) - 1) + [FOREVER]

    def next(self, place: int, stream: EpisodeStream) -> tuple[float, int]:
        """Return a level of the set point, degC, and for how many samples the level holds.

        Parameters
        ----------
        place
            The number of the level in the episode, counted from 0. Of no use if levels are
            random.
        stream
            The random number stream from which a random level is drawn.
        """
        if self.random:
            level = stream.generator.uniform(-self.amplitude, self.amplitude)
            length = stream.generator.integers(self.shortest, self.longest, endpoint=True)
            return level, int(length)
        place_in_period = place % len(self.values)
        return self.values[place_in_period], self.lengths[place_in_period]


class _HeldValues(ABC):
    """A signal of many plants whose value is held until the time of the next change.

    Times are counted in samples since the plants were created.

    Parameters
    ----------
    num_envs
        Number n of plants.

    Attributes
    ----------
    present : ndarray of float64
        The present value of each plant, degC, shape (num_envs,). Other objects must not modify
        the array.
    """

    def __init__(self, num_envs: int) -> None:
        self.present = np.zeros(num_envs)
        self._clock = 0  # the present time
        self._due = np.zeros(num_envs, np.int64)  # the time of each plant's next change
        self._earliest_due = 0

    def next(self) -> Values:
        """Return the values of all plants at the next sample, degC, shape (num_envs,).

        The caller must not modify the result.
        """
        self._clock += 1
        if self._clock >= self._earliest_due:
            self._make_due_changes()
        return self.present

    def _make_due_changes(self) -> None:
        """Change the value of each plant whose time of change has come, until none is due."""
        # A level may hold for 0 samples, as with a period of 1: the value then changes again at
        # once.
        while self._clock >= self._earliest_due:
            self._change(self._due <= self._clock)
            self._earliest_due = int(self._due.min())

    @abstractmethod
    def _change(self, is_due: NDArray[np.bool_]) -> None:
        """Change the values that are due, and set the times of their next changes.

        `is_due` has the shape (num_envs,): True for the plants whose value changes.
        """


class SetPoint(_HeldValues):
    """The set point y_d(k) of many plants, in degC.

    Parameters
    ----------
    parameters
        The arguments of the environment.
    num_envs
        Number n of plants.
    """

    def __init__(self, parameters: Parameters, num_envs: int) -> None:
        super().__init__(num_envs)
        self._levels = Levels(parameters)
        self._level_values = np.array(self._levels.values)
        self._level_lengths = np.array(self._levels.lengths)
        self._places = np.zeros(num_envs, np.intp)  # index of each plant's next level

    def reset(self, which: Indices, streams: StreamsOfPlants) -> Values:
        """Begin an episode of some plants, and return y_d(0), degC, shape (len(which),).

        `which` holds the indices of the plants, and `streams` the random number streams of all
        plants.
        """
        self._streams = streams
        if self._levels.random:
            for i in which.tolist():
                streams[i].setpoint.next_episode()
        # The first level of the episode begins at the present sample.
        self._places[which] = 0
        self._due[which] = self._clock
        self._earliest_due = self._clock
        self._make_due_changes()
        return self.present[which]

    def ahead(self) -> list[float]:
        """Return the set points of the next `BLOCK` samples, degC, for the only plant."""
        level = self.present.item()
        place = self._places.item()
        remaining = self._earliest_due - self._clock - 1  # samples with the present level
        values: list[float] = []
        while len(values) + remaining < BLOCK:
            values += [level] * remaining
            level, remaining = self._levels.next(place, self._streams[0].setpoint)
            place += 1
        remaining -= BLOCK - len(values)
        values += [level] * (BLOCK - len(values))
        self.present[0] = level
        self._places[0] = place
        self._clock += BLOCK
        self._earliest_due = self._clock + 1 + remaining
        return values

    def _change(self, is_due: NDArray[np.bool_]) -> None:
        """Begin the next level of the set point where `is_due`, shape (num_envs,), is True."""
        which = np.flatnonzero(is_due)
        if self._levels.random:
            for i in which.tolist():
                self.present[i], length = self._levels.next(0, self._streams[i].setpoint)
                self._due[i] += length
        else:
            places = self._places[which]
            self.present[which] = self._level_values[places]
            self._due[which] += self._level_lengths[places]
            self._places[which] = (places + 1) % len(self._level_values)


class Disturbance(_HeldValues):
    """The load disturbance w(k), degC: the sum of steps and a random walk, both starting at 0.

    The load changes every `LOAD_INTERVAL` samples. At each change, the walk takes a random
    step, uniform, whose variance gives the walk the required variance per sample; the sum of
    many such steps is close to normal. Also at each change, the sum of steps jumps, with a
    probability of `LOAD_INTERVAL / disturbance_interval`, to a new level, uniform within
    +-`disturbance_amplitude`.

    Parameters
    ----------
    num_envs
        Number n of plants.
    """

    def __init__(self, num_envs: int) -> None:
        super().__init__(num_envs)
        self._amplitudes = np.zeros(num_envs)  # largest magnitude of a level, degC
        self._probabilities = np.zeros(num_envs)  # probability of a jump at each change
        self._widths = np.zeros(num_envs)  # half widths of the steps of the walk, degC
        # The sum of steps and the walk at the latest change that has been generated, degC.
        self._last_steps = np.zeros(num_envs)
        self._last_walk = np.zeros(num_envs)
        # Values of the load at the next changes, generated ahead, degC.
        self._levels = np.zeros((num_envs, LEVELS_AT_A_TIME))
        # Indices in the flattened levels: the end of each plant's row, and the next level.
        self._ends = np.arange(1, num_envs + 1) * LEVELS_AT_A_TIME
        self._places = self._ends.copy()

    def reset(
        self, which: Indices, streams: StreamsOfPlants, numbers: PlantNumbers[Values]
    ) -> None:
        """Begin an episode of some plants.

        Parameters
        ----------
        which
            The indices of the plants.
        streams
            The random number streams of all plants. Each plant's stream `plant` must already
            have drawn the plant numbers: the load continues this stream.
        numbers
            The plant numbers of these plants, which hold size and interval of the changes.
        """
        self._streams = streams
        self._amplitudes[which] = numbers.disturbance_amplitude
        self._probabilities[which] = LOAD_INTERVAL / numbers.disturbance_interval
        # A step of the walk is uniform within +-h and so has the variance h^2 / 3.
        self._widths[which] = np.sqrt(3.0 * LOAD_INTERVAL * numbers.disturbance_walk_variance)
        self._last_steps[which] = 0.0
        self._last_walk[which] = 0.0
        self.present[which] = 0.0
        self._places[which] = self._ends[which]
        self._due[which] = self._clock + LOAD_INTERVAL
        self._earliest_due = int(self._due.min())
        # Samples, degC, that `ahead` returns before the levels that are generated next: the
        # load stays 0 until the first change.
        self._ahead = [0.0] * (LOAD_INTERVAL - 1)

    def ahead(self) -> list[float]:
        """Return the load at the next `BLOCK` samples, degC, for the only plant."""
        self._refill(ONE)
        samples = [*self._ahead, *np.repeat(self._levels[0], LOAD_INTERVAL).tolist()]
        self._ahead = samples[BLOCK:]
        return samples[:BLOCK]

    def _change(self, is_due: NDArray[np.bool_]) -> None:
        """Take the next level of the load where `is_due`, shape (num_envs,), is True."""
        is_empty = self._places == self._ends
        self._refill(np.flatnonzero(is_due & is_empty))
        next_levels = self._levels.take(self._places, mode="clip")
        np.copyto(self.present, next_levels, where=is_due)
        self._places += is_due
        self._due += LOAD_INTERVAL * is_due

    def _refill(self, which: Indices) -> None:
        """Generate the next `LEVELS_AT_A_TIME` levels of the load for the plants `which`."""
        for start in range(0, len(which), PLANTS_AT_A_TIME):
            plants = which[start : start + PLANTS_AT_A_TIME]
            draws = np.empty((len(plants), LEVELS_AT_A_TIME, 3))
            for i, row in zip(plants.tolist(), draws, strict=True):
                self._streams[i].plant.generator.random(out=row)
            self._levels[plants] = self._generate(plants, draws)
        self._places[which] = self._ends[which] - LEVELS_AT_A_TIME

    def _generate(self, plants: Indices, draws: Values) -> Values:
        """Return the next levels of the load w for some plants, degC, shape (plants, levels).

        Parameters
        ----------
        plants
            The indices of the plants.
        draws
            Random numbers, uniform from 0 to 1, shape (plants, levels, 3). The last axis holds
            the number for a step of the walk, the number that decides whether the load jumps to
            a new level, and the number for this new level.
        """
        walk_draws, jump_draws, level_draws = np.moveaxis(draws, -1, 0)
        walk_steps = (2.0 * walk_draws - 1.0) * self._widths[plants, np.newaxis]
        last_walk = self._last_walk[plants, np.newaxis]
        walk = np.hstack((last_walk, walk_steps)).cumsum(axis=1)[:, 1:]

        new_levels = (2.0 * level_draws - 1.0) * self._amplitudes[plants, np.newaxis]
        candidates = np.hstack((self._last_steps[plants, np.newaxis], new_levels))
        # The sum of steps at a change is the candidate of the latest jump up to this change.
        # The first candidate is the sum of steps before the changes that are generated now.
        jumps = jump_draws < self._probabilities[plants, np.newaxis]
        jump_indices = np.where(jumps, np.arange(1, jumps.shape[1] + 1), 0)
        latest_jumps = np.maximum.accumulate(jump_indices, axis=1)
        steps = np.take_along_axis(candidates, latest_jumps, axis=1)

        self._last_steps[plants] = steps[:, -1]
        self._last_walk[plants] = walk[:, -1]
        levels: Values = steps + walk
        return levels


class Signals(NamedTuple):
    """The external signals of some plants; None stands for a signal that is always 0."""

    setpoint: SetPoint
    noise: Noise | None
    disturbance: Disturbance | None
    measurement_noise: Noise | None

    @classmethod
    def of(cls, parameters: Parameters, num_envs: int = 1, block: int = BLOCK) -> Signals:
        """Return the signals of plants with the arguments `parameters`.

        Parameters
        ----------
        parameters
            The arguments of the environment.
        num_envs
            Number n of plants.
        block
            How many samples of noise are generated at a time.
        """
        noises: dict[str, Noise] = {}
        for name, c in colours(parameters).items():
            noises[name] = Noise(name, c, num_envs, block)
        return cls(
            setpoint=SetPoint(parameters, num_envs),
            noise=noises.get("noise"),
            disturbance=Disturbance(num_envs) if parameters.is_disturbed else None,
            measurement_noise=noises.get("measurement_noise"),
        )

    def reset(
        self, which: Indices, streams: StreamsOfPlants, numbers: PlantNumbers[Values]
    ) -> Values:
        """Begin an episode of some plants, and return y_d(0), degC, shape (len(which),).

        Noise, load disturbance and measurement noise are 0 at k = 0.

        Parameters
        ----------
        which
            The indices of the plants.
        streams
            The random number streams of all plants, by index.
        numbers
            The plant numbers of these plants: an array has the shape (len(which),), or () for a
            number that all plants share.
        """
        for signal in (self.noise, self.disturbance, self.measurement_noise):
            if signal is not None:
                signal.reset(which, streams, numbers)
        return self.setpoint.reset(which, streams)

    def ahead(self) -> list[tuple[float, ...]]:
        """Return the next `BLOCK` samples of all signals, where there is one plant only.

        A sample is a tuple of set point y_d, noise n, load w and measurement noise, degC.
        """
        columns: list[list[float]] = []
        for signal in self:
            if signal is None:
                columns.append([0.0] * BLOCK)
            else:
                columns.append(signal.ahead())
        return list(zip(*columns, strict=True))
