"""Estimate the gains and load disturbances of plants by Kalman filters.

Quantities are dimensionless as in `agents.bank`: flows are divided by half the flow range,
temperatures by the steady temperature change for half the flow range, and times by the sampling
interval.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from .bank import FAST_POLE, GAIN_LIMITS, GAIN_SPREAD, LIKELIHOOD_FACTOR, NOISE_COLOUR

Array = NDArray[np.floating[Any]]

# Assumptions of each of the four Kalman filters. `LOAD_CHANGES` are standard deviations of the
# change of the load disturbance per sample, in units of the steady temperature change for half
# the flow range. `NOISE_SHARES` are noise variances divided by the variance of the candidate
# models' one-step prediction errors. The last filter is for plants with hardly any noise, whose
# prediction errors come from the load disturbance.
LOAD_CHANGES: Final = np.array([0.001, 0.007, 0.03, 0.03])
NOISE_SHARES: Final = np.array([1.0, 1.0, 1.0, 0.25])
LOAD_MEMORY: Final = 0.998  # expected share of a load disturbance that remains after a sample
# Standard deviation of the gain's change per sample, divided by the prior standard deviation of
# the gain.
GAIN_CHANGE: Final = 0.016
# Forgetting factor of the log-likelihoods of the Kalman filters, per sample.
FILTER_FORGETTING: Final = 0.998
READING_SHARE: Final = 0.1  # share of the noise variance that is measurement noise

# Indices of the four elements in the state vector of a Kalman filter: the residual v(k), the
# carried term a2 v(k-1) + c xi(k) of the next residual v(k+1), the load disturbance w(k) and
# the gain g(k).
RESIDUAL, CARRIED, LOAD, GAIN = range(4)


class OutputFilter:
    """Kalman filters of n plants, with different assumptions on load disturbance and noise.

    The measured output is y(k) = g(k) s(k) + v(k) plus white measurement noise, where g is the
    plant's gain, s the mean output of the candidate models with gain 1, and v a residual. The
    residual v is the sum of the plant's noise and of the effect of a load disturbance w:

        v(k) = a1 v(k-1) + a2 v(k-2) + (1 - a1 - a2) w(k) + xi(k) + c xi(k-1)
        w(k) = LOAD_MEMORY w(k-1) + eta(k)

    The noises xi, of the output, and eta, of the load, are white. In the equation of v, the
    coefficients a1 and a2 follow from the two poles of the mean model, and c is the coefficient
    of z^-1 in the polynomial C of equation (28) of the paper. The gain g of the plant follows a
    random walk. The state vector of a Kalman filter has the four elements v(k), a2 v(k-1) + c
    xi(k), w(k) and g(k).

    The Kalman filters differ in the assumed standard deviation of load changes, eta, and in the
    assumed variances of the noise xi and of the measurement noise. The weight of a Kalman
    filter is in proportion to a power of the likelihood of its one-step prediction errors, in
    which old errors are forgotten exponentially.

    Parameters
    ----------
    n
        Number of plants.

    Attributes
    ----------
    gain : ndarray
        Estimated gain, divided by the gain that the step test measured, shape (n,).
    load : ndarray
        Estimated load disturbance w, in units of the steady temperature change for half the
        flow range, shape (n,).
    """

    def __init__(self, n: int) -> None:
        filters = len(LOAD_CHANGES)
        # At the start of an episode, load disturbance and residual are 0. Only the gain is
        # uncertain. The first axis of the states is the filter, the second the plant, and the
        # third the element of the state vector.
        self._states = np.zeros((filters, n, 4))
        self._states[:, :, GAIN] = 1.0
        self._covariances = np.zeros((filters, n, 4, 4))
        self._covariances[:, :, GAIN, GAIN] = GAIN_SPREAD**2
        self._log_likelihoods = np.zeros((filters, n))
        self._response = np.zeros(n)  # mean output s of the models at the latest sample

    def update(self, output: Array, responses: Array, poles: Array, variances: Array) -> None:
        """Update the estimates with the measured outputs; call this method once per sample.

        Parameters
        ----------
        output
            Measured outputs y(k), in units of the steady temperature change for half the flow
            range, shape (n,).
        responses
            Mean outputs s(k) and s(k-1) of the candidate models with gain 1, with the present
            probabilities of the models as weights, shape (2, n).
        poles
            Slow pole exp(-1 / T) of each plant, for the estimated time constant T in samples,
            shape (n,).
        variances
            Variances of the candidate models' one-step prediction errors, in the squared unit
            of `output`, shape (n,).
        """
        response, last_response = responses
        # `self._response` is s(k-1) with the models' probabilities at the previous sample, and
        # `last_response` is s(k-1) with their present probabilities.
        self._attribute_to_load(last_response - self._response, poles)
        self._response = response
        # Predict the states x and their covariances P of this sample from those of the previous
        # sample: F x and F P F^T + Q, for the transition matrix F and the noise covariances Q.
        # In the sums, f is the filter, n the plant, and i and j are elements of the state.
        noises = NOISE_SHARES[:, np.newaxis] * variances
        transition, disturbances = self._matrices(poles, noises)
        states = np.einsum("nij,fnj->fni", transition, self._states)
        covariances = transition @ self._covariances @ transition.transpose(0, 2, 1)
        covariances = covariances + disturbances
        # Predict the output, which is the residual plus the gain times the response: h x, for
        # the row h = (1, 0, 0, s). The cross covariances P h^T are the covariances between the
        # elements of the state and the output, and the variance of the output's prediction
        # error is h P h^T plus the variance of the measurement noise.
        of_gain = response[:, np.newaxis] * covariances[:, :, :, GAIN]
        cross_covariances = covariances[:, :, :, RESIDUAL] + of_gain
        error_variances = (
            cross_covariances[:, :, RESIDUAL] + response * cross_covariances[:, :, GAIN]
        )
        error_variances = error_variances + READING_SHARE * noises
        errors = output - states[:, :, RESIDUAL] - response * states[:, :, GAIN]
        # Correct the states by the prediction errors of the outputs. The corrections are the
        # Kalman gains.
        corrections = cross_covariances / error_variances[:, :, np.newaxis]
        self._states = states + corrections * errors[:, :, np.newaxis]
        products = corrections[:, :, :, np.newaxis] * cross_covariances[:, :, np.newaxis, :]
        self._covariances = covariances - products
        self._average(errors, error_variances)

    def forecast(self, poles: Array, fading: Array) -> Array:
        """Return forecasts of the residuals v, d + 1 samples ahead for the delay d, shape (n,).

        The residual v is the part of the output that the mean of the candidate models does not
        explain. The present flow affects the output after d + 1 samples. In d + 1 samples, the
        fast part of the residual v decays to 0, and the slow part of v moves towards the load
        disturbance, which is assumed to be constant. The forecasts are in units of the steady
        temperature change for half the flow range.

        Parameters
        ----------
        poles
            Slow pole exp(-1 / T) of each plant, for the estimated time constant T in samples,
            shape (n,).
        fading
            Share exp(-(d + 1) / T) of a slowly decaying deviation that remains after d + 1
            samples, shape (n,).
        """
        residual = self._mean_state[RESIDUAL]
        carried = self._mean_state[CARRIED]
        # Slow part of v, by partial fractions of the two poles, and the value that the slow
        # part approaches under a constant load disturbance.
        slow = (poles * residual + carried) / (poles - FAST_POLE)
        slow_of_load = self.load * poles * (1.0 - FAST_POLE) / (poles - FAST_POLE)
        forecasts: Array = self.load + fading * (slow - slow_of_load)
        return forecasts

    def _attribute_to_load(self, changes: Array, poles: Array) -> None:
        """Correct the state vectors for changes of s(k-1), the mean model's previous output.

        A change of the candidate models' probabilities also changes the part of past outputs
        that the mean model explains. The state vectors are corrected as if a constant load
        disturbance explained the change of past outputs. `changes` are the changes of s(k-1),
        in units of the steady temperature change for half the flow range, and `poles` are the
        slow poles exp(-1 / T) of the plants, both of shape (n,).
        """
        # The output y(k-1) is the residual plus the gain times s(k-1), and does not change. A
        # constant load disturbance w adds w to v(k-1) and v(k-2).
        residuals = -self._states[:, :, GAIN] * changes
        self._states[:, :, RESIDUAL] += residuals
        self._states[:, :, CARRIED] -= poles * FAST_POLE * residuals  # a2 is -poles FAST_POLE
        self._states[:, :, LOAD] += residuals

    def _matrices(self, poles: Array, noises: Array) -> tuple[Array, Array]:
        """Return the transition matrices, (n, 4, 4), and noise covariances, (filters, n, 4, 4).

        `poles` are the slow poles exp(-1 / T) of the plants, shape (n,). `noises` are the noise
        variances that the Kalman filters assume, in squared units of the steady temperature
        change for half the flow range, shape (filters, n).
        """
        n = len(poles)
        a1 = poles + FAST_POLE
        a2 = -poles * FAST_POLE
        # The equations in the docstring of the class, as a step from sample to sample: v(k)
        # is a1 v(k-1) plus the carried term, plus the effects of w(k) and xi(k). Row i of a
        # transition matrix has the factors for element i of the state vector.
        transition = np.zeros((n, 4, 4))
        transition[:, RESIDUAL, RESIDUAL] = a1
        transition[:, RESIDUAL, CARRIED] = 1.0
        transition[:, RESIDUAL, LOAD] = (1.0 - a1 - a2) * LOAD_MEMORY
        transition[:, CARRIED, RESIDUAL] = a2
        transition[:, LOAD, LOAD] = LOAD_MEMORY
        transition[:, GAIN, GAIN] = 1.0
        # Effects of the white noises xi and eta on the elements of the state vector.
        from_xi = np.array([1.0, NOISE_COLOUR[0], 0.0, 0.0])
        from_eta = np.zeros((n, 4))
        from_eta[:, RESIDUAL] = 1.0 - a1 - a2
        from_eta[:, LOAD] = 1.0
        xi_variances = (1.0 - READING_SHARE) * noises[:, :, np.newaxis, np.newaxis]
        eta_variances = np.square(LOAD_CHANGES)[:, np.newaxis, np.newaxis, np.newaxis]
        covariances = xi_variances * np.outer(from_xi, from_xi)
        covariances += eta_variances * (from_eta[:, :, np.newaxis] * from_eta[:, np.newaxis, :])
        covariances[:, :, GAIN, GAIN] += (GAIN_CHANGE * GAIN_SPREAD) ** 2
        return transition, covariances

    def _average(self, errors: Array, variances: Array) -> None:
        """Update the probabilities of the Kalman filters, and the means over the filters.

        `errors` are the one-step prediction errors of this sample, and `variances` are the
        error variances that the Kalman filters expected, both of shape (filters, n).
        """
        # -2 times the logarithm of the Gaussian likelihood, without its constant.
        losses = np.square(errors) / variances + np.log(variances)
        self._log_likelihoods *= FILTER_FORGETTING
        self._log_likelihoods -= 0.5 * LIKELIHOOD_FACTOR * losses
        # Probabilities of the filters of each plant, shape (filters, n).
        weights = np.exp(self._log_likelihoods - self._log_likelihoods.max(0))
        weights /= weights.sum(0)
        self._mean_state = np.einsum("fn,fni->in", weights, self._states)  # shape (4, n)
        self.load = self._mean_state[LOAD]
        self.gain = np.clip(self._mean_state[GAIN], *GAIN_LIMITS)
