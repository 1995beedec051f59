"""Sample plant numbers, and give every episode of a plant its own random numbers.

The plant numbers are the fields of `PlantNumbers`, such as delay and dead zone.
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

# Random numbers that each episode reserves for plant numbers: more than the present 13, so that
# a new plant number does not change the random numbers that follow.
RESERVED_RANDOM_NUMBERS = 32
# The seed of generators whose state is replaced at once: a seed that is made anew takes time.
_ANY_SEED = np.random.SeedSequence(0)


class EpisodeStream:
    """A stream of random numbers in which every episode has its own starting point.

    Episode j begins j * 2**64 random numbers into the stream, however many random numbers the
    earlier episodes have used. So the j-th episode after a seed always gets the same random
    numbers.

    The generator is created at the first episode, because many plants have streams that are
    never used.

    Parameters
    ----------
    entropy, spawn_key
        The arguments of the `numpy.random.SeedSequence` from which the stream starts.

    Attributes
    ----------
    generator : numpy.random.Generator
        The generator of the present episode. The attribute does not exist before the first
        episode.
    """

    # Without a dict per stream, the streams of 100,000 plants take little memory.
    __slots__ = ("_entropy", "_episode", "_first_state", "_spawn_key", "generator")

    generator: np.random.Generator

    def __init__(self, entropy: Any, spawn_key: tuple[int, ...]) -> None:
        self._entropy = entropy
        self._spawn_key = spawn_key
        self._episode = 0

    def __deepcopy__(self, memo: dict[int, Any]) -> EpisodeStream:
        """Return a copy at the same place in the stream, faster than `copy.deepcopy` alone."""
        duplicate = copy(self)
        if hasattr(self, "generator"):
            bits: Any = np.random.PCG64(_ANY_SEED)
            bits.state = self.generator.bit_generator.state
            duplicate.generator = np.random.Generator(bits)
        return duplicate

    def next_episode(self) -> np.random.Generator:
        """Return the generator, moved to the start of the stream's next episode."""
        if self._episode == 0:
            seeds = np.random.SeedSequence(self._entropy, spawn_key=self._spawn_key)
            self.generator = np.random.Generator(np.random.PCG64(seeds))
            self._first_state = self.generator.bit_generator.state
        else:
            bits: Any = self.generator.bit_generator
            bits.state = self._first_state
            bits.advance(self._episode * 2**64)
        self._episode += 1
        return self.generator


class RandomStreams(NamedTuple):
    """All random number streams of one plant.

    A further stream must be added at the end, so that the random numbers of the existing
    streams stay the same.
    """

    noise: EpisodeStream
    setpoint: EpisodeStream
    plant: EpisodeStream  # in each episode, first the plant numbers, then the load disturbance
    measurement_noise: EpisodeStream

    @classmethod
    def spawn(cls, seeds: np.random.SeedSequence) -> RandomStreams:
        """Return streams that start at new children of the seed sequence `seeds`.

        A second call for the same seed sequence returns different streams.
        """
        children = seeds.spawn(len(cls._fields))
        return cls(*(EpisodeStream(child.entropy, child.spawn_key) for child in children))

    @classmethod
    def of_seed(cls, seed: int) -> RandomStreams:
        """Return the streams that `spawn` first returns for `SeedSequence(seed)`, faster."""
        return cls(*(EpisodeStream(seed, (child,)) for child in range(len(cls._fields))))


class PlantSampler:
    """Sample the plant numbers that are ranges, uniformly, at the start of each episode.

    Floats are sampled from [low, high), and integers from low to high, both included. Every
    plant number has its own random number, whether the plant number is a range or not. So a
    further range does not change the numbers that a seed samples for the other ranges.

    Parameters
    ----------
    parameters
        The arguments of the environment, of which the plant numbers may be ranges.
    """

    def __init__(self, parameters: Parameters) -> None:
        self._ranges = parameters.ranges
        # The load disturbance takes random numbers from the stream `RandomStreams.plant`, too,
        # after the random numbers that are reserved for the plant numbers.
        self._uses_stream = bool(self._ranges) or parameters.is_disturbed
        lowest = {name: np.array(number) for name, number in vars(parameters.lowest).items()}
        # All plant numbers, in arrays of shape (), each range replaced by its low end.
        self._lowest: PlantNumbers[Values] = PlantNumbers(**lowest)

    def sample(self, streams: Sequence[RandomStreams]) -> PlantNumbers[Values]:
        """Begin the next episode of n plants, and return the plant numbers of this episode.

        Parameters
        ----------
        streams
            The random number streams of each of these plants. The stream `plant` moves to its
            next episode if a plant number or the load is random.

        Returns
        -------
        PlantNumbers
            Plant numbers that are ranges, sampled, in arrays of shape (n,), and the other plant
            numbers in arrays of shape ().
        """
        if not self._uses_stream:
            return self._lowest
        uniform = np.empty((len(streams), RESERVED_RANDOM_NUMBERS))
        for streams_of_plant, uniform_of_plant in zip(streams, uniform, strict=True):
            streams_of_plant.plant.next_episode().random(out=uniform_of_plant)
        numbers: dict[str, NDArray[Any]] = {}
        for name, (low, high) in self._ranges.items():
            share = uniform[:, PLANT_NUMBERS[name]]  # of the range, from 0 to 1, 1 excluded
            if isinstance(low, int):
                numbers[name] = low + np.floor(share * (high + 1 - low)).astype(int)
            else:
                numbers[name] = low + share * (high - low)
        return replace(self._lowest, **numbers)


def plant_numbers(numbers: PlantNumbers[Values], i: int) -> PlantNumbers[float]:
    """Return the plant numbers of the plant with index `i`, as Python numbers.

    `numbers` holds the plant numbers of n plants: arrays of shape (n,), or of shape () for a
    number that all plants share.
    """
    numbers_of_plant: dict[str, float] = {}
    for name, values in vars(numbers).items():
        value = values[i] if values.ndim else values
        numbers_of_plant[name] = value.item()
    return PlantNumbers(**numbers_of_plant)
