"""Identify the delays and time constants of plants by a bank of models.

All quantities are scaled, so that one bank serves any plant: flows by half the actuator's
range, temperatures by the steady effect of such a flow in the step test (the *authority*), and
times by the sampling interval. A positive flow raises the temperature.

Arrays end with the plant: shapes are (n,), (time constants, n) and (delays, time constants, n).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.floating[Any]]

# The shape of the plant (28), of which the bank varies gain, delay and time constant.
FAST_POLE: Final = -0.4997  # the root of A that is not the time constant's
NEWER_SHARE: Final = 0.9186  # share of the newer flow in the sum of B's coefficients
NOISE_COLOUR: Final = (-0.3574, -0.03392)  # coefficients of C from z^-1 on

# Settings of the identification, chosen by the error on plants that vary.
GAIN_MEMORY: Final = 0.999  # factor a sample: a gain that drifts is another after 1,000 samples
MODEL_MEMORY: Final = 0.9995  # the same of the likelihoods: a delay does not drift
CAUTION: Final = 0.5  # factor of the log-likelihoods, as the errors are not quite white
LOAD_POLE: Final = 0.98  # zero of the whitening filter; the nearer 1, the less a load misleads
FIRST_NOISE: Final = 0.07  # of the authority, standard deviation expected of one-step errors
FIRST_NOISE_SAMPLES: Final = 30.0  # weight of this expectation, in samples
NOISE_RATE: Final = 0.004  # least weight of the newest squared error in the noise variance
LEAST_NOISE: Final = 0.003  # of the authority; smaller errors come from the models' low order
OUTLIER: Final = 16.0  # multiple of the variance above which a squared error counts no more
GAINS: Final = (0.3, 3.0)  # least and greatest gain, as multiples of the step test's
UNLIKELY: Final = -30.0  # logarithm of a probability that is as good as 0
DESIGN_INTERVAL: Final = 2  # samples between new weights of the models, which cost most
LAGS: Final = 4  # latest residuals that are known


@dataclass(frozen=True)
class Prior:
    """The prior knowledge of n plants, before they are controlled."""

    time_constants: ArrayLike
    """Time constants of the models, samples, shape (time constants, n)."""
    shortest_delays: ArrayLike
    """Shortest delay d of (28), samples, shape (n,). The models have this delay and the next
    longer ones, a sample apart."""
    log_probabilities: ArrayLike
    """Logarithms of the models' probabilities, up to a constant, shape (delays, time
    constants, n)."""
    gain_spread: ArrayLike
    """Standard deviation of the gain, as a share of the step test's, shape (n,)."""


@dataclass(frozen=True)
class Estimate:
    """The estimates of a bank for n plants: means over its models, and standard deviations."""

    shares: Array
    """Probabilities of the time constants, shape (time constants, n)."""
    delay: Array
    """Delay d of (28), samples."""
    delay_spread: Array
    log_constant: Array
    """Natural logarithm of the time constant in samples."""
    constant_spread: Array
    pole: Array
    """Pole of the mean model that belongs to its time constant."""
    fading: Array
    """Share of a slow deviation that remains when the next flow shows, d + 1 samples later."""


def second_order(time_constants: Array) -> tuple[Array, Array, Array, Array]:
    """Return a1, a2, b1 and b2 of s(k) = a1 s(k-1) + a2 s(k-2) + b1 f(k-1) + b2 f(k-2).

    The model has a gain of 1, the given time constants in samples, and the shape of (28).
    """
    pole = np.exp(-1.0 / time_constants)
    total = (1.0 - pole) * (1.0 - FAST_POLE)
    newer = NEWER_SHARE * total
    return pole + FAST_POLE, -pole * FAST_POLE, newer, total - newer


