"""Estimate delay, time constant, gain and load of n plants with one linear filter.

All quantities are dimensionless, so that the same settings suit any plant. Flows are divided by
half the flow range, (u_max - u_min) / 2, temperatures by the steady temperature change that
half the flow range causes according to the step test, and times by the interval between two
changes of the command. A positive dimensionless flow raises the temperature.

Plant
-----

The symbols are those of `mptc_gym.MiddlePointEnv`: temperature y, applied flow u_a, load w,
white noise xi, delay d, and polynomials A, B and C in the backward shift z^-1. Divide equation
(28) of the paper, with a load disturbance, by A:

    (a)  y(k) = g s(k-d) + r(k)
    (b)  A(z^-1) s(k) = B(z^-1) u_a(k)
    (c)  A(z^-1) r(k) = C(z^-1) xi(k) + A(1) w(k)
    (d)  w(k) = LOAD_MEMORY w(k-1) + eta(k)

The response s is the output of a model with gain 1 and without delay. The applied flows
determine s exactly. The gain g is unknown. The residual r is the part of the temperature that
does not depend on the flows. White noise eta changes the load. The polynomials are

    A(z^-1) = (1 - exp(-1/T) z^-1) (1 - FAST_POLE z^-1) = 1 - a1 z^-1 - a2 z^-2
    B(z^-1) = b1 z^-1 + b2 z^-2, with b1 + b2 = A(1), so that the gain of (b) is 1
    C(z^-1) = 1 + c1 z^-1

with an unknown time constant T. The other constants are those of the paper's plant. The noise
of the transmitter is not modelled.

Filter
------

Equations (c) and (d) are those of a state x = (r(k), a2 r(k-1) + c1 xi(k), w(k)):

    (e)  x(k) = F x(k-1) + G (xi(k), eta(k)),    r(k) = h x(k),    h = (1, 0, 0)

If the residual r were measured, the steady-state Kalman filter would estimate the state by

    (f)  nu_r(k) = r(k) - h F x_r(k-1)
    (g)  x_r(k) = F x_r(k-1) + K nu_r(k)

The innovations nu_r(k) are independent. As h K is 1, (f) and (g) give

    (h)  r(k+j) = h F^j x_r(k) + the sum of h F^i K nu_r(k+j-i) over i = 0, ..., j-1

which is a forecast of the residual, and the error of the forecast.

The residual is not measured, but by (a), r is y minus g times the delayed s, and y and s are
known. The filter is linear and does not change with time. So the filter of r is the filter of y
minus g times the delayed filter of s:

    (i)  nu_r(k) = nu_y(k) - g nu_s(k-d)
    (j)  x_r(k) = x_y(k) - g x_s(k-d)

Therefore y and s are filtered once, for all gains and delays.

Estimates
---------

Each combination of a delay d, a time constant T, and a standard deviation of eta relative to xi
is a *candidate*. For the true candidate, the innovations nu_r have the variance S sigma^2,
where the candidate determines S, and sigma^2 is the unknown variance of xi. The gain g of a
candidate has a normal prior with mean 1 and standard deviation GAIN_SPREAD. So, up to a
constant, the logarithm of the posterior probability of a candidate with the gain g is

    (k)  ln(prior) - (E / sigma^2 + N ln(S)) / 2
    (l)  E = (sum of nu_r(k)^2 / S) + (g - 1)^2 sigma^2 / GAIN_SPREAD^2

with sums over the N samples so far. By (i), E is a quadratic function of g, whose coefficients
are sums of nu_y^2, nu_y nu_s and nu_s^2. The estimated gain of a candidate minimises E, and all
other estimates are means over the candidates with their posterior probabilities as weights.
Such a mean over several Kalman filters is due to Magill, "Optimal adaptive estimation of
sampled stochastic processes", IEEE Transactions on Automatic Control 10, 1965, 434-439.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Constants of the paper's plant, equation (28).
FAST_POLE: Final = -0.4997  # the faster of the two poles, the roots of the polynomial A
NEWER_SHARE: Final = 0.9186  # first coefficient of the polynomial B divided by the sum of both
NOISE_COLOUR: Final = -0.3574  # c1, the coefficient of z^-1 in the polynomial C

# The following settings were chosen by hand, for small control errors on random plants.
# Standard deviations of eta, as multiples of the standard deviation of xi.
LOAD_CHANGES: Final = (0.05, 0.2)
LOAD_MEMORY: Final = 0.998  # share of a load that remains after a sample
GAIN_SPREAD: Final = 0.25  # prior standard deviation of the gain
GAIN_LIMITS: Final = (0.3, 3.0)  # least and greatest gain
# Factor of log-likelihoods, below 1 because successive innovations of a wrong candidate are
# correlated.
LIKELIHOOD_FACTOR: Final = 0.5
FIRST_NOISE: Final = 0.07  # expected standard deviation of xi before the first sample
FIRST_NOISE_SAMPLES: Final = 30.0  # number of samples that `FIRST_NOISE` is worth
# Least standard deviation of xi. Smaller innovations would come from the low order of the
# models, not from noise.
LEAST_NOISE: Final = 0.003
# Least value of ln(P / Q), for a candidate's probability P and the greatest probability Q. Such
# a candidate no longer matters, and much lower values would make exp slow (subnormal numbers).
LEAST_LOGARITHM: Final = -30.0
# Greatest change of a covariance in the last iteration of the Riccati equation.
RICCATI_TOLERANCE: Final = 1e-10


class Candidates:
    """The candidates for a plant, with the filter and the forecasts of each candidate.

    A filter belongs to each pair of a time constant and an element of `LOAD_CHANGES`. The
    attributes do not change with time, and suit any number of plants.

    Parameters
    ----------
    time_constants
        Candidate time constants T, shape (time constants,).
    delays
        Candidate delays d, samples, in rising order, shape (delays,).
    log_priors
        Logarithms of the prior probabilities of delays and time constants, shape (delays, time
        constants). The probabilities need not sum to 1.

    Attributes
    ----------
    delays : ndarray
        Candidate delays d, samples, shape (delays,).
    log_constants : ndarray
        ln(T) of each filter, shape (filters, 1).
    log_priors : ndarray
        Logarithms of the prior probabilities of the candidates, shape (delays, filters, 1).
    a1, a2, b1, b2 : ndarray
        Coefficients of the polynomials A and B of each filter, shape (filters, 1).
    F, K : ndarray
        Matrices of (f) and (g), shapes (filters, 3, 3) and (filters, 3, 1).
    S : ndarray
        Variance of the innovations nu_r for a variance of 1 of xi, shape (filters, 1).
    to_forecast : ndarray
        Rows h F^(d+1), which forecast the residual d + 1 samples ahead, shape (delays, filters,
        1, 3).
    forecast_variances : ndarray
        Variances of the errors of these forecasts for a variance of 1 of xi, shape (delays,
        filters).
    """

    def __init__(
        self, time_constants: Array, delays: NDArray[np.intp], log_priors: Array
    ) -> None:
        loads = len(LOAD_CHANGES)
        T = np.repeat(time_constants, loads)
        load_changes = np.tile(LOAD_CHANGES, len(time_constants))
        self.delays = delays
        self.log_constants = np.log(T)[:, np.newaxis]
        # All load changes are equally likely.
        self.log_priors = np.repeat(log_priors, loads, axis=1)[:, :, np.newaxis]

        pole = np.exp(-1.0 / T)
        a1 = pole + FAST_POLE
        a2 = -pole * FAST_POLE
        A_of_1 = 1.0 - a1 - a2
        b1 = NEWER_SHARE * A_of_1
        b2 = A_of_1 - b1
        self.a1, self.a2, self.b1, self.b2 = np.array([a1, a2, b1, b2])[:, :, np.newaxis]

        # (e), by (c) and (d): r(k) = a1 r(k-1) + (a2 r(k-2) + c1 xi(k-1)) + A(1) w(k) + xi(k)
        F = np.zeros((len(T), 3, 3))
        F[:, 0, 0] = a1
        F[:, 0, 1] = 1.0
        F[:, 0, 2] = A_of_1 * LOAD_MEMORY
        F[:, 1, 0] = a2
        F[:, 2, 2] = LOAD_MEMORY
        G = np.zeros((len(T), 3, 2))
        G[:, :, 0] = (1.0, NOISE_COLOUR, 0.0)
        G[:, 0, 1] = A_of_1
        G[:, 2, 1] = 1.0
        G[:, :, 1] *= load_changes[:, np.newaxis]  # for noises of variance 1
        self.F = F
        self.K, self.S = _steady_kalman_filter(F, G @ G.transpose(0, 2, 1))

        row = np.tile([[1.0, 0.0, 0.0]], (len(T), 1, 1))  # h F^i for i = 0
        rows = []
        squares = []  # of h F^i K
        for _ in range(delays[-1] + 1):
            squares.append(np.square(row @ self.K)[:, 0, 0])  # one for each filter
            row = row @ F
            rows.append(row)
        # Element d of `rows` is h F^(d+1), and element d of the cumulative sum is the sum over
        # i = 0, ..., d of (h).
        self.to_forecast = np.array(rows)[delays]
        self.forecast_variances = self.S[:, 0] * np.cumsum(squares, axis=0)[delays]


def _steady_kalman_filter(F: Array, Q: Array) -> tuple[Array, Array]:
    """Return the gains K, (filters, 3, 1), and the innovations' variances S, (filters, 1).

    `F` are the transition matrices and `Q` the covariances of the noise in the state, both of
    shape (filters, 3, 3). The first element of the state is measured without noise.
    """
    P = Q  # covariance of x(k) before the measurement at k
    change = np.inf
    while change > RICCATI_TOLERANCE:
        S = P[:, :1, :1]  # variance of the first element, which is measured
        K = P[:, :, :1] / S
        P_next = F @ (P - K @ P[:, :1]) @ F.transpose(0, 2, 1) + Q
        change = np.abs(P_next - P).max()
        P = P_next
    return K, S[:, :, 0]


@dataclass(frozen=True, eq=False)
class Estimate:
    """The estimates of n plants after a sample k, each of shape (n,)."""

    gain: Array
    """Gain g."""
    time_constant: Array
    """Time constant T."""
    delay: Array
    """Delay d, samples."""
    response: Array
    """Response g s(k) to the flows before the sample k, without the delay."""
    forecast: Array
    """Forecast of the residual r(k+d+1), when the flow u_a(k) begins to affect the output."""
    deviation: Array
    """Standard deviation of the forecast's error."""


