"""Choose target outputs of a plant with a delay if the set point changes at random.

A change of the flow affects the output only after the delay of the plant. If the set point may
change within the delay, the output with the least expected error lies between the present set
point and 0, which is the mean of random set points. To choose a target between the set point
and 0 is called *hedging*.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]

BISECTIONS: Final = 10  # give a target with an error of at most 2^-11 of the set point
# 1 / (1 + exp(-LOGISTIC x)) is within 0.01 of the standard normal distribution function.
LOGISTIC: Final = 1.702


@dataclass(frozen=True)
class RandomSetpoint:
    """The distribution of a set point that changes at random, for n control loops.

    The set point is piecewise constant. The values of the set point are independent and
    uniformly distributed. The number of samples between two changes is uniformly distributed.
    """

    shortest: float
    """Least number of samples between two changes of the set point."""
    longest: float
    """Greatest number of samples between two changes of the set point."""
    amplitude: float
    """Greatest value of the set point, in any unit of temperature; the least value is
    `-amplitude`."""

    def probability_held(self, ages: Array, ahead: Array) -> Array:
        """Return the probability of no set point change in the next `ahead` samples, (n,).

        Parameters
        ----------
        ages
            Number of samples since the last change of the set point, shape (n,).
        ahead
            Number of future samples for which the probability is computed, shape (n,).
        """
        # The possible durations are the whole numbers from `shortest` to `longest`, of which
        # `longest - age` are longer than an age of at least `shortest`.
        durations = self.longest - self.shortest + 1.0  # number of possible durations
        # Share of the possible durations that are longer than `ages`, and share that are longer
        # than `ages + ahead`. The least share 1e-9 prevents a division by 0.
        share_now = np.clip((self.longest - ages) / durations, 1e-9, 1.0)
        share_later = np.clip((self.longest - ages - ahead) / durations, 0.0, 1.0)
        probability: Array = share_later / share_now
        return probability

    def targets(self, setpoints: Array, held: Array, deviations: Array) -> Array:
        """Return target outputs with the least expected absolute control error, shape (n,).

        The set point keeps its present value s with the probability `held`. After a change, the
        set point is uniformly distributed between -A and A, for the amplitude A. The future
        output is the target r plus a forecast error with the standard deviation `deviations`.
        The expected absolute control error is least at the target r that solves the equation
        held tanh(LOGISTIC (r - s) / (2 deviations)) + (1 - held) r / A = 0, where s is the
        present set point, and A the amplitude. The equation assumes that the forecast error of
        the output has a logistic distribution and is small compared with the amplitude A. The
        left side of the equation rises with the target r, so r is found by bisection between 0
        and the set point s.

        Parameters
        ----------
        setpoints
            Present set points s, in the unit of `amplitude`, shape (n,).
        held
            Probabilities that the set points do not change before the present flows affect the
            outputs, shape (n,).
        deviations
            Standard deviations of the forecast errors, in the unit of `amplitude`, shape (n,).
        """
        # The factor of r - s in tanh, and the factor of r in the second term.
        slopes = 0.5 * LOGISTIC / deviations
        pulls_to_zero = (1.0 - held) / self.amplitude
        near_zero = np.zeros_like(setpoints)
        near_setpoint = setpoints
        for _ in range(BISECTIONS):
            targets = 0.5 * (near_zero + near_setpoint)
            left_side = held * np.tanh(slopes * (targets - setpoints)) + pulls_to_zero * targets
            # For a positive set point, the left side is negative below the solution.
            is_too_near_zero = left_side * np.sign(setpoints) < 0.0
            near_zero = np.where(is_too_near_zero, targets, near_zero)
            near_setpoint = np.where(is_too_near_zero, near_setpoint, targets)
        targets = 0.5 * (near_zero + near_setpoint)
        # If no change is possible, the target is the set point, without the error of bisection.
        return np.where(held >= 1.0, setpoints, targets)
