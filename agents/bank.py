"""Identify the delay, time constant and gain of n plants by a bank of candidate models.

All quantities are dimensionless, so that a bank of candidate models suits any plant. Flows are
divided by half the flow range, (u_max - u_min) / 2. Temperatures are divided by the steady
temperature change that half the flow range causes according to the step test. Times are divided
by the interval between two changes of the command. A positive dimensionless flow raises the
temperature.

The last axis of every array is the plant. For n plants, an array has for example the shape
(n,), (time constants, n) or (delays, time constants, n). All plants have the same candidate
models.
"""

from __future__ import annotations

from collections import deque
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]

# The paper's plant is equation (28), A(z^-1) y(k) = B(z^-1) u_a(k - d) + C(z^-1) xi(k). All
# candidate models have the following constants of the paper's plant. The models differ in gain,
# delay and time constant.
FAST_POLE: Final = -0.4997  # the faster of the two poles, the roots of the polynomial A
NEWER_SHARE: Final = 0.9186  # first coefficient of the polynomial B divided by the sum of both
NOISE_COLOUR: Final = (-0.3574, -0.03392)  # coefficients of the polynomial C from z^-1 on

# The following settings gave the smallest control error on random plants. Forgetting factor of
# the gains, per sample: the gain of a plant can drift within 1,000 samples.
GAIN_FORGETTING: Final = 0.999
# Forgetting factor of the models' log-likelihoods, per sample. The factor is nearer to 1 than
# `GAIN_FORGETTING`, as the delay of a plant does not drift.
MODEL_FORGETTING: Final = 0.9995
# Factor of log-likelihoods, below 1 because successive prediction errors are correlated.
LIKELIHOOD_FACTOR: Final = 0.5
# Zero of the whitening filter. With a zero near 1, a load hardly changes the estimated gains.
LOAD_POLE: Final = 0.98
# Expected standard deviation of the models' one-step prediction errors before the first sample,
# in units of the steady temperature change for half the flow range.
FIRST_NOISE: Final = 0.07
# The squared prediction error of the first sample has the weight 1 / `FIRST_NOISE_SAMPLES` in
# the noise variance, and FIRST_NOISE^2 has the rest of the weight.
FIRST_NOISE_SAMPLES: Final = 30.0
# Least weight of the newest squared prediction error in the noise variance.
LEAST_NOISE_RATE: Final = 0.004
# Least standard deviation of the noise, in units of the steady temperature change for half the
# flow range. Smaller errors would come from the low order of the models, not from noise.
LEAST_NOISE: Final = 0.003
# Largest mean over the models of the squared prediction error, as a multiple of the noise
# variance. A larger mean is clipped before it updates the noise variance, so an outlier has
# little influence on the noise variance. The log-likelihoods use squares without clipping.
LARGEST_SQUARE: Final = 16.0
# Prior standard deviation of the gain, divided by the gain that the step test measured.
GAIN_SPREAD: Final = 0.25
GAIN_LIMITS: Final = (0.3, 3.0)  # least and greatest gain, as multiples of the step test's
# Least value of ln(p / q), for a model's probability p and the greatest probability q. Such a
# model no longer matters, and much lower values would make exp slow (subnormal numbers).
LEAST_LOGARITHM: Final = -30.0
# Samples between updates of the models' gains and probabilities. These updates take the most
# computing time.
ESTIMATE_INTERVAL: Final = 2


class UndelayedModels:
    """Models with a gain of 1 and no delay, one for each time constant of each of n plants.

    The equation of a model is s(k) = a1 s(k-1) + a2 s(k-2) + b1 f(k-1) + b2 f(k-2), where f is
    the flow and s the output. The poles of a model are exp(-1 / T), for the time constant T in
    samples, and `FAST_POLE`. The ratio b1 / b2 is that of equation (28) of the paper. All
    models start with the output 0.

    Parameters
    ----------
    time_constants
        Time constants of the models, samples, shape (time constants, n).

    Attributes
    ----------
    outputs
        Outputs s(k) of the models at the present sample k, shape (time constants, n).
    """

    def __init__(self, time_constants: Array) -> None:
        # The denominator of the transfer function is (1 - pole/z) (1 - FAST_POLE/z), which is
        # 1 - a1/z - a2/z^2. For a gain of 1, b1 + b2 equals the denominator at z = 1.
        pole = np.exp(-1.0 / time_constants)
        sum_of_b = (1.0 - pole) * (1.0 - FAST_POLE)
        b1 = NEWER_SHARE * sum_of_b
        self._coefficients = pole + FAST_POLE, -pole * FAST_POLE, b1, sum_of_b - b1
        self.outputs = np.zeros_like(time_constants)
        self._last_outputs = self.outputs  # s(k-1)
        self._last_flow = np.zeros_like(time_constants[0])  # f(k-1), shape (n,)

    def advance(self, flow: Array) -> None:
        """Compute the outputs of the next sample for the present flow f(k), shape (n,)."""
        a1, a2, b1, b2 = self._coefficients  # each of shape (time constants, n)
        next_outputs = a1 * self.outputs + a2 * self._last_outputs
        next_outputs = next_outputs + b1 * flow + b2 * self._last_flow
        self._last_outputs = self.outputs
        self.outputs = next_outputs
        self._last_flow = flow


