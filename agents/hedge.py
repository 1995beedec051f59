"""Hedge set points that are known to change at random.

A flow shows only after the delay. If the set point may have changed by then, the output with
the least expected error lies between the set point and the middle of its range.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]

BISECTIONS: Final = 10  # which find a target to a thousandth of the set point
LOGISTIC: Final = 1.702  # scale of the logistic distribution that is next to the normal one


@dataclass(frozen=True)
class RandomSetpoint:
    """A set point with levels that are uniform, and held for a time that is uniform, too.

    The fields are those of n loops, numbers or arrays of shape (n,). The amplitude has the unit
    of the set points.
    """

    shortest: Array | float
    """Least number of samples for which a level is held."""
    longest: Array | float
    """Greatest number of samples for which a level is held."""
    amplitude: Array | float
    """Greatest level; the least one is its negative."""

    def probability_held(self, ages: Array, ahead: Array) -> Array:
        """Return the probability that a level still holds `ahead` samples later, shape (n,).

        `ages` are the samples since the level began. Both have the shape (n,).
        """
        lengths = self.longest - self.shortest + 1.0
        later = np.clip((self.longest - ages - ahead) / lengths, 0.0, 1.0)
        present = np.clip((self.longest - ages) / lengths, 1e-9, 1.0)
        probability: Array = later / present
        return probability

    def targets(self, setpoints: Array, held: Array, deviations: Array) -> Array:
        """Return the outputs to aim at, with the least expected absolute error, shape (n,).

        The set point s stays with the probability `held`; otherwise a new one is uniform
        between -A and A, the amplitude. The output will differ from the target r by an error of
        the forecast, whose standard deviation is `deviations`. The best r is a median, at which

            held tanh(LOGISTIC (r - s) / (2 deviation)) + (1 - held) r / A = 0.

        This takes the error of the forecast for logistic, and small beside A. The left side
        rises with r, so bisection between 0 and s finds r.

        Parameters
        ----------
        setpoints, deviations
            Present set points, and standard deviations of the forecasts' errors, in the unit of
            the amplitude, shape (n,).
        held
            Probabilities that the set points stay, shape (n,).
        """
        slopes = 0.5 * LOGISTIC / deviations
        pulls = (1.0 - held) / self.amplitude
        near_zero = np.zeros_like(setpoints)
        near_setpoint = setpoints
        for _ in range(BISECTIONS):
            targets = 0.5 * (near_zero + near_setpoint)
            balance = held * np.tanh(slopes * (targets - setpoints)) + pulls * targets
            is_too_near_zero = balance * np.sign(setpoints) < 0.0
            near_zero = np.where(is_too_near_zero, targets, near_zero)
            near_setpoint = np.where(is_too_near_zero, near_setpoint, targets)
        return np.where(held >= 1.0, setpoints, 0.5 * (near_zero + near_setpoint))
