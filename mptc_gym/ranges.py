"""Draw the plant numbers of an episode from their ranges, or take them as they are given."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mptc_gym.parameters import ARGUMENTS, DRAWS, PLANT_NUMBERS, Parameters, PlantNumbers
from mptc_gym.signals import EpisodeStream

Values = NDArray[np.float64]  # of shape (episodes,), or () where all episodes have the same


class Ranges:
    """Draws what is given as a range, uniformly; a delay is an integer, both ends included.

    Every plant number has a draw of its own, whether it is a range or not. So one more range
    changes nothing in what the others give.

    Parameters
    ----------
    parameters
        Uses the plant numbers.

    Attributes
    ----------
    names : tuple of str
        The arguments that are ranges.
    given : PlantNumbers of float
        All plant numbers, with the lower end of a range.
    given_arrays : PlantNumbers of ndarray
        The same as arrays of shape ().
    """

    def __init__(self, parameters: Parameters) -> None:
        self.names = parameters.ranges
        # The disturbance's draws follow those of the plant numbers.
        self._draws = bool(self.names) or parameters.is_disturbed
        lows = {name: parameters.range_of(name)[0] for name in PLANT_NUMBERS}
        self.given: PlantNumbers[float] = PlantNumbers(**lows)
        self.given_arrays: PlantNumbers[Values] = PlantNumbers(
            **{name: np.array(low) for name, low in lows.items()}
        )
        self._places = [PLANT_NUMBERS[name] for name in self.names]
        self._lows = np.array([lows[name] for name in self.names], float)
        highs = np.array([parameters.range_of(name)[1] for name in self.names], float)
        self._types = [int if ARGUMENTS[name].is_integer else float for name in self.names]
        self._whole = np.array([each is int for each in self._types], np.bool_)
        self._widths = highs - self._lows + self._whole

    def draw(self, streams: Sequence[EpisodeStream]) -> PlantNumbers[Values]:
        """Begin an episode of each stream, and draw its numbers.

        Returns
        -------
        PlantNumbers of ndarray
            What is a range has the shape (len(streams),), anything else the shape ().
        """
        if not self._draws:
            return self.given_arrays
        draws = np.empty((len(streams), DRAWS))
        for stream, row in zip(streams, draws, strict=True):
            stream.next_episode().random(out=row)
        drawn = zip(self.names, self._types, self._scaled(draws).T, strict=True)
        return replace(
            self.given_arrays, **{name: values.astype(type_) for name, type_, values in drawn}
        )

    def draw_one(self, stream: EpisodeStream) -> PlantNumbers[float]:
        """Begin an episode of a stream, and draw its numbers."""
        if not self._draws:
            return self.given
        drawn = self._scaled(stream.next_episode().random(DRAWS)).tolist()
        numbers = zip(self.names, self._types, drawn, strict=True)
        return replace(self.given, **{name: type_(value) for name, type_, value in numbers})

    def _scaled(self, draws: Values) -> Values:
        """Bring draws of all plant numbers, from 0 to 1, to the ranges: shape (..., ranges)."""
        offsets: Values = draws[..., self._places] * self._widths
        offsets[..., self._whole] = np.floor(offsets[..., self._whole])
        offsets += self._lows
        return offsets


def numbers_of_plant(numbers: PlantNumbers[Values], i: int) -> PlantNumbers[float]:
    """Return the numbers of the i-th of many plants."""
    arrays = numbers.chosen(tuple(PLANT_NUMBERS))
    return PlantNumbers(
        **{name: (array[i] if array.ndim else array).item() for name, array in arrays.items()}
    )
