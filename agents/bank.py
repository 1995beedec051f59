"""Identify the delays and time constants of plants by a bank of models.

All quantities are scaled, so that a bank suits any plant. Flows are divided by half the
actuator's range. The *authority* is the steady change of temperature that half the actuator's
range causes in the step test; temperatures are divided by the authority. Times are divided by
the sampling interval. In scaled quantities, a positive flow raises the temperature.

The last axis of every array is the plant: shapes are (n,), (time constants, n) and (delays,
time constants, n), for n plants.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.floating[Any]]

# The paper's plant is equation (28), A(z^-1) y(k) = B(z^-1) u_a(k - d) + C(z^-1) xi(k).
# All models of the bank have the following numbers, but differ in gain, delay, time constant.
FAST_POLE: Final = -0.4997  # the faster of the two poles, the roots of the polynomial A
NEWER_SHARE: Final = 0.9186  # first coefficient of the polynomial B divided by the sum of both
NOISE_COLOUR: Final = (-0.3574, -0.03392)  # coefficients of the polynomial C from z^-1 on

# Settings of the identification, with which the control error was smallest on random plants.
# Forgetting factor of the gains, per sample: a gain can drift within 1,000 samples.
GAIN_FORGETTING: Final = 0.999
# Forgetting factor of the models' log-likelihoods, per sample: nearer to 1 than that of the
# gains, as a delay does not drift.
MODEL_FORGETTING: Final = 0.9995
# Factor of log-likelihoods. It is below 1, as one-step errors are slightly correlated.
LIKELIHOOD_FACTOR: Final = 0.5
# Zero of the whitening filter. Nearer to 1, a load disturbs the estimates of gains less.
LOAD_POLE: Final = 0.98
# Expected standard deviation of the one-step errors before the first sample, in units of the
# authority.
FIRST_NOISE: Final = 0.07
FIRST_NOISE_SAMPLES: Final = 30.0  # number of samples that `FIRST_NOISE` counts for
LEAST_NOISE_RATE: Final = 0.004  # least weight of the newest error in the noise variance
# Least standard deviation of the noise, in units of the authority. Smaller errors of the models
# would come from the low order of the models and not from noise.
LEAST_NOISE: Final = 0.003
# A squared error is limited to this multiple of the variance, so that an outlier counts little.
LARGEST_SQUARE: Final = 16.0
GAIN_LIMITS: Final = (0.3, 3.0)  # least and greatest gain, as multiples of the step test's
# Least logarithm of a probability, relative to the most probable model: exp(-30) is nearly 0.
LEAST_LOGARITHM: Final = -30.0
# Samples between updates of the models' probabilities, which take the most computing time.
ESTIMATE_INTERVAL: Final = 2
LAGS: Final = 4  # number of latest outputs and of latest mean model outputs that a bank keeps


@dataclass(frozen=True)
class Prior:
    """The prior knowledge of n plants: the models of a bank and their probabilities.

    Each plant has a model for every pair of a delay and a time constant.
    """

    time_constants: ArrayLike
    """Time constants of the models, samples, shape (time constants, n)."""
    shortest_delays: ArrayLike
    """Shortest delay of each plant's models, samples, as the delay d of equation (28) of the
    paper, shape (n,). The delays of a plant's models are this delay and 1, 2, ... samples
    more."""
    log_probabilities: ArrayLike
    """Logarithms of the models' prior probabilities, up to a constant for each plant, shape
    (delays, time constants, n)."""
    gain_spread: ArrayLike
    """Standard deviation of the plant's gain before the first sample, as a share of the step
    test's gain, shape (n,)."""

    def repeated(self, n: int) -> Prior:
        """Return the prior knowledge of n equal plants; `self` must be that of one plant."""
        repeated = {name: np.repeat(values, n, axis=-1) for name, values in vars(self).items()}
        return Prior(**repeated)