class Whitening:
    """A filter of a signal, which makes the noise of a plant nearly white.

    The transfer function of the filter is (1 - FAST_POLE/z) (1 - LOAD_POLE/z) / C(1/z), where C
    is a polynomial of equation (28) of the paper. In equation (28), the noise of the plant is C
    xi / A, with polynomials A and C and white noise xi.

    Parameters
    ----------
    shape
        Shape of one sample of the signal to filter. Each element of a sample is filtered
        separately.
    """

    def __init__(self, shape: tuple[int, ...]) -> None:
        rest = np.zeros(shape, np.float32)
        self._inputs = deque([rest, rest], maxlen=2)  # newest first
        self._outputs = deque([rest, rest], maxlen=2)

    def __call__(self, signal: Array) -> Array:
        """Return the filtered value of the next sample of the signal."""
        # The numerator is 1 - (FAST_POLE + LOAD_POLE) / z + FAST_POLE LOAD_POLE / z^2.
        output: Array = signal - (FAST_POLE + LOAD_POLE) * self._inputs[0]
        output = output + FAST_POLE * LOAD_POLE * self._inputs[1]
        for coefficient, past_output in zip(NOISE_COLOUR, self._outputs, strict=True):
            output = output - coefficient * past_output
        self._inputs.appendleft(signal)
        self._outputs.appendleft(output)
        return output


