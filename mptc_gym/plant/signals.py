"""Generate the external signals of an episode: set point, noise and load disturbance.

Every signal class has the methods `reset`, `next` and `ahead`. `reset` begins an episode of
some plants at sample k = 0. `next` returns the values of a signal at the next sample, one value
per plant. In an environment with one plant, `ahead` returns the values of a signal at the next
600 samples (`SAMPLES_AT_A_TIME`), which is faster than 600 calls of `next`.

Every random signal is generated for a block of successive samples at a time, in the same way
for one plant and for many: one call of a random number generator is much faster than many calls
and returns the same random numbers. A block that goes on after the end of an episode does no
harm, as every episode has random numbers of its own (`EpisodeStream`). A set point that repeats
needs no block.

Formulas use the symbols of the paper: set point y_d(k), temperature y(k), and coloured noise
n(k) = C(z^-1) xi(k) with white noise xi. The load disturbance w(k) is not in the paper.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mptc_gym.plant.parameters import Parameters, PlantNumbers
from mptc_gym.plant.sampling import EpisodeStream, RandomStreams

# One element per plant, shape (n,); a value that all plants share has the shape ().
Values = NDArray[np.float64]
Indices = NDArray[np.intp]  # the indices of some plants, in ascending order

SAMPLES_AT_A_TIME = 600  # most samples of a signal that are generated together
BLOCK_BYTES = 1 << 28  # most bytes for the blocks of all signals: 256 MiB
PLANTS_AT_A_TIME = 32  # so few that the random numbers stay in the cache of the CPU
# Samples between two changes of the load disturbance, which is slow. The same samples change a
# drifting plant (`dynamics.DRIFT_INTERVAL`).
LOAD_INTERVAL = 10
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
    if parameters.range_of("noise_variance")[1] > 0.0:  # the highest variance
        polynomials["noise"] = parameters.c
    if parameters.range_of("measurement_noise_variance")[1] > 0.0:
        polynomials["measurement_noise"] = (1.0,)
    return polynomials


class RandomSignal(ABC):
    """A random signal of n plants, which is generated for a block of samples at a time.

    Parameters
    ----------
    num_envs
        Number n of plants.
    samples
        Number of samples in a block.
    """

    def __init__(self, num_envs: int, samples: int) -> None:
        # A block of successive samples, degC, shape (samples, num_envs): one row per sample, so
        # that the values for one sample of all plants are contiguous in memory.
        self._block = np.zeros((samples, num_envs))
        self._next_row = 0  # which `next` returns
        self._streams: dict[int, EpisodeStream] = {}  # by index of the plant

    def next(self) -> Values:
        """Return the signal of all plants at the next sample, degC, shape (num_envs,).

        The caller must not modify the returned array.
        """
        if self._next_row == len(self._block):
            self._fill(np.arange(self._block.shape[1]), 0)  # the whole block, of all plants
            self._next_row = 0
        values: Values = self._block[self._next_row]
        self._next_row += 1
        return values

    def ahead(self) -> list[float]:
        """Return the signal of a single plant at the samples of a block, degC, in a list."""
        generators = [self._streams[0].generator]  # of the only plant, with the index 0
        block = self._generate(ONLY_PLANT, generators, len(self._block))
        values: list[float] = block[0].tolist()  # the row of the only plant
        return values

    def _begin(self, plants: Indices, streams: Sequence[EpisodeStream]) -> None:
        """Begin an episode of the plants `plants`, which have the streams `streams`."""
        self._streams.update(zip(plants.tolist(), streams, strict=True))
        samples, num_envs = self._block.shape
        if len(plants) == num_envs:
            self._next_row = samples  # `next` then generates a block for all plants
        else:  # the plants begin in the rest of the other plants' block
            self._fill(plants, self._next_row)

    def _fill(self, plants: Indices, first_row: int) -> None:
        """Fill the rows of the block from `first_row` on, for the plants `plants`."""
        samples = len(self._block) - first_row
        for start in range(0, len(plants), PLANTS_AT_A_TIME):
            chunk = plants[start : start + PLANTS_AT_A_TIME]
            # Every plant has begun an episode, as the first reset includes all plants.
            generators = [self._streams[i].generator for i in chunk.tolist()]
            # A slice is much faster than indices, but needs plants without gaps.
            has_gaps = chunk[-1] - chunk[0] >= len(chunk)
            columns = chunk if has_gaps else slice(chunk[0], chunk[-1] + 1)
            # `_generate` returns a row per plant, and `_block` has a row per sample.
            self._block[first_row:, columns] = self._generate(chunk, generators, samples).T

    @abstractmethod
    def _generate(
        self, plants: Indices, generators: Sequence[np.random.Generator], samples: int
    ) -> Values:
        """Return the next `samples` samples of some plants, degC, shape (len(plants), samples).

        `generators` holds the random number generator of each plant in `plants`. The next call
        of `_generate` for a plant continues where this call ends.
        """


class Noise(RandomSignal):
    """The noise of n plants or of their transmitters, degC, which is 0 at sample k = 0.

    Parameters
    ----------
    c
        Coefficients of the polynomial that colours the white noise xi, from z^0 on.
    num_envs
        Number n of plants.
    samples
        Number of samples in a block.
    """

    def __init__(self, c: Sequence[float], num_envs: int, samples: int) -> None:
        super().__init__(num_envs, samples)
        self._c = np.array(c)[:, np.newaxis, np.newaxis]  # two axes for plants and samples
        # Coefficients of C times the standard deviation of the white noise xi, degC, shape
        # (number of coefficients, num_envs, 1).
        self._scaled_c = np.zeros((len(c), num_envs, 1))
        # The latest values of the white noise xi of each plant, the oldest first, divided by
        # the standard deviation of xi.
        self._past_xi = np.zeros((num_envs, len(c) - 1))

    def reset(
        self, plants: Indices, streams: Sequence[EpisodeStream], variances: Values
    ) -> None:
        """Begin an episode of the plants with the indices `plants`.

        `variances` are those of the white noise xi, degC^2, shape (len(plants),), or shape ()
        for one variance of all plants.
        """
        deviations = np.sqrt(variances)
        self._scaled_c[:, plants] = deviations[..., np.newaxis] * self._c
        self._past_xi[plants] = 0.0
        for stream in streams:
            stream.next_episode()  # moves the stream's generator to the new episode
        self._begin(plants, streams)

    def _generate(
        self, plants: Indices, generators: Sequence[np.random.Generator], samples: int
    ) -> Values:
        """Return the noise of the next samples, degC, shape (len(plants), samples)."""
        order = len(self._c) - 1  # number of earlier values of xi that a sample needs
        xi = np.empty((len(plants), order + samples))
        xi[:, :order] = self._past_xi[plants]
        for generator, new_xi in zip(generators, xi[:, order:], strict=True):
            generator.standard_normal(out=new_xi)
        self._past_xi[plants] = xi[:, samples:]  # the last `order` values
        c = self._scaled_c[:, plants]  # times the values of xi, which have the variance 1
        noise: Values = c[0] * xi[:, order:]
        for lag, coefficient in enumerate(c[1:], start=1):
            noise += coefficient * xi[:, order - lag : -lag]  # `lag` samples earlier
        return noise


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

    def sample(self, generator: np.random.Generator) -> tuple[float, int]:
        """Return a random level, degC, and a random duration of this level, samples."""
        level = generator.uniform(-self.amplitude, self.amplitude)
        length = generator.integers(self.shortest, self.longest, endpoint=True)
        return level, int(length)


class RepeatedSetPoint:
    """The set point y_d(k) of n plants, degC, if its levels are the same in every episode.

    Parameters
    ----------
    levels
        Levels of the set point and their durations, which are not random.
    num_envs
        Number n of plants.
    """

    def __init__(self, levels: SetPointLevels, num_envs: int) -> None:
        self._sequence = levels
        self._levels = np.array(levels.values)
        self._ends = np.cumsum(levels.lengths)  # samples of a period at which the levels end
        # Times in samples since the plants were created: the present time, the starts of the
        # episodes, and the time at which the set point of any plant changes next.
        self._clock = 0
        self._starts = np.zeros(num_envs, np.int64)
        self._next_change = 0
        self._present = np.zeros(num_envs)

    def reset(self, plants: Indices) -> Values:
        """Begin an episode of the plants `plants`, and return the set points y_d(0), degC."""
        self._starts[plants] = self._clock
        self._next_change = 0  # a time that has passed, so that `next` looks up the levels
        return np.full(len(plants), self._levels[0])  # every episode begins with this level

    def next(self) -> Values:
        """Return the set points of all plants at the next sample, degC, shape (num_envs,).

        The caller must not modify the returned array.
        """
        self._clock += 1
        if self._clock >= self._next_change:  # also right after a reset
            self._present, unchanged_samples = self._at(self._clock - self._starts)
            self._next_change = self._clock + unchanged_samples
        return self._present

    def ahead(self) -> list[float]:
        """Return the set points of a single plant at the next 600 samples, degC, in a list."""
        # Level by level in Python, which is faster than `_at` for each sample.
        values = self._sequence.values
        lengths = self._sequence.lengths
        k_in_period = (self._clock + 1 - self._starts.item()) % self._ends[-1].item()
        place = int(np.searchsorted(self._ends, k_in_period, side="right"))
        samples_left = self._ends[place].item() - k_in_period
        setpoints: list[float] = []
        while len(setpoints) < SAMPLES_AT_A_TIME:
            missing = SAMPLES_AT_A_TIME - len(setpoints)
            setpoints += [values[place]] * min(samples_left, missing)
            place = (place + 1) % len(values)
            samples_left = lengths[place]
        self._clock += SAMPLES_AT_A_TIME
        return setpoints

    def _at(self, k: NDArray[np.int64]) -> tuple[Values, int]:
        """Return the set points at the samples k, and for how many samples all of them stay."""
        k_in_period = k % self._ends[-1]  # after the last level, the first follows again
        # The index of the level is the number of ends that a sample has reached.
        indices = np.searchsorted(self._ends, k_in_period, side="right")
        samples_left = self._ends[indices] - k_in_period
        return self._levels[indices], int(samples_left.min())


class RandomSetPoint(RandomSignal):
    """The set point y_d(k) of n plants, degC: random levels, each for a random time.

    Parameters
    ----------
    levels
        The distribution of levels and durations.
    num_envs
        Number n of plants.
    samples
        Number of samples in a block.
    """

    def __init__(self, levels: SetPointLevels, num_envs: int, samples: int) -> None:
        super().__init__(num_envs, samples)
        self._distribution = levels
        # The latest level of each plant, degC, and the number of samples after the latest
        # generated sample at which the level still holds. Lists, as single elements are used.
        self._levels = [0.0] * num_envs
        self._samples_left = [0] * num_envs

    def reset(self, plants: Indices, streams: Sequence[EpisodeStream]) -> Values:
        """Begin an episode of the plants `plants`, and return the set points y_d(0), degC."""
        setpoints = np.empty(len(plants))
        for place, (i, stream) in enumerate(zip(plants.tolist(), streams, strict=True)):
            setpoints[place], length = self._distribution.sample(stream.next_episode())
            self._levels[i] = setpoints[place].item()
            self._samples_left[i] = length - 1  # without the sample k = 0
        self._begin(plants, streams)
        return setpoints

    def _generate(
        self, plants: Indices, generators: Sequence[np.random.Generator], samples: int
    ) -> Values:
        """Return the set points of the next samples, degC, shape (len(plants), samples)."""
        # The levels of one plant after the other, degC, and their durations, samples.
        levels: list[float] = []
        lengths: list[int] = []
        for i, generator in zip(plants.tolist(), generators, strict=True):
            known = self._samples_left[i]  # number of coming samples whose levels are known
            levels.append(self._levels[i])
            lengths.append(known)
            while known < samples:
                # Drawn singly, as arrays of levels and of durations have other random numbers.
                level, length = self._distribution.sample(generator)
                levels.append(level)
                lengths.append(length)
                known += length
            self._levels[i] = levels[-1]
            self._samples_left[i] = known - samples
            lengths[-1] -= known - samples  # The last level goes on after these samples.
        # The durations of each plant's levels sum to `samples`.
        return np.repeat(levels, lengths).reshape(len(plants), samples)


class Disturbance(RandomSignal):
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
    samples
        Number of samples in a block.
    """

    def __init__(self, num_envs: int, samples: int) -> None:
        super().__init__(num_envs, samples)
        self._amplitudes = np.zeros(num_envs)  # largest magnitude of a new level, degC
        self._jump_probabilities = np.zeros(num_envs)  # of a jump of the level
        self._largest_walk_steps = np.zeros(num_envs)  # largest step of the random walk, degC
        # Level and random walk of the load at the latest generated sample, degC, and the number
        # of samples since the load has changed.
        self._last_levels = np.zeros(num_envs)
        self._last_walks = np.zeros(num_envs)
        self._ages = np.zeros(num_envs, np.intp)

    def reset(
        self, plants: Indices, streams: Sequence[EpisodeStream], numbers: PlantNumbers[Values]
    ) -> None:
        """Begin an episode of the plants with the indices `plants`, with a load of 0.

        Before this call, the parameter values `numbers` of these plants must have been sampled,
        which moves `streams` to the episode: parameter values and load use the same random
        number stream, in this order.
        """
        self._amplitudes[plants] = numbers.disturbance_amplitude
        self._jump_probabilities[plants] = LOAD_INTERVAL / numbers.disturbance_interval
        # A step of the walk that is uniform within +-h has the variance h^2 / 3.
        squared_steps = 3.0 * LOAD_INTERVAL * numbers.disturbance_walk_variance
        self._largest_walk_steps[plants] = np.sqrt(squared_steps)
        self._last_levels[plants] = 0.0
        self._last_walks[plants] = 0.0
        self._ages[plants] = 0
        self._begin(plants, streams)

    def _generate(
        self, plants: Indices, generators: Sequence[np.random.Generator], samples: int
    ) -> Values:
        """Return the loads of the next samples, degC, shape (len(plants), samples)."""
        ages = self._ages[plants]  # samples since the latest change
        changes = (ages + samples) // LOAD_INTERVAL  # of the load of each plant
        self._ages[plants] = (ages + samples) % LOAD_INTERVAL
        # For each change, three random numbers from 0 to 1: one for the step of the walk, one
        # that decides whether the level jumps, and one for the new level. A plant may have one
        # change less than another. Its last column stays 0, and is not read below.
        uniform = np.zeros((len(plants), changes.max(), 3))
        draws = zip(generators, uniform, changes.tolist(), strict=True)
        for generator, uniform_of_plant, count in draws:
            generator.random(out=uniform_of_plant[:count])
        walks = self._walks(plants, uniform[..., 0])
        levels = self._levels(plants, uniform[..., 1], uniform[..., 2])
        # Column 0 is before the first of these changes, so column `changes` is after the last.
        rows = np.arange(len(plants))
        self._last_walks[plants] = walks[rows, changes]
        self._last_levels[plants] = levels[rows, changes]
        # The loads from the latest change on. It was `age` samples before the latest sample of
        # the plant, so column `age` is that sample, and the next column the first new sample.
        held = np.repeat(levels + walks, LOAD_INTERVAL, axis=1)
        loads = np.empty((len(plants), samples))
        for load, held_load, age in zip(loads, held, ages.tolist(), strict=True):
            load[:] = held_load[age + 1 : age + 1 + samples]
        return loads

    def _walks(self, plants: Indices, uniform: Values) -> Values:
        """Return the random walks of some plants, degC: the last ones, and after each change.

        `uniform` holds random numbers from 0 to 1, one for each step of a random walk, shape
        (len(plants), number of changes of the load). The returned walks have one column more.
        """
        steps = np.empty((len(plants), uniform.shape[1] + 1))
        steps[:, 0] = self._last_walks[plants]
        steps[:, 1:] = (2.0 * uniform - 1.0) * self._largest_walk_steps[plants, np.newaxis]
        walks: Values = steps.cumsum(axis=1)
        return walks

    def _levels(self, plants: Indices, jump_uniform: Values, level_uniform: Values) -> Values:
        """Return the load levels of some plants, degC: the last ones, and after each change.

        `jump_uniform` holds random numbers from 0 to 1 that decide whether the level jumps, and
        `level_uniform` random numbers from 0 to 1 that decide the new level, both of shape
        (len(plants), number of changes of the load). The returned levels have one column more.
        """
        # The level at a change is the level of the latest jump up to this change. Column 0 of
        # `candidates` is the last known level, which holds until the first jump.
        candidates = np.empty((len(plants), jump_uniform.shape[1] + 1))
        candidates[:, 0] = self._last_levels[plants]
        candidates[:, 1:] = (2.0 * level_uniform - 1.0) * self._amplitudes[plants, np.newaxis]
        jumps = jump_uniform < self._jump_probabilities[plants, np.newaxis]
        columns_of_jumps = np.zeros(candidates.shape, np.intp)
        columns_of_jumps[:, 1:] = jumps * np.arange(1, candidates.shape[1])
        columns_of_latest_jumps = np.maximum.accumulate(columns_of_jumps, axis=1)
        rows = np.arange(len(plants))[:, np.newaxis]
        levels: Values = candidates[rows, columns_of_latest_jumps]
        return levels


