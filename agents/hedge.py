"""Choose targets for the output where the set point is known to change at random.

A change of the flow shows in the output only after the delay. If the set point may change
within the delay, the output with the least expected error lies between the present set point
and 0, the middle of the range of set points. Aiming at such an output is called *hedging*.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]

BISECTIONS: Final = 10  # enough to find a target to 2^-10, a thousandth, of the set point
# The logistic function of LOGISTIC x is within 0.01 of the standard normal distribution of x.
LOGISTIC: Final = 1.702


@dataclass(frozen=True)
class RandomSetpoint:
    """The distribution of a set point that changes at random, for n control loops.

    The set point is piecewise constant. The values between changes, the *levels*, are uniformly
    distributed and independent. The number of samples for which a level lasts is uniformly
    distributed. Each field is a number for all loops, or an array of shape (n,).
    """

    shortest: Array | float
    """Least number of samples for which the set point keeps a level."""
    longest: Array | float
    """Greatest number of samples for which the set point keeps a level."""
    amplitude: Array | float
    """Greatest level of the set point, in the unit of the set points; the least level is
    `-amplitude`."""

    def probability_held(self, ages: Array, ahead: Array) -> Array:
        """Return the probability that the set point keeps its level for some more samples.

        Parameters
        ----------
        ages
            Number of samples since the last change of the set point, shape (n,).
        ahead
            Number of future samples for which the set point shall keep its level, shape (n,).

        Returns
        -------
        ndarray
            Shape (n,).
        """
        durations = self.longest - self.shortest + 1.0  # number of the possible durations
        # Shares of the possible durations of the level that are longer than its age, now and
        # `ahead` samples later. The least share keeps the divisor from 0.
        share_now = np.clip((self.longest - ages) / durations, 1e-9, 1.0)
        share_later = np.clip((self.longest - ages - ahead) / durations, 0.0, 1.0)
        probability: Array = share_later / share_now
        return probability

    def targets(self, setpoints: Array, held: Array, deviations: Array) -> Array:
        """Return the target outputs with the least expected absolute error, shape (n,).

        The set point keeps its value s with the probability `held`; otherwise, the next set
        point is uniformly distributed between -A and A, the amplitude. The output will differ
        from the target r by an error of the forecast with the standard deviation `deviations`.
        The expected absolute error is least at the target r for which

            held tanh(LOGISTIC (r - s) / (2 deviations)) + (1 - held) r / A = 0.

        In the equation, the error of the forecast is assumed to have a logistic distribution,
        and to be small compared with A. The left side of the equation rises with r, so
        bisection between 0 and s finds r.

        Parameters
        ----------
        setpoints
            Present set points s, in the unit of the amplitude, shape (n,).
        held
            Probabilities that the set points do not change within the delay, shape (n,).
        deviations
            Standard deviations of the forecasts' errors, in the unit of the amplitude, shape
            (n,).
        """
        slopes = 0.5 * LOGISTIC / deviations
        pulls_to_zero = (1.0 - held) / self.amplitude
        near_zero = np.zeros_like(setpoints)
        near_setpoint = setpoints
        for _ in range(BISECTIONS):
            targets = 0.5 * (near_zero + near_setpoint)
            left_side = held * np.tanh(slopes * (targets - setpoints)) + pulls_to_zero * targets
            is_too_near_zero = left_side * np.sign(setpoints) < 0.0
            near_zero = np.where(is_too_near_zero, targets, near_zero)
            near_setpoint = np.where(is_too_near_zero, near_setpoint, targets)
        targets = 0.5 * (near_zero + near_setpoint)
        return np.where(held >= 1.0, setpoints, targets)  # exact for a set point that is kept