class Bank:
    """Candidate models of n plants, with the estimated gain and probability of each model.

    Each model predicts the output y(k) = g s(k - d), with the gain g, the delay d in samples,
    and the output s(k) of a model with gain 1 and no delay. Each plant has one candidate model
    for every pair of a delay and a time constant.

    The gain g of each model is estimated by recursive least squares on whitened signals, and
    its prior mean is the gain of the step test. The probability of each model follows from its
    one-step prediction errors, which are assumed to be Gaussian. Old samples lose their weight
    exponentially in the estimated gains and probabilities, but the prior keeps its weight.

    At each sample, call `observe` with the measured output, and then `apply` with the flow.

    Parameters
    ----------
    time_constants
        Candidate time constants, samples, shape (time constants,).
    delays
        Candidate delays d, in samples, as in equation (28) of the paper: successive integers in
        rising order, shape (delays,).
    log_probabilities
        Logarithms of the prior probabilities of the models, shape (delays, time constants). The
        probabilities need not sum to 1.
    n
        Number of plants.

    Attributes
    ----------
    models : UndelayedModels
        The candidate models with gain 1 and without their delays.
    shares : ndarray
        Probabilities of the candidate time constants, shape (time constants, n).
    delay : ndarray
        Estimated mean of the delay d, samples, as in equation (28) of the paper, shape (n,).
    log_constant : ndarray
        Estimated mean of ln(T), for the time constant T in samples, shape (n,).
    pole : ndarray
        Estimated mean of the pole exp(-1 / T), for the time constant T in samples, shape (n,).
    fading : ndarray
        Estimated mean of the share exp(-(d + 1) / T) of a deviation with the time constant T
        that remains after d + 1 samples, for the delay d and T in samples, shape (n,).
    variance : ndarray
        Estimated variance of the models' one-step prediction errors of the whitened output, in
        squared units of the steady temperature change for half the flow range, shape (n,).
    responses : ndarray
        Outputs s(k - d) of the candidate models with gain 1 at the present and at the previous
        sample k, as means that are weighted by the probabilities of the models, shape (2, n).
    """

    def __init__(
        self,
        time_constants: Array,
        delays: NDArray[np.intp],
        log_probabilities: Array,
        n: int,
    ) -> None:
        constants = _for_plants(time_constants, n)
        self._delays = _for_plants(delays, n)
        self._log_constants = np.log(constants)
        self._poles = np.exp(-1.0 / constants)
        self._fading = self._poles ** (self._delays[:, np.newaxis] + 1.0)
        self._log_priors = _for_plants(log_probabilities, n)
        self.models = UndelayedModels(constants)
        self._whiten_output = Whitening((n,))
        self._whiten_response = Whitening(constants.shape)
        # Outputs of the models without delay, and the same outputs whitened, oldest first, from
        # s(k - d) with the shortest delay d to s(k).
        length = int(delays[0]) + 1
        rest = np.zeros_like(constants), np.zeros_like(constants)
        self._in_transit = deque([rest] * length, maxlen=length)
        # Outputs s(k - d) in order of the delay d, from the shortest delay on, of shape (delays
        # + 1, time constants, n). The last element is the output of the longest delay at the
        # previous sample.
        self._delayed = np.zeros((len(delays) + 1, *constants.shape), np.float32)
        # The whitened s(k - d) of each model, shape (delays, time constants, n), as of all sums
        # below.
        self._regressors = np.zeros_like(self._log_priors)
        # Exponentially weighted sums over past samples: squared regressors, regressors times
        # whitened outputs, and log-likelihoods.
        self._information = np.zeros_like(self._log_priors)
        self._products = np.zeros_like(self._log_priors)
        self._log_likelihoods = np.zeros_like(self._log_priors)
        self.variance = np.full(n, FIRST_NOISE**2, np.float32)
        self._k = 0  # number of measured outputs so far
        self._renew_estimates()

    def observe(self, output: Array) -> None:
        """Update the gains and probabilities of the models with the measured output y(k).

        `output` is in units of the steady temperature change for half the flow range, shape
        (n,).
        """
        # The model with the next longer delay has the same output one sample later, so the
        # outputs move on by one delay. The new output of the shortest delay is the oldest in
        # transit, because `apply` has appended s(k) at the previous sample.
        self._delayed[1:] = self._delayed[:-1]
        self._regressors[1:] = self._regressors[:-1]
        self._delayed[0], self._regressors[0] = self._in_transit[0]
        self._learn(self._whiten_output(output))
        self._k += 1
        if self._k % ESTIMATE_INTERVAL == 0:
            self._renew_estimates()
        present = self._mean(self._delayed[:-1])
        # One delay further on are the outputs s(k - 1 - d) of the previous sample.
        previous = self._mean(self._delayed[1:])
        self.responses = np.stack([present, previous])

    def apply(self, flow: Array) -> None:
        """Update the models with the flow f(k) that leaves the actuator.

        `flow` is a share of half the flow range, shape (n,). At each sample, call `observe`
        before `apply`.
        """
        self.models.advance(flow)
        response = self.models.outputs
        self._in_transit.append((response, self._whiten_response(response)))

    def _learn(self, whitened: Array) -> None:
        """Update the noise variance, and the sums that give the gains and probabilities.

        `whitened` is the newest measured output after the whitening filter, shape (n,), in
        units of the steady temperature change for half the flow range.
        """
        # One-step prediction errors of all models, shape (delays, time constants, n).
        errors = whitened - self._gains * self._regressors
        squares = np.square(errors)
        self._log_likelihoods *= MODEL_FORGETTING
        self._log_likelihoods -= squares * (0.5 * LIKELIHOOD_FACTOR / self.variance)
        # At the start of an episode, the noise variance is a mean of the first guess
        # FIRST_NOISE^2 and all squared errors so far.
        rate = max(LEAST_NOISE_RATE, 1.0 / (FIRST_NOISE_SAMPLES + self._k))
        square = self._mean(squares)
        square = np.minimum(square, LARGEST_SQUARE * self.variance)
        variance = self.variance + rate * (square - self.variance)
        self.variance = np.maximum(variance, LEAST_NOISE**2).astype(np.float32)
        self._information *= GAIN_FORGETTING
        self._information += np.square(self._regressors)
        self._products *= GAIN_FORGETTING
        self._products += self._regressors * whitened

    def _renew_estimates(self) -> None:
        """Update the gains and probabilities of the models, and the means over the models."""
        # Least squares, with the sums that `_learn` updates: prior_weight is the weight of the
        # gain's prior mean, which is 1.
        prior_weight = self.variance / GAIN_SPREAD**2
        gains = (self._products + prior_weight) / (self._information + prior_weight)
        self._gains = np.clip(gains, *GAIN_LIMITS)
        # Probabilities of the models of a plant, by the rule of Bayes. The axes 0 and 1 are the
        # models' delays and time constants.
        logarithms = self._log_likelihoods + self._log_priors
        logarithms -= logarithms.max((0, 1))
        weights = np.exp(np.maximum(logarithms, LEAST_LOGARITHM))
        weights /= weights.sum((0, 1))
        self._weights = weights
        self.shares = weights.sum(0)
        self.delay = (weights.sum(1) * self._delays).sum(0)
        self.log_constant = (self.shares * self._log_constants).sum(0)
        self.pole = (self.shares * self._poles).sum(0)
        self.fading = self._mean(self._fading)

    def _mean(self, values: Array) -> Array:
        """Return the mean over the models, weighted by their probabilities, shape (n,).

        `values` has the shape (delays, time constants, n).
        """
        mean: Array = np.einsum("dtn,dtn->n", self._weights, values)
        return mean


def _for_plants(values: NDArray[Any], n: int) -> NDArray[np.float32]:
    """Return values of one plant as values of n equal plants, shape (..., n), in float32."""
    return np.repeat(values[..., np.newaxis].astype(np.float32), n, axis=-1)
