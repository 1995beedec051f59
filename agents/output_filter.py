"""Estimate a plant's gain and load disturbance by Kalman filters, and forecast its output.

Quantities are scaled as in `agents.bank`: flows by half the actuator's range, temperatures by
the authority, and times by the sampling interval.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agents.bank import FAST_POLE, GAIN_LIMITS, LIKELIHOOD_FACTOR, NOISE_COLOUR

Array = NDArray[np.floating[Any]]

# Each of the four filters assumes a standard deviation of the change of the load per sample, as
# a share of the authority (`LOAD_CHANGES`), and a noise variance, as a share of the variance of
# the bank's one-step errors (`NOISE_SHARES`). The last filter is for plants with hardly any
# noise, where the bank's one-step errors come from the load.
LOAD_CHANGES: Final = np.array([0.001, 0.007, 0.03, 0.03])
NOISE_SHARES: Final = np.array([1.0, 1.0, 1.0, 0.25])
LOAD_MEMORY: Final = 0.998  # share of the load that is expected to remain after a sample
# Standard deviation of the change of the gain per sample, divided by the standard deviation of
# the gain before the first sample.
GAIN_CHANGE: Final = 0.016
# Forgetting factor of the filters' log-likelihoods, per sample.
FILTER_FORGETTING: Final = 0.998
READING_SHARE: Final = 0.1  # share of the noise variance that is noise of the transmitter

# Indices in the state of a filter: the residual v(k), the part of v(k+1) that is carried over
# from the last sample, the load w(k) and the gain g(k). See `OutputFilter`.
RESIDUAL, CARRIED, LOAD, GAIN = range(4)


class OutputFilter:
    """Kalman filters of the outputs of n plants, with different assumptions on load and noise.

    The output is y(k) = g(k) s(k) + v(k), where g is the plant's gain, and s the output of the
    bank's mean model with gain 1 for the past flows. The residual v is the sum of noise and of
    the effect of a load disturbance w:

        v(k) = a1 v(k-1) + a2 v(k-2) + (1 - a1 - a2) w(k) + xi(k) + c xi(k-1)
        w(k) = LOAD_MEMORY w(k-1) + eta(k)

    The noises xi and eta are white. The coefficients a1 and a2 follow from the poles of the
    mean model, and c is the coefficient of z^-1 in the polynomial C of equation (28) of the
    paper. The gain g changes by a random walk. The state of a filter has four elements: v(k),
    a2 v(k-1) + c xi(k), w(k) and g(k). The filters differ in the standard deviation of eta and
    in the variance of xi. The weight of a filter is the likelihood of its one-step errors,
    which forgets old errors exponentially.

    Parameters
    ----------
    gain_spread
        Standard deviation of the gain before the first sample, as a share of the step test's
        gain, shape (n,). The larger `gain_spread`, the faster the gain may change.

    Attributes
    ----------
    gain, gain_spread : ndarray
        Mean and standard deviation of the gain, as multiples of the step test's gain, shape
        (n,).
    load : ndarray
        Mean of the load w, in units of the authority, shape (n,).
    innovation : ndarray
        Newest one-step error of the output, mean over the filters, in units of the authority,
        shape (n,).
    weights : ndarray
        Probabilities of the filters, shape (filters, n).
    """

    def __init__(self, gain_spread: ArrayLike) -> None:
        spread = np.asarray(gain_spread, np.float64)
        n = len(spread)
        filters = len(LOAD_CHANGES)
        # At the start, load and residual are known to be 0, and the gain is that of the step
        # test with an uncertainty.
        self._states = np.zeros((filters, n, 4))
        self._states[:, :, GAIN] = 1.0
        self._covariances = np.zeros((filters, n, 4, 4))
        self._covariances[:, :, GAIN, GAIN] = np.square(spread)
        self._gain_changes = np.square(GAIN_CHANGE * spread)
        self._log_likelihoods = np.zeros((filters, n))
        self._response = np.zeros(n)

    def update(self, output: Array, responses: Array, poles: Array, variances: Array) -> None:
        """Update all filters with the outputs of a sample; call this method once per sample.

        Parameters
        ----------
        output
            Measured outputs y(k), in units of the authority (see `agents.bank`), shape (n,).
        responses
            Outputs s(k) and s(k-1) of the bank's present mean models with gain 1, shape (2, n).
        poles
            Slow poles of the mean models, exp(-1 / T) for a time constant of T samples, shape
            (n,).
        variances
            Variances of the bank's one-step errors, in units of the authority squared, shape
            (n,).
        """
        # The bank may have changed the mean model since the last sample.
        response, last_response = responses
        self._attribute_to_load(last_response - self._response, poles)
        self._response = response
        # Predict the states of this sample from the states of the last sample.
        noises = NOISE_SHARES[:, np.newaxis] * variances
        transition, disturbances = self._matrices(poles, noises)
        states = np.einsum("nij,fnj->fni", transition, self._states)
        covariances = transition @ self._covariances @ transition.transpose(0, 2, 1)
        covariances = covariances + disturbances
        # Predict the output: the sum of the residual and of gain times response. The cross
        # covariances are the covariances between the states and the output.
        of_gain = response[:, np.newaxis] * covariances[:, :, :, GAIN]
        cross_covariances = covariances[:, :, :, RESIDUAL] + of_gain
        error_variances = (
            cross_covariances[:, :, RESIDUAL] + response * cross_covariances[:, :, GAIN]
        )
        error_variances = error_variances + READING_SHARE * noises
        errors = output - states[:, :, RESIDUAL] - response * states[:, :, GAIN]
        # Correct the states by the errors of the predicted outputs.
        corrections = cross_covariances / error_variances[:, :, np.newaxis]
        self._states = states + corrections * errors[:, :, np.newaxis]
        products = corrections[:, :, :, np.newaxis] * cross_covariances[:, :, np.newaxis, :]
        self._covariances = covariances - products
        self._average(errors, error_variances)

    def forecast(self, poles: Array, fading: Array) -> Array:
        """Return forecasts of the residuals v for the time when the present flows show.

        The residual v is the part of the output that the bank's mean model does not explain. In
        d + 1 samples, for the delay d, the fast part of v decays to 0, and the slow part of v
        moves from its present value to the load. The load is expected not to change. The
        forecasts are in units of the authority (see `agents.bank`), shape (n,).

        Parameters
        ----------
        poles
            Slow poles of the mean models, exp(-1 / T) for a time constant of T samples, shape
            (n,).
        fading
            Share of the distance between the slow part and the load that remains after d + 1
            samples, shape (n,).
        """
        residual = self._mean_state[RESIDUAL]
        carried = self._mean_state[CARRIED]
        # The slow part of v, from the partial fractions of the two poles, and its value after a
        # long time with the present load.
        slow = (poles * residual + carried) / (poles - FAST_POLE)
        slow_of_load = self.load * poles * (1.0 - FAST_POLE) / (poles - FAST_POLE)
        forecasts: Array = self.load + fading * (slow - slow_of_load)
        return forecasts

    def _attribute_to_load(self, changes: Array, poles: Array) -> None:
        """Attribute a change of the mean model's past output to a load, in all states.

        The probabilities of the bank's models change with time, and then the mean model
        explains more or less of a past output. The states change as if a constant load
        explained the difference. `changes` are the changes of s(k-1) in units of the authority,
        and `poles` the slow poles of the mean models, both of shape (n,).
        """
        residuals = -self._states[:, :, GAIN] * changes
        self._states[:, :, RESIDUAL] += residuals
        self._states[:, :, CARRIED] -= poles * FAST_POLE * residuals
        self._states[:, :, LOAD] += residuals

    def _matrices(self, poles: Array, noises: Array) -> tuple[Array, Array]:
        """Return the transition matrices and the noise covariances of the filters' states.

        Parameters
        ----------
        poles
            Slow poles of the mean models, exp(-1 / T) for a time constant of T samples, shape
            (n,).
        noises
            Noise variances that the filters assume, in units of the authority squared, shape
            (filters, n).

        Returns
        -------
        transition : ndarray
            State transition matrices, shape (n, 4, 4).
        covariances : ndarray
            Covariances of the noise that enters the states, shape (filters, n, 4, 4).
        """
        n = len(poles)
        a1 = poles + FAST_POLE
        a2 = -poles * FAST_POLE
        # Row i of a transition matrix has the factors from which element i of a state follows.
        transition = np.zeros((n, 4, 4))
        transition[:, RESIDUAL, RESIDUAL] = a1
        transition[:, RESIDUAL, CARRIED] = 1.0
        transition[:, RESIDUAL, LOAD] = (1.0 - a1 - a2) * LOAD_MEMORY
        transition[:, CARRIED, RESIDUAL] = a2
        transition[:, LOAD, LOAD] = LOAD_MEMORY
        transition[:, GAIN, GAIN] = 1.0
        # The effects of the noises xi and eta on the elements of a state.
        from_xi = np.array([1.0, NOISE_COLOUR[0], 0.0, 0.0])
        from_eta = np.zeros((n, 4))
        from_eta[:, RESIDUAL] = 1.0 - a1 - a2
        from_eta[:, LOAD] = 1.0
        xi_variances = (1.0 - READING_SHARE) * noises[:, :, np.newaxis, np.newaxis]
        eta_variances = np.square(LOAD_CHANGES)[:, np.newaxis, np.newaxis, np.newaxis]
        covariances = xi_variances * np.outer(from_xi, from_xi)
        covariances += eta_variances * (from_eta[:, :, np.newaxis] * from_eta[:, np.newaxis, :])
        covariances[:, :, GAIN, GAIN] += self._gain_changes
        return transition, covariances

    def _average(self, errors: Array, variances: Array) -> None:
        """Update the probabilities of the filters, and the means over the filters.

        `errors` are the filters' one-step errors at this sample, in units of the authority, and
        `variances` the variances that the filters expected, both of shape (filters, n).
        """
        losses = np.square(errors) / variances + np.log(variances)
        self._log_likelihoods *= FILTER_FORGETTING
        self._log_likelihoods -= 0.5 * LIKELIHOOD_FACTOR * losses
        weights = np.exp(self._log_likelihoods - self._log_likelihoods.max(0))
        self.weights = weights / weights.sum(0)
        self.innovation = (self.weights * errors).sum(0)
        self._mean_state = np.einsum("fn,fni->in", self.weights, self._states)
        self.load = self._mean_state[LOAD]
        self.gain = np.clip(self._mean_state[GAIN], *GAIN_LIMITS)
        variance = (self.weights * self._covariances[:, :, GAIN, GAIN]).sum(0)
        self.gain_spread = np.sqrt(np.maximum(variance, 0.0))
