"""The plant numbers of an episode: as they are given, or drawn from their ranges."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from mptc_gym.parameters import PLANT_NUMBERS, Parameters

_DRAWS = 32  # an episode: enough for every plant number, and for those to come


class Ranges:
    """Draws what is given as a range, uniformly; a delay is an integer, both ends included.

    Every plant number has a draw of its own, whether it is a range or not. So one more range
    changes nothing in what the others give.

    Parameters
    ----------
    parameters
        Uses the arguments named in `PLANT_NUMBERS`.

    Attributes
    ----------
    names : tuple of str
        The arguments that are ranges.
    given : dict of str to float
        All plant numbers, with the lower end of a range.
    """

    def __init__(self, parameters: Parameters) -> None:
        self.names = parameters.ranges
        self.given = {name: float(parameters.range_of(name)[0]) for name in PLANT_NUMBERS}
        self._places = [PLANT_NUMBERS.index(name) for name in self.names]
        self._lows = np.array([self.given[name] for name in self.names])
        highs = np.array([float(parameters.range_of(name)[1]) for name in self.names])
        self._whole = np.array([name == "delay" for name in self.names], np.bool_)
        self._widths = highs - self._lows + self._whole

    def draw(
        self, generators: Iterable[np.random.Generator], episodes: int
    ) -> dict[str, NDArray[np.float64]]:
        """Draw for some episodes.

        Parameters
        ----------
        generators
            One an episode, at the start of it.
        episodes
            How many.

        Returns
        -------
        dict
            What is a range, each of shape (episodes,).
        """
        draws = np.empty((episodes, _DRAWS))
        for generator, row in zip(generators, draws, strict=True):
            generator.random(out=row)
        offsets = draws[:, self._places] * self._widths
        offsets[:, self._whole] = np.floor(offsets[:, self._whole])
        return dict(zip(self.names, (self._lows + offsets).T, strict=True))
