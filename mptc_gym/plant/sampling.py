"""Sample the parameter values of plants, with separate random numbers for every episode.

The parameter values of a plant are the fields of `PlantNumbers`, such as the delay.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mptc_gym.plant.parameters import PLANT_NUMBERS, Parameters, PlantNumbers

Values = NDArray[np.float64]  # one element per plant, shape (n,), or shape () for all plants

# Number of random numbers that each episode reserves for the fields of `PlantNumbers`: more
# than the present 13 fields, so that a new field does not change the random numbers of the
# load.
RESERVED_RANDOM_NUMBERS = 32
# Seed of random number generators whose state is replaced immediately: creating a new seed for
# each generator would take time.
_ANY_SEED = np.random.SeedSequence(0)


class EpisodeStream:
    """A stream of random numbers in which every episode has its own starting point.

    Episode j begins j * 2**64 random numbers into the stream, however many random numbers the
    earlier episodes have used. The j-th episode after a seed therefore always has the same
    random numbers.

    The random number generator is created at the first episode, because many plants have
    streams that are never used.

    Parameters
    ----------
    entropy, spawn_key
        Arguments of the `numpy.random.SeedSequence` that seeds the stream.

    Attributes
    ----------
    generator : numpy.random.Generator
        Random number generator of the present episode. The attribute `generator` does not exist
        before the first episode.
    """

    # Without a dict per stream, the streams of 100,000 plants take little memory.
    __slots__ = ("_entropy", "_episode", "_first_state", "_spawn_key", "generator")

    generator: np.random.Generator

    def __init__(self, entropy: Any, spawn_key: tuple[int, ...]) -> None:
        self._entropy = entropy
        self._spawn_key = spawn_key
        self._episode = 0

    def __deepcopy__(self, memo: dict[int, Any]) -> EpisodeStream:
        """Return a copy at the same place in the stream, faster than the default deep copy."""
        duplicate = copy(self)
        if hasattr(self, "generator"):
            bits: Any = np.random.PCG64(_ANY_SEED)  # `state` below replaces that of this seed
            bits.state = self.generator.bit_generator.state
            duplicate.generator = np.random.Generator(bits)
        return duplicate

    def next_episode(self) -> np.random.Generator:
        """Return the random number generator, moved to the start of the next episode."""
        if self._episode == 0:
            seeds = np.random.SeedSequence(self._entropy, spawn_key=self._spawn_key)
            self.generator = np.random.Generator(np.random.PCG64(seeds))
            self._first_state = self.generator.bit_generator.state
        else:
            bits: Any = self.generator.bit_generator
            bits.state = self._first_state  # back to the start of the stream
            bits.advance(self._episode * 2**64)
        self._episode += 1
        return self.generator


class RandomStreams(NamedTuple):
    """The random number streams of one plant, such as the stream for the noise.

    A new stream must be the last field of `RandomStreams`, so that the random numbers of the
    existing streams do not change.
    """

    noise: EpisodeStream
    setpoint: EpisodeStream
    plant: EpisodeStream  # in each episode, first parameter values, then the load disturbance
    measurement_noise: EpisodeStream

    @classmethod
    def spawn(cls, seeds: np.random.SeedSequence) -> RandomStreams:
        """Return the streams of one plant, seeded by new children of the seed sequence `seeds`.

        A second call of `spawn` for the same seed sequence returns different streams.
        """
        children = seeds.spawn(len(cls._fields))
        return cls(*(EpisodeStream(child.entropy, child.spawn_key) for child in children))

    @classmethod
    def of_seed(cls, seed: int) -> RandomStreams:
        """Return the same streams as `spawn(SeedSequence(seed))`, but faster."""
        return cls(*(EpisodeStream(seed, (child,)) for child in range(len(cls._fields))))


class PlantSampler:
    """Sample the parameter values of plants at the start of each episode.

    From a range of floats, values are sampled uniformly from [low, high), and from a range of
    integers, uniformly from low to high, both included. Every field of `PlantNumbers` has its
    own random number, whether the field is a range or not. If a further field of `PlantNumbers`
    becomes a range, a seed therefore still gives the same values for the fields that were
    already ranges.

    Parameters
    ----------
    parameters
        Arguments of the environment, some of which may be ranges.
    """

    def __init__(self, parameters: Parameters) -> None:
        self._ranges = parameters.ranges
        # The load disturbance uses the stream `RandomStreams.plant` as well, after the random
        # numbers that are reserved for parameter values.
        self._uses_stream = bool(self._ranges) or parameters.is_disturbed
        lowest = {name: np.array(number) for name, number in vars(parameters.lowest).items()}
        # The value of each field of `PlantNumbers`, or the low end of a field that is a range,
        # in arrays of shape ().
        self._lowest: PlantNumbers[Values] = PlantNumbers(**lowest)

    def sample(self, streams: Sequence[RandomStreams]) -> PlantNumbers[Values]:
        """Return the parameter values of n plants for the next episode of these plants.

        Parameters
        ----------
        streams
            Random number streams of the n plants, one element per plant. If a parameter value
            or the load is random, `sample` moves the random number stream for parameter values
            and load of each plant to the next episode.

        Returns
        -------
        PlantNumbers
            Parameter values of the n plants: arrays of shape (n,) for values that were sampled
            from ranges, and arrays of shape () for all other values.
        """
        if not self._uses_stream:
            return self._lowest
        uniform = np.empty((len(streams), RESERVED_RANDOM_NUMBERS))
        # All reserved numbers are drawn, so that those of the load begin after them.
        for streams_of_plant, uniform_of_plant in zip(streams, uniform, strict=True):
            streams_of_plant.plant.next_episode().random(out=uniform_of_plant)
        numbers: dict[str, NDArray[Any]] = {}
        for name, (low, high) in self._ranges.items():
            share = uniform[:, PLANT_NUMBERS[name]]  # of the range, uniform in [0, 1)
            if isinstance(low, int):
                numbers[name] = low + np.floor(share * (high + 1 - low)).astype(int)
            else:
                numbers[name] = low + share * (high - low)
        return replace(self._lowest, **numbers)


def plant_numbers(numbers: PlantNumbers[Values], i: int) -> PlantNumbers[float]:
    """Return the parameter values of the plant with index `i`, as Python numbers.

    `numbers` holds the parameter values of n plants: arrays of shape (n,), or of shape () for a
    value that all plants share.
    """
    numbers_of_plant: dict[str, float] = {}
    for name, values in vars(numbers).items():
        value = values[i] if values.ndim else values
        numbers_of_plant[name] = value.item()
    return PlantNumbers(**numbers_of_plant)
