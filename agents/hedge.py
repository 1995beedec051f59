"""Hedge set points that are known to change at random.

A flow shows only after the delay. If the set point may have changed by then, the output with
the least expected error lies between the set point and the middle of its range.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.floating[Any]]

BISECTIONS: Final = 10  # which find a target to a thousandth of the set point
LOGISTIC: Final = 1.702  # scale of the logistic distribution that is next to the normal one


@dataclass(frozen=True)
class RandomSetpoint:
    """A set point with levels that are uniform, and held for a time that is uniform, too.

    All fields are numbers, or arrays of shape (n,). The amplitude has the unit of the set
    points.
    """

    shortest: ArrayLike
    """Least number of samples for which a level is held."""
    longest: ArrayLike
    """Greatest number of samples for which a level is held."""
    amplitude: ArrayLike
    """Greatest level; the least one is its negative."""

    def probability_held(self, ages: Array, ahead: ArrayLike) -> Array:
        """Return the probability that levels still hold some samples later.

        `ages` are the samples since the levels began, and `ahead` those until later.
        """
        lengths = np.subtract(self.longest, self.shortest) + 1.0
        then = np.clip((self.longest - ages - ahead) / lengths, 0.0, 1.0)
        present = np.clip((self.longest - ages) / lengths, 1e-9, 1.0)
        return np.asarray(then / present)

    def targets(self, setpoints: Array, held: ArrayLike, deviations: ArrayLike) -> Array:
        """Return the outputs to aim at, with the least expected absolute error.

        With the probability `held` the set point s stays; otherwise a new one is uniform within
        the amplitude A. The output will be the target r and an error of the forecast with the
        standard deviation `deviations`, in the unit of the set points. The best r is a median:

            held tanh(LOGISTIC (r - s) / (2 deviation)) + (1 - held) r / A = 0.

        The error is taken for logistic, and as small beside A. The left side rises with r.
        """
        near = np.zeros_like(setpoints)  # of 0
        far = setpoints
        slopes = 0.5 * LOGISTIC / np.asarray(deviations)
        pulls = (1.0 - np.asarray(held)) / np.asarray(self.amplitude)
        for _ in range(BISECTIONS):
            targets = 0.5 * (near + far)
            balance = held * np.tanh(slopes * (targets - setpoints)) + pulls * targets
            is_near = balance * np.sign(setpoints) < 0.0
            near = np.where(is_near, targets, near)
            far = np.where(is_near, far, targets)
        return np.where(np.asarray(held) >= 1.0, setpoints, 0.5 * (near + far))
