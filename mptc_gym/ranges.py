"""Draw the plant numbers of an episode from their ranges, or take them as given."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mptc_gym.parameters import ARGUMENTS, PLANT_NUMBERS, Parameters, PlantNumbers
from mptc_gym.signals import EpisodeStream

Values = NDArray[np.float64]  # shape (episodes,), or () where all episodes share one value
DRAWS = 32  # per episode: enough for every plant number, and for future ones


class Ranges:
    """Draw arguments that are ranges, uniformly; a delay is an integer, both ends included.

    Every plant number has its own draw, whether it is a range or not, so that one more range
    does not change the others' draws. `names` are the arguments that are ranges. `given` are
    all plant numbers, with the lower end of a range, as arrays of shape ().
    """

    def __init__(self, parameters: Parameters) -> None:
        self.names = parameters.ranges
        # The disturbance's draws follow those of the plant numbers.
        self._draws = bool(self.names) or parameters.is_disturbed
        self._ranges = {name: parameters.range_of(name) for name in self.names}
        self.given: PlantNumbers[Values] = PlantNumbers(
            **{name: np.array(parameters.range_of(name)[0]) for name in PLANT_NUMBERS}
        )

    def draw(self, streams: Sequence[EpisodeStream]) -> PlantNumbers[Values]:
        """Begin an episode of each stream, and draw its numbers.

        Drawn numbers have the shape (len(streams),), others the shape ().
        """
        if not self._draws:
            return self.given
        draws = np.empty((len(streams), DRAWS))
        for stream, row in zip(streams, draws, strict=True):
            stream.next_episode().random(out=row)
        drawn = {}
        for name, (low, high) in self._ranges.items():
            share = draws[:, PLANT_NUMBERS[name]]
            if ARGUMENTS[name].is_integer:
                drawn[name] = low + np.floor(share * (high + 1 - low)).astype(int)
            else:
                drawn[name] = low + share * (high - low)
        return replace(self.given, **drawn)


def numbers_of_plant(numbers: PlantNumbers[Values], i: int) -> PlantNumbers[float]:
    """Return the numbers of plant i of many."""
    arrays = numbers.chosen(tuple(PLANT_NUMBERS))
    return PlantNumbers(
        **{name: (array[i] if array.ndim else array).item() for name, array in arrays.items()}
    )
