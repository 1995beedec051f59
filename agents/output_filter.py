"""Estimate the gain of a plant and the load on it, and forecast its output.

Quantities are scaled as in `agents.bank`.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agents.bank import CAUTION, FAST_POLE, GAINS, NOISE_COLOUR

Array = NDArray[np.floating[Any]]

# The assumptions of each filter: the standard deviation of the change of the load in a sample,
# as a share of the authority, and the share of noise in the bank's one-step variance. The last
# filter is for plants with hardly any noise, where the bank's errors come from the load.
LOAD_CHANGES: Final = np.array([0.001, 0.007, 0.03, 0.03])
NOISE_SHARES: Final = np.array([1.0, 1.0, 1.0, 0.25])
LOAD_MEMORY: Final = 0.998  # share of the load that is expected to remain after a sample
GAIN_CHANGE: Final = 0.004  # standard deviation of the change of an uncertain gain in a sample
REFERENCE_SPREAD: Final = 0.25  # first spread of a gain that changes by `GAIN_CHANGE`
FILTER_MEMORY: Final = 0.998  # factor a sample of the filters' log-likelihoods
READING_SHARE: Final = 0.1  # of the noise variance, due to the transmitter

RESIDUAL, OLDER, LOAD, GAIN = range(4)  # the elements of the state


class OutputFilter:
    """Kalman filters of the outputs of n plants, which differ in what they assume of the load.

    The output y(k) is g(k) s(k) + v(k). s is the response of the mean model, with gain 1, to
    past flows. The residual v is noise of (28) and the response to a load w:

        v(k) = a1 v(k-1) + a2 v(k-2) + (1 - a1 - a2) w(k) + xi(k) + c xi(k-1)
        w(k) = LOAD_MEMORY w(k-1) + eta(k)

    a1 and a2 follow from the pole of the mean model, and c is the first coefficient of C. The
    gain g changes by a random walk. The state of a filter is v(k), a2 v(k-1) + c xi(k), w(k)
    and g(k). The filters differ in the standard deviation of eta and in the variance of xi. The
    filters are weighted by the likelihood of their one-step errors, and forget exponentially.

    Parameters
    ----------
    gain_spread
        Standard deviation of the gain before the first sample, as a share of the step test's,
        shape (n,). The gain changes in proportion to it.

    Attributes
    ----------
    gain, gain_spread : ndarray
        Mean and standard deviation of the gain, as multiples of the step test's, shape (n,).
    load : ndarray
        Mean of the load w, of the authority, shape (n,).
    innovation : ndarray
        Newest one-step error of the output, mean over the filters, shape (n,).
    weights : ndarray
        Probabilities of the filters, shape (filters, n).
    """

    def __init__(self, gain_spread: ArrayLike) -> None:
        spread = np.asarray(gain_spread, np.float64)
        n = len(spread)
        filters = len(LOAD_CHANGES)
        self._states = np.zeros((filters, n, 4))
        self._states[:, :, GAIN] = 1.0
        self._covariances = np.zeros((filters, n, 4, 4))
        self._covariances[:, :, GAIN, GAIN] = np.square(spread)
        self._gain_changes = np.square(GAIN_CHANGE * spread / REFERENCE_SPREAD)
        self._log_likelihoods = np.zeros((filters, n))
        self._response = np.zeros(n)
        self.weights = np.full((filters, n), 1.0 / filters)
        self.innovation = np.zeros(n)
        self._summarise()

    def update(self, output: Array, responses: Array, poles: Array, variances: Array) -> None:
        """Learn from the outputs of a sample.

        Parameters
        ----------
        output
            y(k), shape (n,).
        responses
            s(k) and s(k-1) of the present mean models, shape (2, n).
        poles
            Poles of the mean models' time constants, shape (n,).
        variances
            Variances of the bank's one-step errors, shape (n,).
        """
        response, previous = responses
        self._follow(previous - self._response, poles)
        self._response = response
        noises = NOISE_SHARES[:, np.newaxis] * variances
        transition, disturbances = self._matrices(poles, noises)
        states = np.einsum("nij,fnj->fni", transition, self._states)
        covariances = transition @ self._covariances @ transition.transpose(0, 2, 1)
        covariances = covariances + disturbances
        # The output is the residual and the gain times the response.
        of_gain = response[:, np.newaxis] * covariances[:, :, :, GAIN]
        effects = covariances[:, :, :, RESIDUAL] + of_gain
        error_variances = effects[:, :, RESIDUAL] + response * effects[:, :, GAIN]
        error_variances = error_variances + READING_SHARE * noises
        errors = output - states[:, :, RESIDUAL] - response * states[:, :, GAIN]
        corrections = effects / error_variances[:, :, np.newaxis]
        self._states = states + corrections * errors[:, :, np.newaxis]
        self._covariances = covariances - (
            corrections[:, :, :, np.newaxis] * effects[:, :, np.newaxis, :]
        )
        self._weigh(errors, error_variances)
        self._summarise()

    def forecast(self, poles: Array, fading: Array) -> Array:
        """Return the residuals that are expected when the next flows show, shape (n,).

        By then, the fast part of the residual is over, the slow part has faded by the factor
        `fading`, and the load has taken its place. The load is expected not to change.
        """
        slow = (poles * self._mean[RESIDUAL] + self._mean[OLDER]) / (poles - FAST_POLE)
        slow_of_load = self.load * poles * (1.0 - FAST_POLE) / (poles - FAST_POLE)
        forecasts: Array = self.load + fading * (slow - slow_of_load)
        return forecasts

    def _follow(self, changes: Array, poles: Array) -> None:
        """Keep the outputs where the mean models, and so the responses, have changed.

        What the new models explain less is taken for a load that has lasted for long.
        """
        residuals = -self._states[:, :, GAIN] * changes
        self._states[:, :, RESIDUAL] += residuals
        self._states[:, :, OLDER] -= poles * FAST_POLE * residuals
        self._states[:, :, LOAD] += residuals

    def _matrices(self, poles: Array, noises: Array) -> tuple[Array, Array]:
        """Return the state transitions and the covariances of the disturbances of a sample.

        `noises` are the noise variances that the filters assume, shape (filters, n). The
        transitions have the shape (n, 4, 4), and the covariances (filters, n, 4, 4).
        """
        n = len(poles)
        a1 = poles + FAST_POLE
        a2 = -poles * FAST_POLE
        transition = np.zeros((n, 4, 4))
        transition[:, RESIDUAL, RESIDUAL] = a1
        transition[:, RESIDUAL, OLDER] = 1.0
        transition[:, RESIDUAL, LOAD] = (1.0 - a1 - a2) * LOAD_MEMORY
        transition[:, OLDER, RESIDUAL] = a2
        transition[:, LOAD, LOAD] = LOAD_MEMORY
        transition[:, GAIN, GAIN] = 1.0
        from_xi = np.array([1.0, NOISE_COLOUR[0], 0.0, 0.0])
        from_eta = np.zeros((n, 4))
        from_eta[:, RESIDUAL] = 1.0 - a1 - a2
        from_eta[:, LOAD] = 1.0
        of_xi = (1.0 - READING_SHARE) * noises[:, :, np.newaxis, np.newaxis]
        of_eta = np.square(LOAD_CHANGES)[:, np.newaxis, np.newaxis, np.newaxis]
        covariances = of_xi * np.outer(from_xi, from_xi)
        covariances += of_eta * (from_eta[:, :, np.newaxis] * from_eta[:, np.newaxis, :])
        covariances[:, :, GAIN, GAIN] += self._gain_changes
        return transition, covariances

    def _weigh(self, errors: Array, variances: Array) -> None:
        """Renew the filters' probabilities by their one-step errors, shape (filters, n)."""
        self._log_likelihoods *= FILTER_MEMORY
        losses = np.square(errors) / variances + np.log(variances)
        self._log_likelihoods -= 0.5 * CAUTION * losses
        weights = np.exp(self._log_likelihoods - self._log_likelihoods.max(0))
        self.weights = weights / weights.sum(0)
        self.innovation = (self.weights * errors).sum(0)

    def _summarise(self) -> None:
        """Renew the means over the filters."""
        self._mean = np.einsum("fn,fni->in", self.weights, self._states)
        self.load = self._mean[LOAD]
        self.gain = np.clip(self._mean[GAIN], *GAINS)
        variance = (self.weights * self._covariances[:, :, GAIN, GAIN]).sum(0)
        self.gain_spread = np.sqrt(np.maximum(variance, 0.0))
