"""Draw plant numbers, and give every episode of a plant its own random numbers.

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
DRAWS = 32
# The state of a PCG64 that has just been created, apart from its position in the stream.
_PCG64 = {"bit_generator": "PCG64", "has_uint32": 0, "uinteger": 0}
# The seed of generators whose state is replaced at once: making a seed anew takes time.
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
    entropy, spawn_key, pool_size
        The arguments of the `numpy.random.SeedSequence` from which the stream starts.

    Attributes
    ----------
    generator : numpy.random.Generator
        The generator of the present episode. The attribute does not exist before the first
        episode.
    """

    # Without a dict per stream, the streams of 100,000 plants take little memory.
    __slots__ = ("_episode", "_origin", "_seeds", "generator")

    generator: np.random.Generator

    def __init__(self, entropy: Any, spawn_key: tuple[int, ...], pool_size: int = 4) -> None:
        self._seeds = entropy, spawn_key, pool_size
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
        """Move to the start of the next episode and return the number generator there."""
        if self._episode == 0:
            entropy, spawn_key, pool_size = self._seeds
            seeds = np.random.SeedSequence(entropy, spawn_key=spawn_key, pool_size=pool_size)
            self.generator = np.random.Generator(np.random.PCG64(seeds))
            self._origin = self.generator.bit_generator.state["state"]
        else:
            # The bit generator is looked up every time, as a copied generator has another one.
            bits: Any = self.generator.bit_generator
            bits.state = {**_PCG64, "state": self._origin}
            bits.advance(self._episode << 64)
        self._episode += 1
        return self.generator


class Streams(NamedTuple):
    """All random number streams of one plant.

    A further stream must be added at the end, so that the random numbers of the existing
    streams stay the same.
    """

    noise: EpisodeStream
    setpoint: EpisodeStream
    plant: EpisodeStream  # in each episode, first the plant numbers, then the load disturbance
    measurement_noise: EpisodeStream

    @classmethod
    def spawn(cls, seeds: np.random.SeedSequence) -> Streams:
        """Return streams that start at new children of the seed sequence `seeds`.

        Each call spawns further children, so that each call returns other streams.
        """
        children = seeds.spawn(len(cls._fields))
        return cls(
            *(
                EpisodeStream(child.entropy, child.spawn_key, child.pool_size)
                for child in children
            )
        )

    @classmethod
    def of_seed(cls, seed: int) -> Streams:
        """Return the streams that `spawn` first returns for `SeedSequence(seed)`, faster."""
        return cls(*(EpisodeStream(seed, (child,)) for child in range(len(cls._fields))))


class Ranges:
    """Draw the plant numbers that are ranges, uniformly, at the start of each episode.

    Numbers between two floats are drawn from [low, high), and integers from low to high, both
    included. Every plant number has its own random number, whether the plant number is a range
    or not. So the other plant numbers of a seed do not change if one more plant number becomes
    a range.

    Parameters
    ----------
    parameters
        The arguments of the environment, of which the plant numbers may be ranges.

    Attributes
    ----------
    lowest : PlantNumbers
        All plant numbers, each range replaced by its low end, in arrays of shape ().
    """

    def __init__(self, parameters: Parameters) -> None:
        self._ranges = parameters.ranges
        # The load disturbance takes random numbers from the stream `Streams.plant`, too, after
        # the random numbers that are reserved for the plant numbers.
        self._uses_stream = bool(self._ranges) or parameters.is_disturbed
        lowest = {name: np.array(number) for name, number in vars(parameters.lowest).items()}
        self.lowest: PlantNumbers[Values] = PlantNumbers(**lowest)

    def draw(self, streams: Sequence[Streams]) -> PlantNumbers[Values]:
        """Begin the next episode of some plants, and return the plant numbers of this episode.

        Parameters
        ----------
        streams
            The streams of each of these plants. The method begins the next episode of the
            stream `plant` if a plant number or the load is random.

        Returns
        -------
        PlantNumbers
            Plant numbers that are ranges, drawn, in arrays of shape (len(streams),), and the
            other plant numbers in arrays of shape ().
        """
        if not self._uses_stream:
            return self.lowest
        draws = np.empty((len(streams), DRAWS))
        for plant_streams, row in zip(streams, draws, strict=True):
            plant_streams.plant.next_episode().random(out=row)
        numbers: dict[str, NDArray[Any]] = {}
        for name, (low, high) in self._ranges.items():
            share = draws[:, PLANT_NUMBERS[name]]  # from 0 to 1, 1 excluded
            if isinstance(low, int):
                numbers[name] = low + np.floor(share * (high + 1 - low)).astype(int)
            else:
                numbers[name] = low + share * (high - low)
        return replace(self.lowest, **numbers)


def plant_numbers(numbers: PlantNumbers[Values], i: int) -> PlantNumbers[float]:
    """Return the plant numbers of one of many plants, as Python numbers.

    Parameters
    ----------
    numbers
        The plant numbers of many plants, in arrays of shape (n,), or of shape () for a number
        that all plants share.
    i
        The index of the plant.
    """
    numbers_of_plant: dict[str, float] = {}
    for name, values in vars(numbers).items():
        value = values[i] if values.ndim else values
        numbers_of_plant[name] = value.item()
    return PlantNumbers(**numbers_of_plant)