class Signals(NamedTuple):
    """The external signals of n plants; a noise or load that is always 0 is None."""

    setpoint: RepeatedSetPoint | RandomSetPoint
    noise: Noise | None
    disturbance: Disturbance | None
    measurement_noise: Noise | None

    @classmethod
    def of(
        cls, parameters: Parameters, num_envs: int = 1, episode_length: int = UNLIMITED
    ) -> Signals:
        """Return the signals of `num_envs` plants with the arguments `parameters`.

        `episode_length` is the number of samples after which an episode is truncated.
        """
        levels = SetPointLevels(parameters)
        polynomials = noise_polynomials(parameters)
        # Number of random signals; a set point that is not random has no block.
        blocks = levels.random + parameters.is_disturbed + len(polynomials)
        samples = _block_samples(blocks * num_envs, episode_length)
        setpoint: RepeatedSetPoint | RandomSetPoint = RepeatedSetPoint(levels, num_envs)
        if levels.random:
            setpoint = RandomSetPoint(levels, num_envs, samples)
        noises = {name: Noise(c, num_envs, samples) for name, c in polynomials.items()}
        return cls(
            setpoint=setpoint,
            noise=noises.get("noise"),
            disturbance=Disturbance(num_envs, samples) if parameters.is_disturbed else None,
            measurement_noise=noises.get("measurement_noise"),
        )

    def reset(
        self,
        plants: Indices,
        streams: Sequence[RandomStreams],
        numbers: PlantNumbers[Values],
    ) -> Values:
        """Begin an episode of some plants, and return the set points y_d(0), degC.

        The returned set points have the shape (len(plants),). Noise, load disturbance and
        measurement noise are 0 at sample k = 0.

        Parameters
        ----------
        plants
            Indices of the plants that begin an episode.
        streams
            Random number streams of these plants.
        numbers
            Parameter values of these plants: arrays of shape (len(plants),), or of shape () for
            a value that all plants share.
        """
        if self.noise is not None:
            self.noise.reset(plants, [s.noise for s in streams], numbers.noise_variance)
        if self.disturbance is not None:
            self.disturbance.reset(plants, [s.plant for s in streams], numbers)
        if self.measurement_noise is not None:
            variances = numbers.measurement_noise_variance
            noise_streams = [s.measurement_noise for s in streams]
            self.measurement_noise.reset(plants, noise_streams, variances)
        if isinstance(self.setpoint, RepeatedSetPoint):  # which needs no random numbers
            return self.setpoint.reset(plants)
        return self.setpoint.reset(plants, [s.setpoint for s in streams])

    def ahead(self) -> list[tuple[float, ...]]:
        """Return all signals of a single plant at the next 600 samples, one tuple per sample.

        Each tuple holds set point y_d, noise n, load w and measurement noise at a sample, in
        degC. `ahead` needs signals of one plant without a limit of the episodes.
        """
        columns: list[list[float]] = []
        for signal in self:
            if signal is None:  # always 0
                columns.append([0.0] * SAMPLES_AT_A_TIME)
            else:
                columns.append(signal.ahead())
        return list(zip(*columns, strict=True))


def _block_samples(values_per_sample: int, episode_length: int) -> int:
    """Return the number of samples in a block, at most 600 (`SAMPLES_AT_A_TIME`).

    The blocks of an episode end at or shortly after the end of the episode, so that few random
    numbers are drawn in vain. Where the blocks of many plants would need more memory than 256
    MiB (`BLOCK_BYTES`), the blocks are shorter, which is slower.
    """
    affordable = BLOCK_BYTES // (8 * max(1, values_per_sample))
    most_samples = max(1, min(SAMPLES_AT_A_TIME, affordable))
    blocks_per_episode = -(-episode_length // most_samples)  # rounded up
    return -(-episode_length // blocks_per_episode)
