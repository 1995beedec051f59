"""Draw what an episode meets: plant numbers, set point, noise and load disturbance.

Every signal has the same methods. `reset` begins an episode of some plants at k = 0. `next`
returns the next sample of all plants, and `ahead` the next `BLOCK` samples of a single plant.

Noise and disturbance are generated a block of samples at a time: drawing many numbers in one
call is much faster than drawing them one by one, and gives the same numbers.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mptc_gym.parameters import PLANT_NUMBERS, Parameters, PlantNumbers

Values = NDArray[np.float64]  # one per plant; of plant numbers, () where all share one value
Indices = NDArray[np.intp]  # of some plants, sorted
Sources = Mapping[int, "Streams"] | Sequence["Streams"]  # those of each plant

DRAWS = 32  # of plant numbers per episode: enough for all, and for future ones
BLOCK = 600  # samples of a signal generated together
FOREVER = 1 << 62  # samples
PLANTS_AT_A_TIME = 32  # few enough that their draws stay in the processor's cache
LOAD_INTERVAL = 10  # samples between changes of the load disturbance
LEVELS_AT_A_TIME = 60  # of the load disturbance, generated together
ONE = np.zeros(1, np.intp)  # the indices of one plant
_ANY_SEED = np.random.SeedSequence(0)  # of generators whose state is then set
_PCG64 = {"bit_generator": "PCG64", "has_uint32": 0, "uinteger": 0}  # and its state


class EpisodeStream:
    """A stream of random numbers in which every episode has its own starting point.

    Episode j begins j * 2**64 draws into the stream, however many earlier episodes have used.
    So the j-th episode after a seed gets the same draws, however long those before it were.
    The `SeedSequence` with these arguments, which starts the stream, is created at the first
    episode, as many plants have streams that are never used.
    """

    # Without a dict each, the streams of 100,000 plants take little memory.
    __slots__ = ("_episode", "_origin", "_seeds", "generator")

    generator: np.random.Generator  # of the current episode

    def __init__(self, entropy: Any, spawn_key: tuple[int, ...], pool_size: int = 4) -> None:
        self._seeds = entropy, spawn_key, pool_size
        self._episode = 0

    def __deepcopy__(self, memo: dict[int, Any]) -> EpisodeStream:
        """Return a copy at the same place; a plain deep copy takes ten times as long."""
        duplicate = copy(self)
        if hasattr(self, "generator"):
            bits: Any = np.random.PCG64(_ANY_SEED)
            bits.state = self.generator.bit_generator.state
            duplicate.generator = np.random.Generator(bits)
        return duplicate

    def next_episode(self) -> np.random.Generator:
        """Move to the start of the next episode and return the generator there."""
        if self._episode == 0:
            entropy, spawn_key, pool_size = self._seeds
            seeds = np.random.SeedSequence(entropy, spawn_key=spawn_key, pool_size=pool_size)
            self.generator = np.random.Generator(np.random.PCG64(seeds))
            self._origin = self.generator.bit_generator.state["state"]
        else:
            # Taken from the generator, as a copy of it may have its own bit generator.
            bits: Any = self.generator.bit_generator
            bits.state = {**_PCG64, "state": self._origin}
            bits.advance(self._episode << 64)
        self._episode += 1
        return self.generator


class Streams(NamedTuple):
    """All streams of one plant; new ones come last, so that the others do not change."""

    noise: EpisodeStream
    setpoint: EpisodeStream
    plant: EpisodeStream  # first the plant numbers, then the disturbance
    measurement_noise: EpisodeStream

    @classmethod
    def spawn(cls, seeds: np.random.SeedSequence) -> Streams:
        """Make the streams of a seed sequence, each from a child that nobody else gets."""
        children = seeds.spawn(len(cls._fields))
        return cls(*(EpisodeStream(c.entropy, c.spawn_key, c.pool_size) for c in children))

    @classmethod
    def of_seed(cls, seed: int) -> Streams:
        """Make the streams that `spawn` makes from `SeedSequence(seed)`, but faster."""
        return cls(*(EpisodeStream(seed, (place,)) for place in range(len(cls._fields))))


class Ranges:
    """Draw arguments that are ranges, uniformly; a delay is an integer, both ends included.

    Every plant number has its own draw, whether it is a range or not, so that one more range
    does not change the others' draws. `names` are the arguments that are ranges, with their
    ends. `given` are all plant numbers, with the lower end of a range, in arrays of shape ().
    """

    def __init__(self, parameters: Parameters) -> None:
        self.names = parameters.ranges
        # The disturbance's draws follow those of the plant numbers.
        self._draws = bool(self.names) or parameters.is_disturbed
        self.given: PlantNumbers[Values] = PlantNumbers(
            **{name: np.array(parameters.range_of(name)[0]) for name in PLANT_NUMBERS}
        )

    def draw(self, streams: Sequence[Streams]) -> PlantNumbers[Values]:
        """Begin an episode of each plant, and draw its numbers.

        Drawn numbers have the shape (len(streams),), others the shape ().
        """
        if not self._draws:
            return self.given
        draws = np.empty((len(streams), DRAWS))
        for own, row in zip(streams, draws, strict=True):
            own.plant.next_episode().random(out=row)
        drawn = {}
        for name, (low, high) in self.names.items():
            whole = isinstance(low, int)
            above = draws[:, PLANT_NUMBERS[name]] * (high + whole - low)
            drawn[name] = low + (np.floor(above).astype(int) if whole else above)
        return replace(self.given, **drawn)


def plant_numbers(numbers: PlantNumbers[Values], i: int) -> PlantNumbers[float]:
    """Return the numbers of plant i of many."""
    own = {name: a[i].item() if a.ndim else a.item() for name, a in vars(numbers).items()}
    return PlantNumbers(**own)


def colours(parameters: Parameters) -> dict[str, Sequence[float]]:
    """Return the coefficients of C in (28) by the name of each noise that is not always 0."""
    of_all = {"noise": parameters.c, "measurement_noise": (1.0,)}
    return {n: c for n, c in of_all.items() if parameters.range_of(f"{n}_variance")[1] > 0.0}


class Noise:
    """Noise by name, 0 at k = 0: C(z^-1) xi(k) of (28), or the measurement noise."""

    def __init__(self, name: str, c: Sequence[float], num_envs: int, block: int) -> None:
        self._name, self._c = name, np.array(c)[:, np.newaxis, np.newaxis]
        # C times the standard deviation of xi: [lag, plant, 0].
        self._colour = np.zeros((len(c), num_envs, 1))
        self._past = np.zeros((num_envs, len(c) - 1))
        # One row per sample, so that what all plants need at once is contiguous.
        self._block = np.zeros((block, num_envs))
        self._row = 0  # the next row

    def reset(self, which: Indices, streams: Sources, numbers: PlantNumbers[Values]) -> None:
        """Begin an episode of some plants."""
        deviations = np.sqrt(getattr(numbers, f"{self._name}_variance"))
        self._colour[:, which] = deviations[..., np.newaxis] * self._c
        self._past[which] = 0.0
        self._streams = streams
        for i in which.tolist():
            getattr(streams[i], self._name).next_episode()
        if len(which) == len(self._past):
            self._row = len(self._block)
        else:
            self._fill(which, self._row)

    def next(self) -> Values:
        """Return the next values of all plants, degC, shape (num_envs,); only to be read."""
        if self._row == len(self._block):
            self._fill(np.arange(len(self._past)), 0)
            self._row = 0
        row: Values = self._block[self._row]
        self._row += 1
        return row

    def ahead(self) -> list[float]:
        """Return the next block of one plant, degC."""
        self._fill(ONE, 0)
        noise: list[float] = self._block[:, 0].tolist()
        return noise

    def _fill(self, which: Indices, first_row: int) -> None:
        """Generate the noise of some plants, from a row to the end of the block."""
        order = len(self._c) - 1
        samples = len(self._block) - first_row
        for start in range(0, len(which), PLANTS_AT_A_TIME):
            plants = which[start : start + PLANTS_AT_A_TIME]
            draws = np.empty((len(plants), order + samples))
            draws[:, :order] = self._past[plants]
            for i, row in zip(plants.tolist(), draws[:, order:], strict=True):
                getattr(self._streams[i], self._name).generator.standard_normal(out=row)
            self._past[plants] = draws[:, samples:]
            # If there are no gaps, a slice is much faster.
            gaps = plants[-1] - plants[0] >= len(plants)
            columns = plants if gaps else slice(plants[0], plants[-1] + 1)
            colour = self._colour[:, columns]
            noise = colour[0] * draws[:, order:]
            for lag, coefficient in enumerate(colour[1:], start=1):
                noise += coefficient * draws[:, order - lag : -lag]
            self._block[first_row:, columns] = noise.T


class Levels:
    """The levels of a set point, each held for a number of samples."""

    def __init__(self, parameters: Parameters) -> None:
        kind, period = parameters.setpoint, parameters.setpoint_period
        self.random = kind == "random"
        # Random levels are uniform within +-`amplitude`, degC, and held for `shortest` to
        # `longest` samples, both included.
        self.amplitude = amplitude = parameters.setpoint_amplitude
        self.shortest = max(1, math.ceil(period / 6))
        self.longest = max(self.shortest, period // 2)
        # Others repeat `values`, degC, each held for its number of samples in `lengths`.
        if isinstance(kind, str):  # "square"
            self.values = [amplitude, -amplitude]
            self.lengths = [(period + 1) // 2, period // 2]
        else:
            self.values = [kind] if isinstance(kind, float) else list(kind)
            self.lengths = [1] * (len(self.values) - 1) + [FOREVER]

    def next(self, place: int, stream: EpisodeStream) -> tuple[float, int]:
        """Return the level at a place, or draw one, degC; and for how many samples it holds."""
        if not self.random:
            place %= len(self.values)
            return self.values[place], self.lengths[place]
        level = stream.generator.uniform(-self.amplitude, self.amplitude)
        return level, int(stream.generator.integers(self.shortest, self.longest, endpoint=True))


class _Held(ABC):
    """Values of many plants, each held until it changes."""

    def __init__(self, num_envs: int) -> None:
        self._now = np.zeros(num_envs)
        # Samples since the plants were created, and when, on that clock, each value changes.
        self._clock = 0
        self._changes = np.zeros(num_envs, np.int64)
        self._next_change = 0  # the earliest of them

    @property
    def present(self) -> Values:
        """The present values of all plants, degC, shape (num_envs,); only to be read."""
        return self._now

    def next(self) -> Values:
        """Return the next values of all plants, degC, shape (num_envs,); only to be read."""
        self._clock += 1
        if self._clock >= self._next_change:
            self._catch_up()
        return self._now

    def _catch_up(self) -> None:
        # Repeated where a level is held for 0 samples, as with a period of 1.
        while self._clock >= self._next_change:
            self._change(self._changes <= self._clock)
            self._next_change = int(self._changes.min())

    @abstractmethod
    def _change(self, due: NDArray[np.bool_]) -> None:
        """Change the values that are due, and set when they change next."""


class SetPoint(_Held):
    """The set point y_d(k)."""

    def __init__(self, parameters: Parameters, num_envs: int) -> None:
        super().__init__(num_envs)
        self._levels = Levels(parameters)
        self._values = np.array(self._levels.values)
        self._lengths = np.array(self._levels.lengths)
        self._places = np.zeros(num_envs, np.intp)  # of the next level

    def reset(self, which: Indices, streams: Sources) -> Values:
        """Begin an episode of some plants, and return y_d(0)."""
        self._streams = streams
        if self._levels.random:
            for i in which.tolist():
                streams[i].setpoint.next_episode()
        self._places[which] = 0
        self._changes[which] = self._next_change = self._clock
        self._catch_up()
        return self._now[which]

    def ahead(self) -> list[float]:
        """Return the next block of one plant, degC."""
        level, place = self._now.item(), self._places.item()
        values: list[float] = []
        end = self._next_change - self._clock - 1  # of the level, counted from the next sample
        while end < BLOCK:
            values += [level] * (end - len(values))
            level, length = self._levels.next(place, self._streams[0].setpoint)
            place, end = place + 1, end + length
        self._now[0], self._places[0] = level, place
        self._clock += BLOCK
        self._next_change = self._clock + 1 + end - BLOCK
        return values + [level] * (BLOCK - len(values))

    def _change(self, due: NDArray[np.bool_]) -> None:
        which = np.flatnonzero(due)
        if self._levels.random:
            for i in which.tolist():
                self._now[i], length = self._levels.next(0, self._streams[i].setpoint)
                self._changes[i] += length
        else:
            places = self._places[which]
            self._now[which] = self._values[places]
            self._changes[which] += self._lengths[places]
            self._places[which] = (places + 1) % len(self._values)


class Disturbance(_Held):
    """The load disturbance w(k): the sum of steps and a random walk, both starting at 0.

    It changes every `LOAD_INTERVAL` samples. The walk takes a uniform step of the required
    variance; the sum of many is close to normal. With a probability of
    `LOAD_INTERVAL / disturbance_interval` the other part jumps to a new level, uniform within
    +-`disturbance_amplitude`.
    """

    def __init__(self, num_envs: int) -> None:
        super().__init__(num_envs)
        # Amplitude, probability of a jump, and half width of the walk's steps.
        self._shapes = np.zeros((num_envs, 3))
        self._last = np.zeros((num_envs, 2))
        self._levels = np.zeros((num_envs, LEVELS_AT_A_TIME))  # those ahead
        # Index of each plant's end in the flattened levels.
        self._ends = np.arange(1, num_envs + 1) * LEVELS_AT_A_TIME
        self._places = self._ends.copy()  # of the next level, in the flattened levels

    def reset(self, which: Indices, streams: Sources, numbers: PlantNumbers[Values]) -> None:
        """Begin an episode of some plants, whose numbers have been drawn before."""
        self._streams = streams
        probability = LOAD_INTERVAL / numbers.disturbance_interval
        # Uniform within +-h, a step of the walk has the variance h^2 / 3.
        width = np.sqrt(3.0 * LOAD_INTERVAL * numbers.disturbance_walk_variance)
        shapes = np.broadcast_arrays(numbers.disturbance_amplitude, probability, width)
        self._shapes[which] = np.stack(shapes, axis=-1)
        self._last[which] = self._now[which] = 0.0
        self._places[which] = self._ends[which]
        self._changes[which] = self._clock + LOAD_INTERVAL
        self._next_change = int(self._changes.min())
        self._ahead = [0.0] * (LOAD_INTERVAL - 1)  # of a single plant

    def ahead(self) -> list[float]:
        """Return the next block of one plant, degC."""
        while len(self._ahead) < BLOCK:
            self._refill(ONE)
            self._ahead += np.repeat(self._levels[0], LOAD_INTERVAL).tolist()
        values, self._ahead = self._ahead[:BLOCK], self._ahead[BLOCK:]
        return values

    def _change(self, due: NDArray[np.bool_]) -> None:
        self._refill(np.flatnonzero(due & (self._places == self._ends)))
        np.copyto(self._now, self._levels.take(self._places, mode="clip"), where=due)
        self._places += due
        self._changes += LOAD_INTERVAL * due

    def _refill(self, which: Indices) -> None:
        """Generate the next levels of some plants."""
        for start in range(0, len(which), PLANTS_AT_A_TIME):
            plants = which[start : start + PLANTS_AT_A_TIME]
            draws = np.empty((len(plants), LEVELS_AT_A_TIME, 3))
            for i, row in zip(plants.tolist(), draws, strict=True):
                self._streams[i].plant.generator.random(out=row)
            self._levels[plants] = self._sum(plants, draws)
        self._places[which] = self._ends[which] - LEVELS_AT_A_TIME

    def _sum(self, plants: Indices, draws: Values) -> Values:
        """Return levels w, (plants, levels), from uniform draws, (plants, levels, 3)."""
        amplitude, probability, width = self._shapes[plants, :, np.newaxis].swapaxes(0, 1)
        step, walk = self._last[plants, :, np.newaxis].swapaxes(0, 1)  # the previous ones
        walk = np.hstack((walk, (2.0 * draws[..., 0] - 1.0) * width)).cumsum(axis=1)[:, 1:]
        jumps = draws[..., 1] < probability
        steps = np.hstack((step, (2.0 * draws[..., 2] - 1.0) * amplitude))
        latest = np.where(jumps, np.arange(1, jumps.shape[1] + 1), 0)
        steps = np.take_along_axis(steps, np.maximum.accumulate(latest, axis=1), axis=1)
        self._last[plants] = np.stack((steps[:, -1], walk[:, -1]), axis=1)
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
        """Make the signals of an environment, with `block` samples of noise at a time."""
        noises = {n: Noise(n, c, num_envs, block) for n, c in colours(parameters).items()}
        return cls(
            SetPoint(parameters, num_envs),
            noises.get("noise"),
            Disturbance(num_envs) if parameters.is_disturbed else None,
            noises.get("measurement_noise"),
        )

    def reset(self, which: Indices, streams: Sources, numbers: PlantNumbers[Values]) -> Values:
        """Begin an episode of some plants, and return y_d(0); the other signals start at 0."""
        for signal in (self.noise, self.disturbance, self.measurement_noise):
            if signal is not None:
                signal.reset(which, streams, numbers)
        return self.setpoint.reset(which, streams)

    def ahead(self) -> list[tuple[float, ...]]:
        """Return y_d, n, w and the measurement noise of one plant, one tuple per sample."""
        silence = [0.0] * BLOCK
        return list(zip(*(each.ahead() if each else silence for each in self), strict=True))
