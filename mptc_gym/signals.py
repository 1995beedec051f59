"""What comes from outside during an episode: set point, noise, and the draws they are made of.

Signals are made a block of samples at a time: drawing many numbers in one call costs a small
part of drawing them one by one, and gives the same numbers.
"""

from __future__ import annotations

import math
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from mptc_gym.parameters import Parameters


class EpisodeStream:
    """A stream of random numbers that starts every episode at a place of its own.

    Episode j begins j * 2**64 draws into the stream, whatever earlier episodes have used. So
    the j-th episode after a seed meets the same draws however long the ones before it were.

    Parameters
    ----------
    seed_sequence
        Where the stream starts.
    """

    def __init__(self, seed_sequence: np.random.SeedSequence) -> None:
        self._generator = np.random.Generator(np.random.PCG64(seed_sequence))
        self._origin: Any = self._generator.bit_generator.state
        self._episode = 0

    def next_episode(self) -> np.random.Generator:
        """Move to the start of the next episode and return the generator there."""
        # Found through the generator, as a copy of it may have a bit generator of its own.
        bit_generator = cast("np.random.PCG64", self._generator.bit_generator)
        bit_generator.state = self._origin
        bit_generator.advance(self._episode << 64)
        self._episode += 1
        return self._generator


class Noise:
    """The process noise n(k) = C(z^-1) xi(k) of (28), from k = 1 on; xi is 0 before.

    Parameters
    ----------
    parameters
        Uses `c` and `noise_variance`.
    stream
        Where xi is drawn from, one standard normal a sample; untouched without noise.
    """

    def __init__(self, parameters: Parameters, stream: EpisodeStream) -> None:
        self._c = tuple(parameters.c)
        self._deviation = math.sqrt(parameters.noise_variance)
        self._generator = stream.next_episode() if self._deviation else None
        self._past_xi = np.zeros(len(self._c) - 1)  # oldest first

    def take(self, samples: int) -> NDArray[np.float64]:
        """Return the next `samples` values of n, in degC, shape (samples,)."""
        if self._generator is None:
            return np.zeros(samples)
        order = len(self._c) - 1
        draws = self._deviation * self._generator.standard_normal(samples)
        xi = np.concatenate((self._past_xi, draws))
        noise = np.zeros(samples)
        for lag, coefficient in enumerate(self._c):
            noise += coefficient * xi[order - lag : order - lag + samples]  # C of (28)
        self._past_xi = xi[samples:]
        return noise


class SetPoint:
    """The set point y_d(k) from k = 0 on.

    Parameters
    ----------
    parameters
        Uses `setpoint`, `setpoint_amplitude` and `setpoint_period`.
    stream
        Where the levels and lengths of "random" are drawn from; untouched otherwise.
    """

    def __init__(self, parameters: Parameters, stream: EpisodeStream) -> None:
        self._kind = parameters.setpoint
        self._amplitude = parameters.setpoint_amplitude
        self._period = parameters.setpoint_period
        self._generator = stream.next_episode() if self._kind == "random" else None
        self._sample = 0  # of the next value
        self._level = 0.0  # "random": the level now, and for how many samples more
        self._remaining = 0

    def take(self, samples: int) -> NDArray[np.float64]:
        """Return the next `samples` values of y_d, in degC, shape (samples,)."""
        if self._generator is not None:
            values = self._random(samples, self._generator)
        else:
            k = np.arange(self._sample, self._sample + samples)
            if isinstance(self._kind, str):  # "square"
                first_half = 2 * (k % self._period) < self._period
                values = np.where(first_half, self._amplitude, -self._amplitude)
            elif isinstance(self._kind, float):
                values = np.full(samples, self._kind)
            else:
                levels = np.asarray(self._kind, dtype=np.float64)
                values = levels[np.minimum(k, len(levels) - 1)]
        self._sample += samples
        return values

    def _random(self, samples: int, generator: np.random.Generator) -> NDArray[np.float64]:
        shortest = max(1, math.ceil(self._period / 6))
        longest = max(shortest, self._period // 2)
        values = np.empty(samples)
        filled = 0
        while filled < samples:
            if self._remaining == 0:
                self._level = generator.uniform(-self._amplitude, self._amplitude)
                self._remaining = int(generator.integers(shortest, longest, endpoint=True))
            length = min(self._remaining, samples - filled)
            values[filled : filled + length] = self._level
            self._remaining -= length
            filled += length
        return values
