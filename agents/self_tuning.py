"""Implement a self-tuning controller, which identifies the plant while controlling it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from agents.actuator import applied_flow, avoid_dead_zone
from agents.controller import Count, Index, ModelBasedController, Positive

Array = NDArray[np.float64]

# Time constants in the bank, as multiples of the step test's; the average lies between them.
TIME_CONSTANTS = (0.5, 0.7, 1.0, 1.4, 2.0)
# Dead zones in the bank: offsets from the given one, and their prior standard deviation, as
# shares of the larger limit.
ZONES = (-0.5, -0.3, -0.2, -0.1, 0.0, 0.1, 0.2, 0.3)
ZONE_SPREAD = 0.2
NOISE_SAMPLES = 30.0  # weight of the expected noise, in samples: the first errors are few
GAINS = (0.3, 3.0)  # estimates stay between these multiples of the step test's gain
# Pole of the prefilter, which removes dynamics that are too fast for first-order models.
PREFILTER_POLE = 0.6
LEAST_NOISE = 0.02  # degC; smaller errors come from the models' low order, and tell nothing
EXCITED = 0.05  # of half the range: a flow that moves less does not show the gain
MEMORY = 20  # samples before the longest delay in which a movement still shows: a time constant
BIAS_RATE = 0.005  # per sample, of the offset estimate: slow, so as not to fight the loop
DISTURBANCE_POLE = 0.5  # of the disturbance filter: noise of one sample moves the valve little
UNLIKELY = -60.0  # logarithm of a probability that is as good as 0: tiny floats are slow
MOST_DELAY = 10_000  # samples; with more, the bank would be too large for any computer
_ROOM = 64  # samples until the histories are shifted back: at each sample it would be slow


@dataclass(eq=False, kw_only=True)
class SelfTuningController(ModelBasedController):
    """A predictive controller that identifies the plant while controlling it.

    *Identification.* A bank holds one model `y(k) = g s(k - d)` for each combination of a delay
    d, a time constant and a dead zone; s is the response of a first-order plant, with gain 1
    and no delay, to the flow that this dead zone and the limits let pass. The gains g are
    estimated by recursive least squares with exponential forgetting, on prefiltered signals. A
    model's probability depends on how well it fits and how close it is to the step test. The
    controller uses the average of all models (D. T. Magill, "Optimal adaptive estimation of
    sampled stochastic processes", IEEE Transactions on Automatic Control 10, 1965, 434-439).

    *Control.* As in a Smith predictor, the model predicts the output at the end of the delay.
    What it misses now, the disturbance, is added. It decays over the delay like the plant's own
    response, except for its slow mean: the offset that a steady load leaves fades with about
    200 samples. The command is `u = s + K (y_d - predicted output)`, where K makes the error
    decay with the requested time constant. The flow after the actuator moves s, which replaces
    an integral, so nothing winds up.

    *Safeguards* (K. J. Astrom and B. Wittenmark, "Adaptive Control", 2nd edition, 1995,
    chapter 11). The step test's gain is a prior that is never forgotten: without new
    information, estimates return to it (M. E. Salgado, G. C. Goodwin and R. H. Middleton,
    "Modified least squares algorithm incorporating exponential resetting and forgetting",
    International Journal of Control 47, 1988, 477-491). While the flow stands still, nothing is
    learnt and nothing is forgotten. All models are stable, and keep the sign of the gain. A new
    design is adopted gradually.

    The other parameters are those of `ModelBasedController`.

    Parameters
    ----------
    dead_zone
        Best guess of the half width of the actuator's dead zone, t/h. The bank holds this one
        and up to seven around it; for the default of 0, three above it.
    shortest_delay_samples, longest_delay_samples
        Delays that the plant may have, in samples, at most 10,000; like `delay`, they include
        the one sample that any input takes to show.
    closed_loop_time_constant
        Time constant of the closed loop, as a share of the identified one of the plant.
    forgetting
        Forgetting factor per sample, above 0 and at most 1; 1 forgets nothing.
    setpoint_index, error_index
        Indices of y_d(k) and e(k), degC, in the observation.
    """

    shortest_delay_samples: Count = 7
    longest_delay_samples: Count = 37
    closed_loop_time_constant: Positive = 0.15
    forgetting: Positive = 0.996
    setpoint_index: Index = 0
    error_index: Index = 3

    _precision: ClassVar[Any] = np.float64  # of the bank
    _delay_step = 2  # samples between neighbouring delays in the bank
    _clearance = 0.2  # t/h by which commands clear the dead zone
    # How fast the control law follows the evidence.
    _every = 10  # samples between designs
    _share = 0.5  # of a new design that is adopted
    _caution = 0.5  # factor of the log-likelihood, as the errors are not quite white
    # Uncertainty of the step test: standard deviations of the gain, as a share of it, of the
    # delay, in samples, and of the time constant's logarithm.
    _gain_spread, _delay_spread, _time_constant_spread = 0.5, 8.0, 0.5
    _noise = 0.5  # degC, expected
    # Zero of the prefilter: 0.92 whitens the noise; closer to 1, a load change is less likely
    # to be mistaken for a different gain.
    _prefilter_zero = 0.92

    def __post_init__(self) -> None:
        super().__post_init__()
        self.n_obs = max(self.setpoint_index, self.error_index) + 1
        least, most = self.shortest_delay_samples, self.longest_delay_samples
        if not least <= most <= MOST_DELAY:
            allowed = f"from shortest_delay_samples = {least} to {MOST_DELAY:,}"
            raise ValueError(f"longest_delay_samples must be {allowed}, got {most!r}")
        if self.forgetting > 1.0:
            raise ValueError(f"forgetting must be above 0, up to 1, got {self.forgetting!r}")
        limit = max(abs(self.u_min), abs(self.u_max))
        zones = self.dead_zone + limit * np.array(ZONES)
        self._zones = zones[(zones == self.dead_zone) | (zones >= 0.0) & (zones < limit)]

        # Undelayed responses differ in dead zone and pole, models also in delay, the longest
        # one first, as in the history of the responses.
        self._delays = np.arange(most - 1, least - 2, -self._delay_step)  # d in (28)
        nominal = self.time_constant / self.sampling_interval
        self._constants = np.tile(nominal * np.array(TIME_CONSTANTS), len(self._zones))
        self._poles = np.exp(-1.0 / self._constants)
        self._dead_zones = np.repeat(self._zones, len(TIME_CONSTANTS))
        fading = self._poles ** self._delays[:, np.newaxis]
        self._fading = fading.ravel().astype(self._precision)
        off_delay = (self._delays - (self._delay_samples - 1.0)) / self._delay_spread
        off_constant = np.log(self._constants / nominal) / self._time_constant_spread
        off_zone = (self._dead_zones - self.dead_zone) / (ZONE_SPREAD * limit)
        off = np.square(off_delay)[:, np.newaxis] + np.square(off_constant) + off_zone**2
        # Log-probabilities, up to a constant.
        self._prior = -0.5 * off.ravel().astype(self._precision)
        self._history = most - 1 + max(MEMORY, self._every) + 2

    @property
    def estimates(self) -> dict[str, Array]:
        """Current estimates of the plants, averaged over the models, each of shape (batch,).

        `gain` (degC per t/h), `time_constant` (s), `delay` (s, as in the constructor) and
        `dead_zone` (t/h, the most likely one). Empty before the first observation.
        """
        if not self._loops:
            return {}
        constant, delay = self._by_response @ self._constants, self._by_delay @ self._delays
        return {
            "gain": self._sums.sum(1),
            "time_constant": constant * self.sampling_interval,
            "delay": (delay + 1.0) * self.sampling_interval,
            "dead_zone": self._zone.copy(),
        }

    def reset(self) -> None:
        """Forget the episode and what was learnt: the next plant may be different."""
        super().reset()
        self._loops = 0  # unknown before the first observation

    def _start(self, loops: int) -> None:
        """Set all signals to rest, and the models to the results of the step test."""
        zeros = partial(np.zeros, dtype=self._precision)
        models, size = (loops, len(self._prior)), self._history + 1
        self._loops, self._samples, self._now = loops, 0, size - 1
        # Undelayed responses of unit gain, plain and prefiltered, (loops, time, responses); the
        # flow within the limits, t/h, (loops, time).
        shape = loops, size + _ROOM, len(self._poles)
        self._units: Any = zeros(shape)
        self._filtered: Any = zeros(shape)
        self._flows: Any = zeros(shape[:2])
        # The last outputs, newest first, prefiltered outputs, newest last, the outputs' offset
        # and the predicted disturbance, degC.
        self._outputs = np.zeros((loops, 3))
        self._filtered_outputs = zeros((loops, self._every))
        self._bias, self._disturbance = np.zeros(loops), np.zeros(loops)
        # Sums over the past: squared regressors, regressors times outputs, squared outputs, and
        # the number of samples.
        self._information, self._products = zeros(models), zeros(models)
        self._energy, self._seen = zeros((loops, 1)), zeros((loops, 1))
        # The design: noise variance, model probabilities, and gains times probabilities.
        self._variance = zeros((loops, 1)) + self._noise**2
        self._weights, self._gains = zeros(models), zeros(models)
        self._design(1.0)

    def _learn(self) -> None:
        """Add the last samples to the sums of the loops whose flow has moved."""
        interval = self._every
        flows = self._flows[:, self._now - self._history : self._now]
        moved = flows.max(1) - flows.min(1) > EXCITED * (self.u_max - self.u_min) / 2.0
        gate = moved.astype(self._precision)[:, np.newaxis]
        for total in (self._information, self._products, self._energy, self._seen):
            total *= 1.0 - gate * (1.0 - self.forgetting**interval)
        outputs = self._filtered_outputs * gate
        information, products = map(self._by_model, (self._information, self._products))
        longest, shortest = int(self._delays[0]), int(self._delays[-1])
        oldest = self._now - longest - interval + 1
        filtered = self._filtered[:, oldest : self._now - shortest + 1]
        squares = np.square(filtered)
        squares *= gate[:, :, np.newaxis]
        for i in range(interval):
            delayed = slice(i, i + longest - shortest + 1, self._delay_step)
            products += filtered[:, delayed] * outputs[:, i, np.newaxis, np.newaxis]
            information += squares[:, delayed]
        self._energy += np.square(outputs).sum(1, keepdims=True)
        self._seen += interval * gate

    def _design(self, share: float) -> None:
        """Weight the models by the evidence, and adopt a share of the resulting design."""
        # As few passes over all models as can be: they take most of the time.
        prior = self._variance / (self._gain_spread * self.gain) ** 2
        information = self._information + prior
        products = self._products + prior * self.gain
        gains = products / information
        scores = products * gains  # what each model takes from the sum of squared outputs
        left = self._energy + prior * self.gain**2 - scores.max(1, keepdims=True)
        scores *= 0.5 * self._caution / self._variance
        scores += self._prior
        scores -= scores.max(1, keepdims=True)
        weights = np.exp(np.maximum(scores, UNLIKELY, out=scores))
        weights *= share / weights.sum(1, keepdims=True)
        least = np.maximum(left, LEAST_NOISE**2 * self._seen)
        self._variance = (least + NOISE_SAMPLES * self._noise**2) / (self._seen + NOISE_SAMPLES)

        np.clip(gains, *sorted(self.gain * multiple for multiple in GAINS), out=gains)
        weighted = weights * gains
        squares = dot(weighted, gains) + dot(weights, self._variance / information)
        # Variance over all gains, as a share of the square of their mean.
        self._gain_variance = share * squares / np.square(weighted.sum(1)) - 1.0
        for adopted, design in ((self._weights, weights), (self._gains, weighted)):
            adopted *= 1.0 - share
            adopted += design

        # Averages over the models, for the control law.
        self._trust = np.einsum("ij,j->i", self._weights, self._fading)
        weights, gains = map(self._by_model, (self._weights, self._gains))
        delays, responses = (np.ones(size, self._precision) for size in weights.shape[1:])
        self._by_response, self._by_delay = delays @ weights, weights @ responses
        self._sums = delays @ gains
        rates = self._sums * (1.0 - self._poles)
        rate = rates.sum(1)
        self._shares = rates / rate[:, np.newaxis]
        constant = self._sums.sum(1) / rate  # of the average plant, samples
        self._feedback = -np.expm1(-1.0 / (self.closed_loop_time_constant * constant)) / rate
        by_zone = self._by_response.reshape(self._loops, len(self._zones), -1).sum(2)
        self._zone = self._zones[by_zone.argmax(1)]

    def _control(self, rows: Array) -> Array:
        if not self._loops:
            self._start(len(rows))
        setpoint = rows[:, self.setpoint_index]
        output = setpoint - rows[:, self.error_index]
        filtered = self._filter(self._filtered_outputs[:, -1], output, self._outputs[:, 0])
        self._outputs = np.column_stack([output, self._outputs[:, :-1]])
        latest = [self._filtered_outputs[:, 1:], filtered.astype(self._precision)]
        self._filtered_outputs = np.column_stack(latest)
        self._samples += 1
        if self._samples % self._every == 0:
            self._learn()
            self._design(self._share)

        edge = np.where(self._zone > 0.0, self._zone + self._clearance, 0.0)
        command: Array = avoid_dead_zone(self._law(setpoint), edge)
        self._apply(command)
        return command

    def _law(self, setpoint: Array) -> Array:
        """Return the wanted command, t/h."""
        output = self._outputs[:, 0]
        models = (self._by_model(self._gains) * self._delayed(0)).reshape(self._loops, -1)
        off = output - models.sum(1)
        self._bias = self._bias + BIAS_RATE * (off - self._bias)
        fading = self._trust * (output - self._bias) - models @ self._fading
        self._disturbance += (1.0 - DISTURBANCE_POLE) * (fading - self._disturbance)
        response = self._units[:, self._now]
        foreseen = dot(self._sums, response) + self._bias + self._disturbance
        command: Array = dot(self._shares, response)
        command += self._feedback * (setpoint - foreseen)
        return command

    def _delayed(self, ago: int) -> Array:
        """Return the models' outputs at gain 1 some samples ago, (loops, delays, responses)."""
        first, last = self._now - self._delays[[0, -1]] - ago
        delayed: Array = self._units[:, first : last + 1 : self._delay_step]
        return delayed

    def _apply(self, command: Array) -> None:
        """Update the undelayed responses with a command."""
        now, column = self._now, command[:, np.newaxis]
        if now + 1 == self._units.shape[1]:
            for history in (self._units, self._filtered, self._flows):
                history[:, :-_ROOM] = history[:, _ROOM:].copy()
            now -= _ROOM
        before, self._now = self._units[:, now], now + 1
        self._flows[:, now] = np.clip(command, self.u_min, self.u_max)
        applied = applied_flow(column, self._dead_zones, self.u_min, self.u_max)
        units = self._poles * before + (1.0 - self._poles) * applied
        self._units[:, now + 1] = units
        self._filtered[:, now + 1] = self._filter(self._filtered[:, now], units, before)

    def _filter(self, filtered: Array, new: Array, before: Array) -> Array:
        """Return the next sample of the prefilter."""
        return PREFILTER_POLE * filtered + new - self._prefilter_zero * before

    def _by_model(self, values: Array) -> Array:
        """Return values of the models with shape (loops, delays, undelayed responses)."""
        return values.reshape(self._loops, len(self._delays), -1)


def dot(first: Array, second: Array) -> Array:
    """Return the dot products of corresponding rows."""
    products: Array = np.einsum("ij,ij->i", first, second)
    return products
