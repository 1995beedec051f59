"""Generate the external signals of an episode: set point, noise and load disturbance.

Every signal class has the methods `reset`, `next` and `ahead`. `reset` begins an episode of
some plants at sample k = 0. `next` returns the values of a signal at the next sample, one value
per plant. In an environment with one plant, `ahead` returns the values of a signal at the next
600 samples (`SAMPLES_AT_A_TIME`), which is faster than 600 calls of `next`.

Noise and load disturbance draw many random numbers at a time, because one call of a random
number generator is much faster than many calls and returns the same random numbers. A random
set point, which changes rarely, draws random numbers for one level at a time.

Formulas use the symbols of the paper: set point y_d(k), temperature y(k), and coloured noise
n(k) = C(z^-1) xi(k) with white noise xi. The load disturbance w(k) is not in the paper.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mptc_gym.plant.parameters import Parameters, PlantNumbers
from mptc_gym.plant.sampling import EpisodeStream, RandomStreams

# One element per plant, shape (n,); a value that all plants share has the shape ().
Values = NDArray[np.float64]
Indices = NDArray[np.intp]  # the indices of some plants, in ascending order
StreamsOfPlants = Mapping[int, RandomStreams] | Sequence[RandomStreams]  # by index of the plant

SAMPLES_AT_A_TIME = 600  # samples of a signal that are generated together
PLANTS_AT_A_TIME = 32  # so few that the random numbers stay in the cache of the CPU
# Samples between two changes of the load disturbance, which is slow. The same samples change a
# drifting plant (`dynamics.DRIFT_INTERVAL`).
LOAD_INTERVAL = 10
LOADS_AT_A_TIME = SAMPLES_AT_A_TIME // LOAD_INTERVAL  # load values generated together
# Number of samples that no episode reaches, small enough to be added to another int64.
UNLIMITED = 1 << 62
ONLY_PLANT = np.zeros(1, np.intp)  # indices of the plants of an environment with one plant


def noise_polynomials(parameters: Parameters) -> dict[str, Sequence[float]]:
    """Return the coefficients of the polynomial that colours each noise, by the noise's name.

    The entry "noise" holds the coefficients of the polynomial C of equation (28) of the paper,
    from z^0 on. The entry "measurement_noise" holds one coefficient, 1, because the noise of
    the transmitter is white. The returned dict has no entry for a noise whose variance is
    always 0.
    """
    polynomials: dict[str, Sequence[float]] = {}
    if parameters.range_of("noise_variance")[1] > 0.0:
        polynomials["noise"] = parameters.c
    if parameters.range_of("measurement_noise_variance")[1] > 0.0:
        polynomials["measurement_noise"] = (1.0,)
    return polynomials


class Noise:
    """The noise of n plants or of their transmitters, degC, which is 0 at sample k = 0.

    Parameters
    ----------
    name
        Name of the noise: "noise" for the coloured noise n(k) = C(z^-1) xi(k) of equation (28)
        of the paper, with white noise xi; or "measurement_noise" for the noise of the
        transmitter.
    c
        Coefficients of the polynomial that colours the white noise xi, from z^0 on.
    num_envs
        Number n of plants.
    block
        Number of samples of noise that are generated at a time.
    """

    def __init__(self, name: str, c: Sequence[float], num_envs: int, block: int) -> None:
        self._name = name
        self._c = np.array(c)[:, np.newaxis, np.newaxis]  # two axes for plants and samples
        # Coefficients of C times the standard deviation of the white noise xi, degC, shape
        # (number of coefficients, num_envs, 1).
        self._scaled_c = np.zeros((len(c), num_envs, 1))
        # The latest values of the white noise xi of each plant, the oldest first, divided by
        # the standard deviation of xi.
        self._past_xi = np.zeros((num_envs, len(c) - 1))
        # A block of successive samples of noise, degC: one row per sample, so that the values
        # for one sample of all plants are contiguous in memory.
        self._block = np.zeros((block, num_envs))
        self._next_row = 0

    def reset(
        self, plants: Indices, streams: StreamsOfPlants, numbers: PlantNumbers[Values]
    ) -> None:
        """Begin an episode of the plants with the indices `plants`."""
        deviations = np.sqrt(getattr(numbers, f"{self._name}_variance"))
        self._scaled_c[:, plants] = deviations[..., np.newaxis] * self._c
        self._past_xi[plants] = 0.0
        self._streams = streams
        for i in plants.tolist():
            getattr(streams[i], self._name).next_episode()
        if len(plants) == len(self._past_xi):
            self._next_row = len(self._block)  # `next` then generates a block for all plants
        else:  # the plants begin in the rest of the other plants' block
            self._fill(plants, self._next_row)

    def next(self) -> Values:
        """Return the noise of all plants at the next sample, degC, shape (num_envs,).

        The caller must not modify the returned array.
        """
        if self._next_row == len(self._block):
            self._fill(np.arange(len(self._past_xi)), 0)
            self._next_row = 0
        noise: Values = self._block[self._next_row]
        self._next_row += 1
        return noise

    def ahead(self) -> list[float]:
        """Return the noise of a single plant at the samples of a new block, degC, in a list."""
        self._fill(ONLY_PLANT, 0)
        noise: list[float] = self._block[:, 0].tolist()
        return noise

    def _fill(self, plants: Indices, first_row: int) -> None:
        """Fill the rows of the noise block from `first_row` on, for the plants `plants`."""
        order = len(self._c) - 1
        samples = len(self._block) - first_row
        for start in range(0, len(plants), PLANTS_AT_A_TIME):
            chunk = plants[start : start + PLANTS_AT_A_TIME]
            xi = np.empty((len(chunk), order + samples))
            xi[:, :order] = self._past_xi[chunk]
            for i, new_xi in zip(chunk.tolist(), xi[:, order:], strict=True):
                getattr(self._streams[i], self._name).generator.standard_normal(out=new_xi)
            self._past_xi[chunk] = xi[:, samples:]
            # A slice is much faster than indices, but needs plants without gaps.
            has_gaps = chunk[-1] - chunk[0] >= len(chunk)
            columns = chunk if has_gaps else slice(chunk[0], chunk[-1] + 1)
            c = self._scaled_c[:, columns]
            noise = c[0] * xi[:, order:]
            for lag, coefficient in enumerate(c[1:], start=1):
                noise += coefficient * xi[:, order - lag : -lag]
            self._block[first_row:, columns] = noise.T


class SetPointLevels:
    """The levels of the set point, degC, and the durations of these levels in samples.

    Parameters
    ----------
    parameters
        The arguments of the environment.

    Attributes
    ----------
    random : bool
        Whether the levels of the set point and their durations are random.
    amplitude : float
        Magnitude of the levels of a square set point, or largest magnitude of a random level
        of the set point, degC.
    shortest, longest : int
        Shortest and longest duration of a random level of the set point, samples.
    values, lengths : list
        Levels of the set point, degC, and durations of these levels, samples. After the last
        level of the set point, the first level follows again. The lists of levels and durations
        are empty if the levels of the set point are random.
    """

    def __init__(self, parameters: Parameters) -> None:
        setpoint = parameters.setpoint
        period = parameters.setpoint_period
        self.random = setpoint == "random"
        self.amplitude = parameters.setpoint_amplitude
        # From a sixth to a half of the period, as the argument `setpoint_period` says; samples.
        self.shortest = max(1, math.ceil(period / 6))
        self.longest = max(self.shortest, period // 2)
        self.values: list[float] = []
        self.lengths: list[int] = []
        if setpoint == "square":
            self.values = [self.amplitude]
            self.lengths = [(period + 1) // 2]
            if period > 1:  # a period of one sample has no second half
                self.values.append(-self.amplitude)
                self.lengths.append(period // 2)
        elif isinstance(setpoint, float):  # a constant
            self.values = [setpoint]
            self.lengths = [UNLIMITED]
        elif not isinstance(setpoint, str):  # a number for each sample, the last one held
            self.values = list(setpoint)
            self.lengths = [1] * (len(self.values) - 1) + [UNLIMITED]

    def sample(self, stream: EpisodeStream) -> tuple[float, int]:
        """Return a random level, degC, and a random duration of this level, samples."""
        level = stream.generator.uniform(-self.amplitude, self.amplitude)
        length = stream.generator.integers(self.shortest, self.longest, endpoint=True)
        return level, int(length)


class _HeldSignal(ABC):
    """A signal of n plants whose values are constant between the times of changes.

    The times at which the signal changes are counted in samples since the plants were created.

    Attributes
    ----------
    present : ndarray of float64
        Value of the signal of each plant, degC, shape (num_envs,), at the latest sample for
        which `reset` or `next` returned the signal. After a call of `ahead`, `present` has no
        meaning for other objects. Other objects must not modify the array `present`.
    """

    def __init__(self, num_envs: int) -> None:
        self.present = np.zeros(num_envs)
        self._clock = 0  # the present time
        self._change_times = np.zeros(num_envs, np.int64)  # of the next change of each plant
        self._next_change_time = 0  # the earliest of these times

    def next(self) -> Values:
        """Return the signal of all plants at the next sample, degC, shape (num_envs,).

        The caller must not modify the returned array.
        """
        self._clock += 1
        if self._clock >= self._next_change_time:
            self._make_changes()
        return self.present

    def _make_changes(self) -> None:
        """Change the signal of each plant whose next change is at the present time."""
        self._change(np.flatnonzero(self._change_times <= self._clock))
        self._next_change_time = int(self._change_times.min())

    @abstractmethod
    def _change(self, plants: Indices) -> None:
        """Change the signal of the plants `plants`, and move on the times of their changes."""


class SetPoint(_HeldSignal):
    """The set point y_d(k) of n plants, in degC.

    Parameters
    ----------
    parameters
        The arguments of the environment.
    num_envs
        Number n of plants.
    """

    def __init__(self, parameters: Parameters, num_envs: int) -> None:
        super().__init__(num_envs)
        self._levels = SetPointLevels(parameters)
        self._level_values = np.array(self._levels.values)
        self._level_lengths = np.array(self._levels.lengths)
        # Index of each plant's next level in `_level_values` and in `_level_lengths`; unused if
        # levels are random.
        self._places = np.zeros(num_envs, np.intp)

    def reset(self, plants: Indices, streams: StreamsOfPlants) -> Values:
        """Begin an episode of the plants `plants`, and return the set points y_d(0), degC."""
        self._streams = streams
        if self._levels.random:
            for i in plants.tolist():
                streams[i].setpoint.next_episode()
        # The first level of the episode begins at the present sample.
        self._places[plants] = 0
        self._change_times[plants] = self._clock
        self._make_changes()
        return self.present[plants]

    def ahead(self) -> list[float]:
        """Return the set points of a single plant at the next 600 samples, degC, in a list."""
        level = self.present.item()
        place = self._places.item()
        # The number of coming samples whose level is known: until the level's next change.
        known = self._change_times.item() - self._clock - 1
        setpoints = [level] * min(known, SAMPLES_AT_A_TIME)
        while known < SAMPLES_AT_A_TIME:
            if self._levels.random:
                level, length = self._levels.sample(self._streams[0].setpoint)
            else:
                level = self._levels.values[place]
                length = self._levels.lengths[place]
                place = (place + 1) % len(self._levels.values)
            setpoints += [level] * min(length, SAMPLES_AT_A_TIME - known)
            known += length
        self.present[0] = level
        self._places[0] = place
        self._change_times[0] = self._clock + 1 + known
        self._clock += SAMPLES_AT_A_TIME
        return setpoints

    def _change(self, plants: Indices) -> None:
        """Begin the next level of the set point of the plants with the indices `plants`."""
        if self._levels.random:
            for i in plants.tolist():
                self.present[i], length = self._levels.sample(self._streams[i].setpoint)
                self._change_times[i] += length
        else:
            places = self._places[plants]
            self.present[plants] = self._level_values[places]
            self._change_times[plants] += self._level_lengths[places]
            self._places[plants] = (places + 1) % len(self._level_values)


class Disturbance(_HeldSignal):
    """The load disturbance w(k), degC: a level that jumps, plus a random walk.

    The load changes every 10 samples (`LOAD_INTERVAL`). At the start of an episode, the level
    and the random walk of the load are 0. At each change of the load, the level jumps with the
    probability 10 / `disturbance_interval` to a new level that is uniform within
    +-`disturbance_amplitude`. At each change of the load, the random walk takes a step with a
    uniform distribution; the sum of many steps is approximately normal.

    Parameters
    ----------
    num_envs
        Number n of plants.
    """

    def __init__(self, num_envs: int) -> None:
        super().__init__(num_envs)
        self._amplitudes = np.zeros(num_envs)  # largest magnitude of a new level, degC
        self._jump_probabilities = np.zeros(num_envs)  # of a jump of the level
        self._largest_walk_steps = np.zeros(num_envs)  # largest step of the random walk, degC
        # Level and random walk of the load, degC, at the last of the changes of load that have
        # been generated.
        self._last_levels = np.zeros(num_envs)
        self._last_walks = np.zeros(num_envs)
        # The load after each of the next changes of each plant, generated ahead, degC.
        self._loads = np.zeros((num_envs, LOADS_AT_A_TIME))
        self._next_columns = np.zeros(num_envs, np.intp)  # columns of the next loads

    def reset(
        self, plants: Indices, streams: StreamsOfPlants, numbers: PlantNumbers[Values]
    ) -> None:
        """Begin an episode of the plants with the indices `plants`, with a load of 0.

        Before this call, the parameter values of the plants must have been sampled: parameter
        values and load use the same random number stream, in this order.
        """
        self._streams = streams
        self._amplitudes[plants] = numbers.disturbance_amplitude
        self._jump_probabilities[plants] = LOAD_INTERVAL / numbers.disturbance_interval
        # A step of the walk that is uniform within +-h has the variance h^2 / 3.
        squared_steps = 3.0 * LOAD_INTERVAL * numbers.disturbance_walk_variance
        self._largest_walk_steps[plants] = np.sqrt(squared_steps)
        self._last_levels[plants] = 0.0
        self._last_walks[plants] = 0.0
        self._next_columns[plants] = LOADS_AT_A_TIME  # no load has been generated yet
        self.present[plants] = 0.0
        self._change_times[plants] = self._clock + LOAD_INTERVAL
        self._next_change_time = int(self._change_times.min())
        # Loads of a single plant at coming samples, which the next call of `ahead` returns
        # first: 0 at the samples before the first change.
        self._known_loads = [0.0] * (LOAD_INTERVAL - 1)

    def ahead(self) -> list[float]:
        """Return the load of a single plant at the next 600 samples, degC, in a list."""
        self._generate(ONLY_PLANT)
        # 600 further loads, of which the last 9 remain for the next call.
        new_loads: list[float] = np.repeat(self._loads[0], LOAD_INTERVAL).tolist()
        loads = self._known_loads + new_loads
        self._known_loads = loads[SAMPLES_AT_A_TIME:]
        return loads[:SAMPLES_AT_A_TIME]

    def _change(self, plants: Indices) -> None:
        """Set the load of the plants with the indices `plants` to the next value."""
        needs_loads = self._next_columns[plants] == LOADS_AT_A_TIME
        self._generate(plants[needs_loads])
        columns = self._next_columns[plants]  # 0 where loads were generated
        self.present[plants] = self._loads[plants, columns]
        self._next_columns[plants] = columns + 1
        self._change_times[plants] += LOAD_INTERVAL

    def _generate(self, plants: Indices) -> None:
        """Generate the next 60 values of the load of the plants with the indices `plants`."""
        for start in range(0, len(plants), PLANTS_AT_A_TIME):
            chunk = plants[start : start + PLANTS_AT_A_TIME]
            # For each load, three random numbers from 0 to 1: one for the step of the walk, one
            # that decides whether the level jumps, and one for the new level.
            uniform = np.empty((len(chunk), LOADS_AT_A_TIME, 3))
            for i, uniform_of_plant in zip(chunk.tolist(), uniform, strict=True):
                self._streams[i].plant.generator.random(out=uniform_of_plant)
            walks = self._continue_walks(chunk, uniform[..., 0])
            levels = self._continue_levels(chunk, uniform[..., 1], uniform[..., 2])
            self._loads[chunk] = levels + walks
        self._next_columns[plants] = 0

    def _continue_walks(self, plants: Indices, uniform: Values) -> Values:
        """Return the random walks of some plants at the next changes of the load, degC.

        `uniform` holds random numbers from 0 to 1, one for each step of a random walk.
        `uniform` and the returned walks have the shape (len(plants), number of changes of the
        load).
        """
        steps = (2.0 * uniform - 1.0) * self._largest_walk_steps[plants, np.newaxis]
        last_walks = self._last_walks[plants, np.newaxis]
        walks: Values = np.hstack((last_walks, steps)).cumsum(axis=1)[:, 1:]
        self._last_walks[plants] = walks[:, -1]
        return walks

    def _continue_levels(
        self, plants: Indices, jump_uniform: Values, level_uniform: Values
    ) -> Values:
        """Return the load levels of some plants at the next changes of the load, degC.

        `jump_uniform` holds random numbers from 0 to 1 that decide whether the level jumps, and
        `level_uniform` random numbers from 0 to 1 that decide the new level. `jump_uniform`,
        `level_uniform` and the returned levels have the shape (len(plants), number of changes
        of the load).
        """
        jumps = jump_uniform < self._jump_probabilities[plants, np.newaxis]
        new_levels = (2.0 * level_uniform - 1.0) * self._amplitudes[plants, np.newaxis]
        # The level at a change is the level of the latest jump up to this change. Column 0 of
        # `candidates` is the last known level, which holds until the first jump.
        candidates = np.hstack((self._last_levels[plants, np.newaxis], new_levels))
        columns_of_jumps = np.where(jumps, np.arange(1, jumps.shape[1] + 1), 0)
        columns_of_latest_jumps = np.maximum.accumulate(columns_of_jumps, axis=1)
        levels = np.take_along_axis(candidates, columns_of_latest_jumps, axis=1)
        self._last_levels[plants] = levels[:, -1]
        return levels


class Signals(NamedTuple):
    """The external signals of n plants; a noise or load that is always 0 is None."""

    setpoint: SetPoint
    noise: Noise | None
    disturbance: Disturbance | None
    measurement_noise: Noise | None

    @classmethod
    def of(
        cls, parameters: Parameters, num_envs: int = 1, block: int = SAMPLES_AT_A_TIME
    ) -> Signals:
        """Return the signals of `num_envs` plants with the arguments `parameters`.

        `block` is the number of samples of noise that are generated at a time.
        """
        noises: dict[str, Noise] = {}
        for name, c in noise_polynomials(parameters).items():
            noises[name] = Noise(name, c, num_envs, block)
        return cls(
            setpoint=SetPoint(parameters, num_envs),
            noise=noises.get("noise"),
            disturbance=Disturbance(num_envs) if parameters.is_disturbed else None,
            measurement_noise=noises.get("measurement_noise"),
        )

    def reset(
        self, plants: Indices, streams: StreamsOfPlants, numbers: PlantNumbers[Values]
    ) -> Values:
        """Begin an episode of some plants, and return the set points y_d(0), degC.

        The returned set points have the shape (len(plants),). Noise, load disturbance and
        measurement noise are 0 at sample k = 0.

        Parameters
        ----------
        plants
            Indices of the plants that begin an episode.
        streams
            Random number streams of all plants, by index of the plant.
        numbers
            Parameter values of the plants that begin an episode: arrays of shape
            (len(plants),), or of shape () for a value that all plants share.
        """
        for signal in (self.noise, self.disturbance, self.measurement_noise):
            if signal is not None:
                signal.reset(plants, streams, numbers)
        return self.setpoint.reset(plants, streams)

    def ahead(self) -> list[tuple[float, ...]]:
        """Return all signals of a single plant at the next 600 samples, one tuple per sample.

        Each tuple holds set point y_d, noise n, load w and measurement noise at a sample, in
        degC. `ahead` needs signals that were made with the default `block` of 600 samples.
        """
        columns: list[list[float]] = []
        for signal in self:
            if signal is None:
                columns.append([0.0] * SAMPLES_AT_A_TIME)
            else:
                columns.append(signal.ahead())
        return list(zip(*columns, strict=True))
