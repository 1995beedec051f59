"""Draw the numbers of an episode: its streams of random numbers, and the plant numbers."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mptc_gym.parameters import PLANT_NUMBERS, Parameters, PlantNumbers

Values = NDArray[np.float64]  # one per plant, shape (n,), or one for all plants, shape ()

DRAWS = 32  # random numbers that an episode reserves for plant numbers, also for future ones
# The state of a PCG64 that has just been created, apart from its position in the stream.
_PCG64 = {"bit_generator": "PCG64", "has_uint32": 0, "uinteger": 0}
_ANY_SEED = np.random.SeedSequence(0)  # of generators whose state is set afterwards


class EpisodeStream:
    """A stream of random numbers in which every episode has its own starting point.

    Episode j begins j * 2**64 draws into the stream, however many draws the episodes before it
    have used. So the j-th episode after a seed always gets the same draws.

    The arguments are those of the `numpy.random.SeedSequence` that starts the stream. It is
    created at the first episode, because many plants have streams that are never used.
    """

    # Without a dict per stream, the streams of 100,000 plants take little memory.
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
            # Looked up every time, as a copied generator has a bit generator of its own.
            bits: Any = self.generator.bit_generator
            bits.state = {**_PCG64, "state": self._origin}
            bits.advance(self._episode << 64)
        self._episode += 1
        return self.generator


class Streams(NamedTuple):
    """All streams of one plant.

    New streams come last, so that the numbers of the others do not change.
    """

    noise: EpisodeStream
    setpoint: EpisodeStream
    plant: EpisodeStream  # first the plant numbers, then the disturbance
    measurement_noise: EpisodeStream

    @classmethod
    def spawn(cls, seeds: np.random.SeedSequence) -> Streams:
        """Return streams that start at new children of a seed sequence."""
        children = seeds.spawn(len(cls._fields))
        return cls(
            *(
                EpisodeStream(child.entropy, child.spawn_key, child.pool_size)
                for child in children
            )
        )

    @classmethod
    def of_seed(cls, seed: int) -> Streams:
        """Return the streams that `spawn` returns for `SeedSequence(seed)`, but faster."""
        return cls(*(EpisodeStream(seed, (child,)) for child in range(len(cls._fields))))


class Ranges:
    """Draw the plant numbers that are ranges, uniformly, with both ends of an integer's range.

    Every plant number has its own random number, whether it is a range or not. So the draws of
    the others do not change if one more plant number becomes a range.

    Attributes
    ----------
    names : dict
        The plant numbers that are ranges, by name, with the ends (low, high).
    lowest : PlantNumbers
        All plant numbers, with the low end of a range, in arrays of shape ().
    """

    def __init__(self, parameters: Parameters) -> None:
        self.names = parameters.ranges
        # The disturbance takes its random numbers from the same stream, after those of the
        # plant numbers.
        self._uses_stream = bool(self.names) or parameters.is_disturbed
        lowest: dict[str, Values] = {}
        for name in PLANT_NUMBERS:
            low, _ = parameters.range_of(name)
            lowest[name] = np.array(low)
        self.lowest: PlantNumbers[Values] = PlantNumbers(**lowest)

    def draw(self, streams: Sequence[Streams]) -> PlantNumbers[Values]:
        """Begin the next episode of some plants, and return its plant numbers.

        `streams` are those of the plants. Numbers that are ranges have the shape
        (len(streams),), and the others the shape ().
        """
        if not self._uses_stream:
            return self.lowest
        draws = np.empty((len(streams), DRAWS))
        for plant_streams, row in zip(streams, draws, strict=True):
            plant_streams.plant.next_episode().random(out=row)
        numbers: dict[str, NDArray[Any]] = {}
        for name, (low, high) in self.names.items():
            share = draws[:, PLANT_NUMBERS[name]]  # from 0 to 1, 1 excluded
            if isinstance(low, int):
                numbers[name] = low + np.floor(share * (high + 1 - low)).astype(int)
            else:
                numbers[name] = low + share * (high - low)
        return replace(self.lowest, **numbers)


def plant_numbers(numbers: PlantNumbers[Values], i: int) -> PlantNumbers[float]:
    """Return the numbers of plant i as Python numbers, given those of many plants."""
    numbers_of_plant: dict[str, float] = {}
    for name, values in vars(numbers).items():
        value = values[i] if values.ndim else values
        numbers_of_plant[name] = value.item()
    return PlantNumbers(**numbers_of_plant)
