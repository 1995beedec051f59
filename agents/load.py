"""Forecast the part of a plant's output that a bank of models does not explain.

This part, the *residual*, is noise and the response to a load that changes now and then.
Quantities are scaled as in `agents.bank`.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from agents.bank import CAUTION, FAST_POLE, NOISE_COLOUR

Array = NDArray[np.floating[Any]]

# Standard deviations of the change of the load in a sample, as shares of the authority. Each
# has its filter.
LOAD_CHANGES: Final = np.array([0.001, 0.007, 0.03])
LOAD_MEMORY: Final = 0.995  # share of the load that is expected to remain after a sample
FILTER_MEMORY: Final = 0.998  # factor a sample of the filters' log-likelihoods
READING_SHARE: Final = 0.1  # of the variance of one-step errors, due to noise of the readings


class LoadFilter:
    """Kalman filters of the residuals of n plants, one for each size of load changes.

    The residual v, shape (n,), is taken for noise of (28) and the response to a load w:

        v(k) = a1 v(k-1) + a2 v(k-2) + (1 - a1 - a2) w(k) + xi(k) + c xi(k-1)
        w(k) = LOAD_MEMORY w(k-1) + eta(k)

    a1 and a2 follow from the pole of the mean model, and c is the first coefficient of C. The
    state of a filter is v(k), a2 v(k-1) + c xi(k) and w(k). The filters differ in the standard
    deviation of eta, `LOAD_CHANGES`. They are weighted by the likelihood of their one-step
    errors, which they forget exponentially.

    Attributes
    ----------
    innovations : ndarray
        One-step errors of the residuals, the mean over the filters, shape (n,).
    loads : ndarray
        Estimates of the load, the mean over the filters, shape (n,).
    weights : ndarray
        Probabilities of the filters, shape (filters, n).
    """

    def __init__(self, n: int) -> None:
        filters = len(LOAD_CHANGES)
        self._states = np.zeros((filters, n, 3))
        self._covariances = np.zeros((filters, n, 3, 3))
        self._log_likelihoods = np.zeros((filters, n))
        self._residuals = np.zeros(n)
        self.weights = np.full((filters, n), 1.0 / filters)
        self.innovations = np.zeros(n)
        self.loads = np.zeros(n)

    def update(self, residuals: Array, previous: Array, poles: Array, variances: Array) -> None:
        """Learn from the residuals of a sample.

        Parameters
        ----------
        residuals, previous
            v(k) and v(k-1) by the present mean models, shape (n,).
        poles
            Poles of the mean models' time constants, shape (n,).
        variances
            Variances of the bank's one-step errors, shape (n,).
        """
        self._shift(previous - self._residuals, poles)
        self._residuals = residuals
        transition, noise = self._matrices(poles, variances)
        states = np.einsum("nij,fnj->fni", transition, self._states)
        covariances = transition @ self._covariances @ transition.transpose(0, 2, 1) + noise
        errors = residuals - states[:, :, 0]
        error_variances = covariances[:, :, 0, 0] + READING_SHARE * variances
        gains = covariances[:, :, :, 0] / error_variances[:, :, np.newaxis]
        self._states = states + gains * errors[:, :, np.newaxis]
        self._covariances = (
            covariances - gains[:, :, :, np.newaxis] * covariances[:, :, np.newaxis, 0]
        )
        self._log_likelihoods *= FILTER_MEMORY
        losses = np.square(errors) / error_variances + np.log(error_variances)
        self._log_likelihoods -= 0.5 * CAUTION * losses
        weights = np.exp(self._log_likelihoods - self._log_likelihoods.max(0))
        self.weights = weights / weights.sum(0)
        self.innovations = (self.weights * errors).sum(0)
        self._mean = np.einsum("fn,fni->in", self.weights, self._states)
        self.loads = self._mean[2]

    def forecast(self, poles: Array, fading: Array) -> Array:
        """Return the residuals that are expected when the next flows show, shape (n,).

        By then, the fast part of the residual is over, the slow part has faded by the factor
        `fading`, and the load has taken its place. The load is expected not to change.
        """
        residuals, older, loads = self._mean
        slow = (poles * residuals + older) / (poles - FAST_POLE)
        slow_of_load = loads * poles * (1.0 - FAST_POLE) / (poles - FAST_POLE)
        forecasts: Array = loads + fading * (slow - slow_of_load)
        return forecasts

    def _shift(self, changes: Array, poles: Array) -> None:
        """Take changes of the residuals that come from the mean models for changes of the load."""
        self._states[:, :, 0] += changes
        self._states[:, :, 1] -= poles * FAST_POLE * changes
        self._states[:, :, 2] += changes

    def _matrices(self, poles: Array, variances: Array) -> tuple[Array, Array]:
        """Return state transitions, (n, 3, 3), and process noise, (filters, n, 3, 3)."""
        n = len(poles)
        a1 = poles + FAST_POLE
        a2 = -poles * FAST_POLE
        transition = np.zeros((n, 3, 3))
        transition[:, 0, 0] = a1
        transition[:, 0, 1] = 1.0
        transition[:, 0, 2] = (1.0 - a1 - a2) * LOAD_MEMORY
        transition[:, 1, 0] = a2
        transition[:, 2, 2] = LOAD_MEMORY
        from_xi = np.array([1.0, NOISE_COLOUR[0], 0.0])
        from_eta = np.zeros((n, 3))
        from_eta[:, 0] = 1.0 - a1 - a2
        from_eta[:, 2] = 1.0
        of_noise = (1.0 - READING_SHARE) * variances[:, np.newaxis, np.newaxis]
        of_load = np.square(LOAD_CHANGES)[:, np.newaxis, np.newaxis, np.newaxis]
        noise = of_noise * np.outer(from_xi, from_xi)
        load = of_load * (from_eta[:, :, np.newaxis] * from_eta[:, np.newaxis, :])
        return transition, noise + load