class Estimator:
    """The filters of n plants, with the posterior probabilities of their candidates.

    At each sample, call `observe` with the measured temperature, and then `apply` with the
    flow. The last axis of every array is the plant.
    """

    def __init__(self, candidates: Candidates, n: int) -> None:
        self._candidates = candidates
        filters = len(candidates.log_constants)
        shape = len(candidates.delays), filters, n
        # Responses, flows and states are replaced at each sample, never changed in place.
        self._s = np.zeros((filters, n))
        self._last_s = self._s
        self._last_u = np.zeros(n)
        self._x_y = np.zeros((filters, 3, n))
        self._x_s = self._x_y
        # x_s and nu_s of the latest samples: those of the sample k are in row k % length.
        # Before the first sample, the plants were at rest.
        length = int(candidates.delays[-1]) + 1
        self._past_x_s = np.zeros((length, filters, 3, n))
        self._past_nu_s = np.zeros((length, filters, n))
        # Sums over all samples of nu_y(k)^2 / S, nu_y(k) nu_s(k-d) / S and nu_s(k-d)^2 / S.
        self._sum_yy = np.zeros((filters, n))
        self._sum_ys = np.zeros(shape)
        self._sum_ss = np.zeros(shape)
        self._variance = np.full(n, FIRST_NOISE**2)  # sigma^2
        self._k = 0

    def observe(self, y: Array) -> Estimate:
        """Return the estimates after the measured temperatures y(k), shape (n,)."""
        candidates = self._candidates
        self._x_y, nu_y = self._filter(self._x_y, y)
        self._x_s, nu_s = self._filter(self._x_s, self._s)
        length = len(self._past_x_s)
        self._past_x_s[self._k % length] = self._x_s
        self._past_nu_s[self._k % length] = nu_s
        delayed = (self._k - candidates.delays) % length  # the row of k - d for each delay d
        self._k += 1
        gains, weights = self._learn(nu_y, self._past_nu_s[delayed])

        # (j), multiplied by h F^(d+1), which is a matrix with one row: hence the index 0 below.
        from_y = candidates.to_forecast @ self._x_y
        from_s = candidates.to_forecast @ self._past_x_s[delayed]
        forecasts = from_y[:, :, 0] - gains * from_s[:, :, 0]
        # A mean over the candidates, as all estimates are.
        forecast_variance = np.tensordot(candidates.forecast_variances, weights, 2)
        of_filters = weights.sum(0)  # probabilities of the filters, summed over the delays
        of_delays = weights.sum(1)
        return Estimate(
            gain=_mean(weights, gains),
            time_constant=np.exp((of_filters * candidates.log_constants).sum(0)),
            delay=candidates.delays @ of_delays,
            response=_mean(weights, gains * self._s),
            forecast=_mean(weights, forecasts),
            deviation=np.sqrt(self._variance * forecast_variance),
        )

    def apply(self, u: Array) -> None:
        """Compute the responses of the next sample to the applied flows u_a(k), shape (n,)."""
        of = self._candidates
        s = of.a1 * self._s + of.a2 * self._last_s + of.b1 * u + of.b2 * self._last_u  # (b)
        self._last_s = self._s
        self._s = s
        self._last_u = u

    def _filter(self, x: Array, signal: Array) -> tuple[Array, Array]:
        """Return the states x(k) after the next sample of a signal, and nu(k) / sqrt(S).

        `x` are the states x(k-1), shape (filters, 3, n). `signal` broadcasts to (filters, n).
        """
        candidates = self._candidates
        predicted = candidates.F @ x
        nu = signal - predicted[:, 0]  # (f)
        x = predicted + candidates.K * nu[:, np.newaxis]  # (g)
        # Divided by sqrt(S), the innovations have the variance sigma^2 with every filter.
        return x, nu / np.sqrt(candidates.S)

    def _learn(self, nu_y: Array, nu_s: Array) -> tuple[Array, Array]:
        """Return the gains and the probabilities of the candidates, (delays, filters, n).

        `nu_y` are the innovations nu_y(k) / sqrt(S), shape (filters, n), and `nu_s` are
        nu_s(k-d) / sqrt(S), shape (delays, filters, n).
        """
        candidates = self._candidates
        self._sum_yy += nu_y**2
        self._sum_ys += nu_y * nu_s
        self._sum_ss += nu_s**2

        # E, (l), is sum_yy - 2 g sum_ys + g^2 sum_ss, where the prior of the gain adds to each
        # sum. Here sigma^2 is the estimate of the previous sample.
        prior = self._variance / GAIN_SPREAD**2
        sum_yy = self._sum_yy + prior
        sum_ys = self._sum_ys + prior
        sum_ss = self._sum_ss + prior
        gains = np.clip(sum_ys / sum_ss, *GAIN_LIMITS)
        E = sum_yy + gains * (gains * sum_ss - 2.0 * sum_ys)

        losses = E / self._variance + self._k * np.log(candidates.S)
        logarithms = candidates.log_priors - 0.5 * LIKELIHOOD_FACTOR * losses  # (k)
        logarithms -= logarithms.max((0, 1))
        weights = np.exp(np.maximum(logarithms, LEAST_LOGARITHM))
        weights /= weights.sum((0, 1))

        # `FIRST_NOISE` counts as the noise of further samples before the first.
        squares = FIRST_NOISE_SAMPLES * FIRST_NOISE**2 + _mean(weights, E)
        variance = squares / (FIRST_NOISE_SAMPLES + self._k)
        self._variance = np.maximum(variance, LEAST_NOISE**2)
        return gains, weights


def _mean(weights: Array, values: Array) -> Array:
    """Return the means over the candidates, (n,), of values of shape (delays, filters, n)."""
    mean: Array = np.einsum("dfn,dfn->n", weights, values)
    return mean