def model_coefficients(time_constants: Array) -> tuple[Array, Array, Array, Array]:
    """Return a1, a2, b1 and b2 of s(k) = a1 s(k-1) + a2 s(k-2) + b1 f(k-1) + b2 f(k-2).

    The equation is a model with the flow f as its input, the output s, a gain of 1 and no
    delay. The model's fast pole, and the ratio b1 / b2, are those of equation (28) of the
    paper. `time_constants` are in samples, and the four arrays have the same shape.
    """
    pole = np.exp(-1.0 / time_constants)
    sum_of_b = (1.0 - pole) * (1.0 - FAST_POLE)
    b1 = NEWER_SHARE * sum_of_b
    return pole + FAST_POLE, -pole * FAST_POLE, b1, sum_of_b - b1


class UndelayedModels:
    """Models of n plants with a gain of 1 and no delay, one model for each time constant.

    The docstring of `model_coefficients` states the equation of the models. The models start at
    rest.

    The models run in NumPy, or in PyTorch so that gradients can pass through the models.

    Parameters
    ----------
    time_constants
        Time constants of the models, samples, shape (time constants, n).
    convert
        Function that converts a NumPy array to an array of the library in which the models run.

    Attributes
    ----------
    outputs
        Outputs s(k) of the models at the present sample, shape (time constants, n).
    last_outputs
        Outputs s(k-1) of the models at the last sample, shape (time constants, n).
    last_flow
        The flow f(k-1) of the last sample, in units of half the actuator's range, shape (n,).
    """

    def __init__(
        self, time_constants: Array, convert: Callable[[Array], Any] = np.asarray
    ) -> None:
        self._coefficients = [convert(values) for values in model_coefficients(time_constants)]
        self.outputs = convert(np.zeros_like(time_constants))
        self.last_outputs = self.outputs
        self.last_flow = convert(np.zeros_like(time_constants[0]))

    def advance(self, flow: Any) -> None:
        """Advance the models by a sample with the flow f(k), shape (n,)."""
        a1, a2, b1, b2 = self._coefficients
        next_outputs = a1 * self.outputs + a2 * self.last_outputs
        next_outputs = next_outputs + b1 * flow + b2 * self.last_flow
        self.last_outputs = self.outputs
        self.outputs = next_outputs
        self.last_flow = flow


class Whitening:
    """The filter (1 - FAST_POLE/z) (1 - LOAD_POLE/z) / C(1/z), which makes noise nearly white.

    The plant's noise is C xi / A, with the polynomials A and C and the white noise xi of
    equation (28) of the paper.

    Parameters
    ----------
    shape
        Shape of a sample of the signal. The filter treats every element separately, and starts
        at rest.
    """

    def __init__(self, shape: tuple[int, ...]) -> None:
        rest = np.zeros(shape, np.float32)
        self._inputs = deque([rest, rest], maxlen=2)  # newest first, as the outputs
        self._outputs = deque([rest, rest], maxlen=2)

    def __call__(self, signal: Array) -> Array:
        """Return the next sample of the filtered signal, for the next sample of the signal."""
        # The numerator is 1 - (FAST_POLE + LOAD_POLE) / z + FAST_POLE LOAD_POLE / z^2.
        output: Array = signal - (FAST_POLE + LOAD_POLE) * self._inputs[0]
        output = output + FAST_POLE * LOAD_POLE * self._inputs[1]
        for coefficient, past_output in zip(NOISE_COLOUR, self._outputs, strict=True):
            output = output - coefficient * past_output
        self._inputs.appendleft(signal)
        self._outputs.appendleft(output)
        return output


