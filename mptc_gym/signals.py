"""What comes from outside during an episode: set point, noise, and the draws they are made of.

One plant and many side by side have classes of their own, which share how a signal goes on. The
noise is made a block of samples at a time: drawing many numbers in one call costs a small part
of drawing them one by one, and gives the same numbers.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from mptc_gym.parameters import Parameters

BLOCK = 600  # samples made at a time
FOREVER = 1 << 62  # samples
_TOGETHER = 32  # plants whose noise is made at a time: it stays in the processor's cache


class EpisodeStream:
    """A stream of random numbers that starts every episode at a place of its own.

    Episode j begins j * 2**64 draws into the stream, whatever earlier episodes have used. So
    the j-th episode after a seed meets the same draws however long the ones before it were.

    Parameters
    ----------
    seeds
        Where the stream starts.
    """

    def __init__(self, seeds: np.random.SeedSequence) -> None:
        self._seeds = seeds
        self._generator: np.random.Generator | None = None  # made if it is ever used
        self._origin: Any = None
        self._episode = 0

    def next_episode(self) -> np.random.Generator:
        """Move to the start of the next episode and return the generator there."""
        if self._generator is None:
            self._generator = np.random.Generator(np.random.PCG64(self._seeds))
            self._origin = self._generator.bit_generator.state
        # Found through the generator, as a copy of it may have a bit generator of its own.
        bit_generator = cast("np.random.PCG64", self._generator.bit_generator)
        bit_generator.state = self._origin
        bit_generator.advance(self._episode << 64)
        self._episode += 1
        return self._generator


class Streams(NamedTuple):
    """All streams of one plant."""

    noise: EpisodeStream
    setpoint: EpisodeStream

    @classmethod
    def spawn(cls, seeds: np.random.SeedSequence) -> Streams:
        """Make the streams of a seed; a new one comes last, and changes none before it."""
        return cls(*map(EpisodeStream, seeds.spawn(len(cls._fields))))


class Noise:
    """The process noise n(k) = C(z^-1) xi(k) of (28), from k = 1 on; xi is 0 before.

    Parameters
    ----------
    parameters
        Uses `c` and `noise_variance`.
    """

    def __init__(self, parameters: Parameters) -> None:
        self._colour = _colour(parameters)
        self._silent = parameters.noise_variance == 0.0

    def restart(self, stream: EpisodeStream) -> None:
        """Begin an episode, with one draw a sample; without noise the stream is untouched."""
        self._generator = None if self._silent else stream.next_episode()
        self._past = np.zeros(len(self._colour) - 1)  # draws, oldest first

    def take(self, samples: int) -> list[float]:
        """Return the next values of n, degC."""
        if self._generator is None:
            return [0.0] * samples
        draws = np.concatenate((self._past, self._generator.standard_normal(samples)))
        self._past = draws[samples:]
        noise: list[float] = _coloured(self._colour, draws).tolist()
        return noise


class Noises:
    """`Noise` for many plants, each to the bit what it is alone.

    Parameters
    ----------
    parameters
        Uses `c` and `noise_variance`.
    num_envs
        Number of plants.
    block
        Samples made at a time.
    """

    def __init__(self, parameters: Parameters, num_envs: int, block: int) -> None:
        self._colour = _colour(parameters)
        self._silent = parameters.noise_variance == 0.0
        self._silence = np.zeros(num_envs)
        self._past = np.zeros((num_envs, len(self._colour) - 1))
        self._generators: dict[int, np.random.Generator] = {}
        # A row a sample: what all plants need at a time lies together.
        self._block = np.zeros((0 if self._silent else block, num_envs))
        self._row = 0  # the next one

    def restart(self, which: NDArray[np.intp], streams: Iterable[EpisodeStream]) -> None:
        """Begin an episode of some plants, of sorted indices, with a stream for each."""
        if self._silent:
            return
        self._past[which] = 0.0
        for i, stream in zip(which.tolist(), streams, strict=True):
            self._generators[i] = stream.next_episode()
        if len(which) == len(self._past):
            self._row = len(self._block)
        else:
            self._fill(which, self._row)

    def next(self) -> NDArray[np.float64]:
        """Return the next n of all plants, degC, shape (num_envs,); only to be read."""
        if self._silent:
            return self._silence
        if self._row == len(self._block):
            self._fill(np.arange(len(self._past)), 0)
            self._row = 0
        row: NDArray[np.float64] = self._block[self._row]
        self._row += 1
        return row

    def _fill(self, which: NDArray[np.intp], first_row: int) -> None:
        """Make the noise of some plants, from a row on to the end of the block."""
        order = len(self._colour) - 1
        samples = len(self._block) - first_row
        for start in range(0, len(which), _TOGETHER):
            plants = which[start : start + _TOGETHER]
            draws = np.empty((len(plants), order + samples))
            draws[:, :order] = self._past[plants]
            for i, row in zip(plants.tolist(), draws[:, order:], strict=True):
                self._generators[i].standard_normal(out=row)
            self._past[plants] = draws[:, samples:]
            # A slice, if there are no gaps, is much faster.
            gaps = plants[-1] - plants[0] >= len(plants)
            columns = plants if gaps else slice(plants[0], plants[-1] + 1)
            self._block[first_row:, columns] = _coloured(self._colour, draws).T


def _colour(parameters: Parameters) -> list[float]:
    """Return C of (28), made for draws of variance 1."""
    deviation = math.sqrt(parameters.noise_variance)
    return [deviation * coefficient for coefficient in parameters.c]


def _coloured(colour: Sequence[float], draws: NDArray[np.float64]) -> NDArray[np.float64]:
    """Filter draws along the last axis, of which the first len(colour) - 1 are past ones."""
    order = len(colour) - 1
    noise: NDArray[np.float64] = colour[0] * draws[..., order:]
    for lag, coefficient in enumerate(colour[1:], start=1):
        noise += coefficient * draws[..., order - lag : -lag]
    return noise


class Levels:
    """How the set point goes on: through levels, each held for a number of samples.

    Parameters
    ----------
    parameters
        Uses `setpoint`, `setpoint_amplitude` and `setpoint_period`.

    Attributes
    ----------
    random : bool
        Whether they are drawn.
    values : list of float
        Otherwise the levels, degC, to be repeated.
    lengths : list of int
        How many samples each is held for.
    """

    def __init__(self, parameters: Parameters) -> None:
        kind, period = parameters.setpoint, parameters.setpoint_period
        self.random = kind == "random"
        self._amplitude = amplitude = parameters.setpoint_amplitude
        self._shortest = max(1, math.ceil(period / 6))
        self._longest = max(self._shortest, period // 2)
        if isinstance(kind, str):  # "square"
            self.values = [amplitude, -amplitude]
            self.lengths = [(period + 1) // 2, period // 2]
        else:
            self.values = [kind] if isinstance(kind, float) else list(kind)
            self.lengths = [1] * (len(self.values) - 1) + [FOREVER]

    def draw(self, generator: np.random.Generator) -> tuple[float, int]:
        """Draw a level, degC, and how many samples it is held for."""
        level = generator.uniform(-self._amplitude, self._amplitude)
        return level, int(generator.integers(self._shortest, self._longest, endpoint=True))


class SetPoint:
    """The set point y_d(k) from k = 0 on.

    Parameters
    ----------
    parameters
        Uses `setpoint`, `setpoint_amplitude` and `setpoint_period`.
    """

    def __init__(self, parameters: Parameters) -> None:
        self._levels = Levels(parameters)

    def restart(self, stream: EpisodeStream) -> None:
        """Begin an episode; the stream is untouched unless levels are random."""
        self._generator = stream.next_episode() if self._levels.random else None
        self._place = 0  # of the next level
        self._level, self._left = 0.0, 0  # the level now, and for how many samples more

    def take(self, samples: int) -> list[float]:
        """Return the next values of y_d, degC."""
        values: list[float] = []
        while len(values) < samples:
            if self._left == 0:
                self._next_level()
            length = min(self._left, samples - len(values))
            values += [self._level] * length
            self._left -= length
        return values

    def _next_level(self) -> None:
        levels = self._levels
        if self._generator is not None:
            self._level, self._left = levels.draw(self._generator)
        else:
            self._level, self._left = levels.values[self._place], levels.lengths[self._place]
            self._place = (self._place + 1) % len(levels.values)


class SetPoints:
    """`SetPoint` for many plants, each to the bit what it is alone.

    Its clock counts samples since all plants began; each plant has its own k.

    Parameters
    ----------
    parameters
        Uses `setpoint`, `setpoint_amplitude` and `setpoint_period`.
    num_envs
        Number of plants.

    Attributes
    ----------
    now : ndarray, shape (num_envs,)
        y_d of all plants, degC; only to be read.
    next_change : int
        When the first of them changes, by the clock; `move` does nothing before.
    """

    def __init__(self, parameters: Parameters, num_envs: int) -> None:
        self._levels = Levels(parameters)
        self._values = np.array(self._levels.values)
        self._lengths = np.array(self._levels.lengths)
        self._generators: dict[int, np.random.Generator] = {}
        self._places = np.zeros(num_envs, np.intp)  # of the next level
        self.now = np.zeros(num_envs)
        self._changes = np.zeros(num_envs, np.int64)  # by the clock, of the next level
        self.next_change = 0

    def restart(
        self, which: NDArray[np.intp], streams: Iterable[EpisodeStream], clock: int
    ) -> None:
        """Begin an episode of some plants, given by indices, with a stream for each."""
        if self._levels.random:
            for i, stream in zip(which.tolist(), streams, strict=True):
                self._generators[i] = stream.next_episode()
        self._places[which] = 0
        self._changes[which] = clock
        self._next_level(which)

    def move(self, clock: int) -> None:
        """Bring `now` to a sample of the clock, the next one or the same."""
        while clock >= self.next_change:
            self._next_level(np.flatnonzero(self._changes <= clock))

    def _next_level(self, which: NDArray[np.intp]) -> None:
        if self._levels.random:
            for i in which.tolist():
                self.now[i], length = self._levels.draw(self._generators[i])
                self._changes[i] += length
        else:
            places = self._places[which]
            self.now[which] = self._values[places]
            self._changes[which] += self._lengths[places]
            self._places[which] = (places + 1) % len(self._values)
        self.next_change = int(self._changes.min())
