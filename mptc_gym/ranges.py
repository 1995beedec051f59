"""The plant numbers of an episode: as they are given, or drawn from their ranges."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mptc_gym.parameters import ARGUMENTS, DRAWS, PLANT_NUMBERS, Parameters, PlantNumbers

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
        lows = {name: float(parameters.range_of(name)[0]) for name in PLANT_NUMBERS}
        self.given: PlantNumbers[float] = PlantNumbers(**lows)
        self.given_arrays: PlantNumbers[Values] = PlantNumbers(
            **{name: np.array(low) for name, low in lows.items()}
        )
        self._places = [PLANT_NUMBERS[name] for name in self.names]
        self._lows = np.array([lows[name] for name in self.names])
        highs = np.array([float(parameters.range_of(name)[1]) for name in self.names])
        self._whole = np.array([ARGUMENTS[name].is_integer for name in self.names], np.bool_)
        self._widths = highs - self._lows + self._whole

    def draw(
        self, generators: Iterable[np.random.Generator], episodes: int
    ) -> PlantNumbers[Values]:
        """Draw for some episodes.

        Parameters
        ----------
        generators
            One an episode, at the start of it.
        episodes
            How many.

        Returns
        -------
        PlantNumbers of ndarray
            What is a range has the shape (episodes,), anything else the shape ().
        """
        draws = np.empty((episodes, DRAWS))
        for generator, row in zip(generators, draws, strict=True):
            generator.random(out=row)
        drawn = self._scaled(draws).T
        return replace(self.given_arrays, **dict(zip(self.names, drawn, strict=True)))

    def draw_one(self, generator: np.random.Generator) -> PlantNumbers[float]:
        """Draw for one episode, with its generator."""
        drawn = self._scaled(generator.random(DRAWS)).tolist()
        return replace(self.given, **dict(zip(self.names, drawn, strict=True)))

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
        **{name: float(array[i] if array.ndim else array) for name, array in arrays.items()}
    )