class Whitening:
    """Filter that makes the noise of (28) white: (1 - FAST_POLE/z) (1 - LOAD_POLE/z) / C."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        rest = np.zeros(shape, np.float32)
        self._inputs = deque([rest, rest], maxlen=2)  # newest first, as the outputs
        self._outputs = deque([rest, rest], maxlen=2)

    def __call__(self, signal: Array) -> Array:
        """Return the next sample of the filtered signal."""
        output: Array = signal - (FAST_POLE + LOAD_POLE) * self._inputs[0]
        output = output + FAST_POLE * LOAD_POLE * self._inputs[1]
        for coefficient, earlier in zip(NOISE_COLOUR, self._outputs, strict=True):
            output = output - coefficient * earlier
        self._inputs.appendleft(signal)
        self._outputs.appendleft(output)
        return output


class Bank:
    """Models of n plants, y(k) = g s(k - d), one for each pair of a delay and time constant.

    s is the response of the model with gain 1 and no delay to the flow. The gain g of each
    model is estimated by recursive least squares on whitened signals. The step test's gain is a
    prior that is never forgotten. The probability of a model follows from its one-step errors,
    as for a Gaussian density. Both forget exponentially.

    At each sample, `observe` the output, then `apply` the flow. In between, `estimate`,
    `noise`, `innovation`, `outputs` and `responses` tell what is known.

    Attributes
    ----------
    estimate : Estimate
        Means over the models; renewed at every second sample.
    noise : ndarray
        Standard deviation of the one-step errors, of the authority.
    innovation : ndarray
        The newest one-step error.
    outputs, responses : ndarray
        The latest outputs, and the responses s of the mean model at the same samples, newest
        first, shape (LAGS, n).
    """

    def __init__(self, prior: Prior) -> None:
        self.time_constants = np.asarray(prior.time_constants, np.float32)
        self._prior = np.asarray(prior.log_probabilities, np.float32)
        self._shortest = np.asarray(prior.shortest_delays, np.intp)
        self.gain_spread = np.asarray(prior.gain_spread, np.float32)
        self._gain_variance = np.square(self.gain_spread)
        models = self._prior.shape
        self._count, constants, self.n = models
        delays = self._shortest + np.arange(self._count)[:, np.newaxis]
        self._delays = delays.astype(np.float32)
        self._logarithms = np.log(self.time_constants)
        poles = np.exp(-1.0 / self.time_constants)
        self._poles = poles
        self._fading = poles ** (self._delays[:, np.newaxis] + 1.0)
        self._coefficients = second_order(self.time_constants)

        def zeros(*shape: int) -> Array:
            return np.zeros(shape, np.float32)

        # The responses s, plain and whitened, of the last samples, without and with the delays.
        self._response = deque(zeros(2, constants, self.n), maxlen=2)
        self._flow = zeros(self.n)
        self._undelayed = zeros(int(self._shortest.max()) + 1, 2, constants, self.n)
        self._delayed = zeros(self._count + LAGS - 1, constants, self.n)
        self._regressors = zeros(*models)
        self._whiten_output = Whitening((self.n,))
        self._whiten_response = Whitening((constants, self.n))
        self.outputs = zeros(LAGS, self.n)
        self.responses = zeros(LAGS, self.n)
        # Sums over the past with forgetting.
        self._information, self._products = zeros(*models), zeros(*models)
        self._log_likelihoods = zeros(*models)
        self._variance = zeros(self.n) + FIRST_NOISE**2
        self._k = 0
        self._plants = np.arange(self.n)
        self.innovation = zeros(self.n)
        self._design()

    @property
    def variance(self) -> Array:
        """Variance of the one-step errors, of the authority squared, shape (n,)."""
        return self._variance

    @property
    def noise(self) -> Array:
        """Standard deviation of the one-step errors, of the authority, shape (n,)."""
        deviations: Array = np.sqrt(self._variance)
        return deviations

    def observe(self, output: Array) -> None:
        """Learn from the output y(k), shape (n,)."""
        self.outputs[1:] = self.outputs[:-1]
        self.outputs[0] = output
        rows = (self._k - self._shortest) % len(self._undelayed)
        newest = self._undelayed[rows, :, :, self._plants].transpose(1, 2, 0)
        self._delayed[1:] = self._delayed[:-1]
        self._regressors[1:] = self._regressors[:-1]
        self._delayed[0], self._regressors[0] = newest
        self._learn(self._whiten_output(self.outputs[0].copy()))
        self._k += 1
        if self._k % DESIGN_INTERVAL == 0:
            self._design()
        self.responses = np.stack(
            [
                np.einsum("dtn,dtn->n", self._weights, self._delayed[lag : lag + self._count])
                for lag in range(LAGS)
            ]
        )

    def apply(self, flow: Array) -> None:
        """Take note of the flow f(k) that the plants receive, shape (n,)."""
        a1, a2, newer, older = self._coefficients
        response = a1 * self._response[0] + a2 * self._response[1]
        response = response + newer * flow + older * self._flow
        self._response.appendleft(response)
        self._flow = flow
        row = self._k % len(self._undelayed)
        self._undelayed[row, 0] = response
        self._undelayed[row, 1] = self._whiten_response(response)

    def _learn(self, whitened: Array) -> None:
        """Update sums and likelihoods by the newest whitened output."""
        regressors = self._regressors
        errors = whitened - self._gains * regressors
        self.innovation = np.einsum("dtn,dtn->n", self._weights, errors)
        np.square(errors, out=errors)
        square = np.einsum("dtn,dtn->n", self._weights, errors)
        errors *= 0.5 * CAUTION / self._variance
        self._log_likelihoods *= MODEL_MEMORY
        self._log_likelihoods -= errors
        rate = max(NOISE_RATE, 1.0 / (FIRST_NOISE_SAMPLES + self._k))
        square = np.minimum(square, OUTLIER * self._variance)
        variance = self._variance + rate * (square - self._variance)
        self._variance = np.maximum(variance, LEAST_NOISE**2).astype(np.float32)
        self._information *= GAIN_MEMORY
        self._information += np.square(regressors)
        self._products *= GAIN_MEMORY
        self._products += regressors * whitened

    def _design(self) -> None:
        """Renew gains and probabilities of the models, and the means over them."""
        prior = self._variance / self._gain_variance
        information = self._information + prior
        self._gains = np.clip((self._products + prior) / information, *GAINS)
        logarithms = self._log_likelihoods + self._prior
        logarithms -= logarithms.max((0, 1))
        self._weights = weights = np.exp(np.maximum(logarithms, UNLIKELY))
        weights /= weights.sum((0, 1))
        shares = weights.sum(0)
        delay, delay_spread = _moments(weights.sum(1), self._delays)
        log_constant, constant_spread = _moments(shares, self._logarithms)
        self.estimate = Estimate(
            shares=shares,
            delay=delay,
            delay_spread=delay_spread,
            log_constant=log_constant,
            constant_spread=constant_spread,
            pole=(shares * self._poles).sum(0),
            fading=np.einsum("dtn,dtn->n", weights, self._fading),
        )


def _moments(weights: Array, values: Array) -> tuple[Array, Array]:
    """Return mean and standard deviation of values over the first axis."""
    mean = (weights * values).sum(0)
    variance = (weights * np.square(values - mean)).sum(0)
    return mean, np.sqrt(variance)
