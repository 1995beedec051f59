"""Draw plant numbers, and give every episode of a plant its own place in streams of draws."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mptc_gym.parameters import PLANT_NUMBERS, Parameters, PlantNumbers

Values = NDArray[np.float64]  # one per plant, shape (n,), or one for all plants, shape ()

DRAWS = 32  # random numbers that an episode reserves for present and future plant numbers
# The state of a PCG64 that has just been created, apart from its position in the stream.
_PCG64 = {"bit_generator": "PCG64", "has_uint32": 0, "uinteger": 0}
_ANY_SEED = np.random.SeedSequence(0)  # of generators whose state is set afterwards


class EpisodeStream:
    """A stream of random numbers in which every episode has its own starting point.

    Episode j begins j * 2**64 draws into the stream, however many draws the episodes before it
    have used. So the j-th episode after a seed always gets the same draws.

    The arguments are those of the `numpy.random.SeedSequence` that starts the stream. The
    generator is created at the first episode, because many plants have streams that are never
    used.

    Attributes
    ----------
    generator : numpy.random.Generator
        The generator of the present episode.
    """

    # Without a dict per stream, the streams of 100,000 plants take little memory.
    __slots__ = ("_episode", "_origin", "_seeds", "generator")

    generator: np.random.Generator

    def __init__(self, entropy: Any, spawn_key: tuple[int, ...], pool_size: int = 4) -> None:
        self._seeds = entropy, spawn_key, pool_size
        self._episode = 0

    def __deepcopy__(self, memo: dict[int, Any]) -> EpisodeStream:
        """Return a copy at the same place in the stream, in a tenth of a plain copy's time."""
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
            # The bit generator is looked up every time, as a copied generator has another one.
            bits: Any = self.generator.bit_generator
            bits.state = {**_PCG64, "state": self._origin}
            bits.advance(self._episode << 64)
        self._episode += 1
        return self.generator


class Streams(NamedTuple):
    """All streams of one plant.

    A new stream would come last, so that the numbers of the present streams do not change.
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
    the other plant numbers do not change if one more becomes a range.

    Attributes
    ----------
    lowest : PlantNumbers
        All plant numbers, with the low end of a range, in arrays of shape ().
    """

    def __init__(self, parameters: Parameters) -> None:
        self._ranges = parameters.ranges
        # The disturbance takes random numbers from the same stream, after the random numbers of
        # the plant numbers.
        self._uses_stream = bool(self._ranges) or parameters.is_disturbed
        lowest = {name: np.array(number) for name, number in vars(parameters.lowest).items()}
        self.lowest: PlantNumbers[Values] = PlantNumbers(**lowest)

    def draw(self, streams: Sequence[Streams]) -> PlantNumbers[Values]:
        """Begin the next episode of some plants with these streams, and return their numbers.

        Numbers that are ranges have the shape (len(streams),), and the others the shape ().
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
    """Return the numbers of plant i as Python numbers, given the numbers of many plants.

    Numbers that all plants share have the shape ().
    """
    numbers_of_plant: dict[str, float] = {}
    for name, values in vars(numbers).items():
        value = values[i] if values.ndim else values
        numbers_of_plant[name] = value.item()
    return PlantNumbers(**numbers_of_plant)