class Bank:
    """Models of n plants, y(k) = g s(k - d), one for each pair of a delay and time constant.

    Here y is the output, d the delay in samples, and s the output of a model with gain 1 and no
    delay for the flows so far. The gain g of each model is estimated by recursive least squares
    on whitened signals, with the step test's gain as a prior. The probability of a model
    follows from its one-step errors, which are taken for Gaussian. Gains and probabilities
    forget old samples exponentially, but they never forget the prior.

    At each sample, call `observe` with the output, read the attributes, choose a flow, and call
    `apply` with the flow.

    Parameters
    ----------
    prior
        The models, and what is known of the plants before the first sample.

    Attributes
    ----------
    n : int
        The number of plants.
    time_constants, gain_spread : ndarray
        The fields of `prior`, as arrays of float32.
    shares : ndarray
        Probabilities of the time constants, shape (time constants, n).
    delay, delay_spread : ndarray
        Mean and standard deviation of the delay, samples, as the delay d of equation (28) of
        the paper, shape (n,).
    log_constant, log_constant_spread : ndarray
        Mean and standard deviation of the natural logarithm of the time constant in samples,
        shape (n,).
    pole : ndarray
        Mean of exp(-1 / T), the pole of a model with the time constant T in samples, shape
        (n,).
    fading : ndarray
        Mean of exp(-(d + 1) / T), shape (n,): the share of a deviation that remains after d + 1
        samples, when the present flow shows in the output, if the deviation decays with the
        time constant T in samples.
    variance : ndarray
        Variance of the one-step errors, in units of the authority squared, shape (n,).
    innovation : ndarray
        The newest one-step error of the whitened output, mean over the models, in units of the
        authority, shape (n,).
    outputs : ndarray
        The latest outputs y(k), y(k-1), ..., in units of the authority, shape (LAGS, n).
    responses : ndarray
        The mean of s(k - d) over the models, then the means of s(k - d - 1), ..., shape
        (LAGS, n).
    """

    def __init__(self, prior: Prior) -> None:
        self.time_constants = np.asarray(prior.time_constants, np.float32)
        self.gain_spread = np.asarray(prior.gain_spread, np.float32)
        self._log_priors = np.asarray(prior.log_probabilities, np.float32)
        self._shortest_delays = np.asarray(prior.shortest_delays, np.intp)
        self._delay_count, constant_count, self.n = self._log_priors.shape
        delays = self._shortest_delays + np.arange(self._delay_count)[:, np.newaxis]
        self._delays = delays.astype(np.float32)
        self._log_constants = np.log(self.time_constants)
        self._poles = np.exp(-1.0 / self.time_constants)
        self._fading = self._poles ** (self._delays[:, np.newaxis] + 1.0)
        self._undelayed = UndelayedModels(self.time_constants)
        self._whiten_output = Whitening((self.n,))
        self._whiten_response = Whitening((constant_count, self.n))
        # Past outputs s of the models without delay, and the whitened s, as two elements of the
        # second axis. The first axis is a ring: sample k has the row k modulo the length.
        ring_shape = (int(self._shortest_delays.max()) + 1, 2, constant_count, self.n)
        self._ring = np.zeros(ring_shape, np.float32)
        # Outputs s(k - d) for the shortest delay d, and then for longer delays.
        delayed_shape = (self._delay_count + LAGS - 1, constant_count, self.n)
        self._delayed = np.zeros(delayed_shape, np.float32)
        # The whitened s(k - d) of each model.
        self._regressors = np.zeros_like(self._log_priors)
        self.outputs = np.zeros((LAGS, self.n), np.float32)
        # Sums over past samples, which forget exponentially: squared regressors, regressors
        # times whitened outputs, and log-likelihoods.
        self._information = np.zeros_like(self._log_priors)
        self._products = np.zeros_like(self._log_priors)
        self._log_likelihoods = np.zeros_like(self._log_priors)
        self.variance = np.full(self.n, FIRST_NOISE**2, np.float32)
        self._k = 0
        self._renew_estimates()

    def observe(self, output: Array) -> None:
        """Update the models with the newest output y(k), in units of the authority, (n,)."""
        self.outputs[1:] = self.outputs[:-1]
        self.outputs[0] = output
        # What a model has now, the model with the next longer delay has at the next sample.
        self._delayed[1:] = self._delayed[:-1]
        self._regressors[1:] = self._regressors[:-1]
        rows = (self._k - self._shortest_delays) % len(self._ring)
        # The index selects a row for each plant, and puts the axis of the plants first.
        newest = self._ring[rows, :, :, np.arange(self.n)].transpose(1, 2, 0)
        self._delayed[0], self._regressors[0] = newest
        self._learn(self._whiten_output(self.outputs[0].copy()))
        self._k += 1
        if self._k % ESTIMATE_INTERVAL == 0:
            self._renew_estimates()
        means = []
        for lag in range(LAGS):
            delayed = self._delayed[lag : lag + self._delay_count]
            means.append(np.einsum("dtn,dtn->n", self._weights, delayed))
        self.responses = np.stack(means)

    def apply(self, flow: Array) -> None:
        """Update the models with the flow f(k) that the actuator passes.

        `flow` is in units of half the actuator's range, shape (n,). At each sample, call this
        method after `observe`.
        """
        self._undelayed.advance(flow)
        response = self._undelayed.outputs
        row = self._k % len(self._ring)
        self._ring[row, 0] = response
        self._ring[row, 1] = self._whiten_response(response)

    def _learn(self, whitened: Array) -> None:
        """Update the sums for the gains, the noise variance and the models' log-likelihoods.

        `whitened` is the newest output after the whitening filter, in units of the authority,
        shape (n,).
        """
        errors = whitened - self._gains * self._regressors
        self.innovation = np.einsum("dtn,dtn->n", self._weights, errors)
        squares = np.square(errors)
        self._log_likelihoods *= MODEL_FORGETTING
        self._log_likelihoods -= squares * (0.5 * LIKELIHOOD_FACTOR / self.variance)
        # The noise variance is at first the mean of all squared errors so far.
        rate = max(LEAST_NOISE_RATE, 1.0 / (FIRST_NOISE_SAMPLES + self._k))
        square = np.einsum("dtn,dtn->n", self._weights, squares)
        square = np.minimum(square, LARGEST_SQUARE * self.variance)
        variance = self.variance + rate * (square - self.variance)
        self.variance = np.maximum(variance, LEAST_NOISE**2).astype(np.float32)
        self._information *= GAIN_FORGETTING
        self._information += np.square(self._regressors)
        self._products *= GAIN_FORGETTING
        self._products += self._regressors * whitened

    def _renew_estimates(self) -> None:
        """Compute the models' gains and probabilities, and the means over the models."""
        # The step test's gain, which is 1, counts like samples with this information.
        of_prior = self.variance / np.square(self.gain_spread)
        gains = (self._products + of_prior) / (self._information + of_prior)
        self._gains = np.clip(gains, *GAIN_LIMITS)
        logarithms = self._log_likelihoods + self._log_priors
        logarithms -= logarithms.max((0, 1))
        weights = np.exp(np.maximum(logarithms, LEAST_LOGARITHM))
        weights /= weights.sum((0, 1))
        self._weights = weights
        self.shares = weights.sum(0)
        self.delay, self.delay_spread = _moments(weights.sum(1), self._delays)
        self.log_constant, self.log_constant_spread = _moments(self.shares, self._log_constants)
        self.pole = (self.shares * self._poles).sum(0)
        self.fading = np.einsum("dtn,dtn->n", weights, self._fading)


def _moments(weights: Array, values: Array) -> tuple[Array, Array]:
    """Return the weighted mean and standard deviation of `values` over the first axis.

    `weights` are probabilities, whose sum over the first axis is 1. Both arguments have the
    shape (count, n), and both results the shape (n,).
    """
    mean = (weights * values).sum(0)
    variance = (weights * np.square(values - mean)).sum(0)
    return mean, np.sqrt(variance)
