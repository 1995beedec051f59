"""A self-tuning controller: it identifies the plant while it controls it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agents.controller import (
    PAPER_WINDOWS,
    Index,
    NotNegative,
    Positive,
    ToldController,
    Values,
    check_count,
)

Array = NDArray[np.float64]

# Time constants in the bank, as multiples of the step test's.
TIME_CONSTANTS = (0.5, 0.7, 1.0, 1.4, 2.0)
# Dead zones in the bank: what is added to the told one, and how sure that is, as shares of the
# larger limit.
ZONES = (-0.5, -0.3, -0.2, -0.1, 0.0, 0.1, 0.2, 0.3)
ZONE_SPREAD = 0.2
NOISE_SAMPLES = 30.0  # that the expected noise is worth
GAINS = (0.3, 3.0)  # estimates stay between these multiples of the step test's gain
# Of the prefilter of what is compared: takes out what is too quick for models of first order.
PREFILTER_POLE = 0.6
LEAST_NOISE = 0.02  # degC; smaller errors tell no model from another
EXCITED = 0.05  # of half the range: the flow has to have moved by it to be learnt from
MEMORY = 20  # samples before the longest delay, in which it has to have moved
DELAY_STEP = 2  # samples between two delays of the bank
BIAS_RATE = 0.005  # a sample, of the offset's estimate
DISTURBANCE_POLE = 0.5  # of the filter of the disturbance
CLEARANCE = 0.2  # t/h that a command passes a dead zone by
MOST_DELAY = 10_000  # samples: beyond it, the bank would be too large for any computer
_ROOM = 64  # samples until the histories are moved back


@dataclass(eq=False, kw_only=True)
class SelfTuningController(ToldController):
    """A predictive controller that identifies the plant while it controls it.

    *Identification.* There is a bank of models, one for each combination of a delay d, a time
    constant and a dead zone: `y(k) = g s(k - d)`. Here s is what a plant of first order, with
    gain 1 and no delay, makes of the flow that this dead zone and the limits let pass. The gain
    g of each model is estimated by recursive least squares with exponential forgetting, on
    prefiltered signals. A model's probability follows from how well it fits the output and
    how near it is to the step test. The controller uses the average of all models
    (D. T. Magill, "Optimal adaptive estimation of sampled stochastic processes", IEEE
    Transactions on Automatic Control 10, 1965, 434-439).

    *Control.* As in a Smith predictor, the model foresees the output at the end of the delay.
    The disturbance, by which the output differs from the model, is added. It fades over the
    delay as the plant's own response would; only its slow mean does not, so that no
    steady error remains. The command is `u = s + K (y_d - foreseen output)`, with K such that
    the error decays with the time constant that is asked for. The response s takes the place of
    an integral. It is the response to the flow that has passed the actuator, so nothing winds
    up. A command within the dead zone, the most likely one, is moved to its edge or to 0,
    whichever is nearer.

    *Safeguards* (K. J. Astrom and B. Wittenmark, "Adaptive Control", 2nd edition, 1995,
    chapter 11):

    - The step test's gain is a prior that is never forgotten. So the covariance is bounded, and
      an estimate that gets no new information returns to it (M. E. Salgado, G. C. Goodwin and
      R. H. Middleton, "Modified least squares algorithm incorporating exponential resetting and
      forgetting", International Journal of Control 47, 1988, 477-491).
    - While the flow stands still, nothing is learnt and nothing is forgotten.
    - All models are stable. Their gains have the sign of the step test's, and stay between 0.3
      and 3 times that.
    - Certainty comes from evidence: with none, the controller is that of the step test. Errors
      below 0.02 degC are no evidence, and a new design is taken over gradually.
    """

    dead_zone: NotNegative = 5.0
    """The actuator's, as far as is known, t/h. The bank has this one and up to seven around
    it."""
    shortest_delay: Index = 6
    """Of the delays that the plant may have, d in samples: an input shows after d + 1."""
    longest_delay: Index = 36
    """Of these delays."""
    closed_loop_time_constant: Positive = 0.15
    """As a share of the plant's, whatever that is found to be."""
    forgetting: Positive = 0.996
    """What a sample leaves of the weight of those before it; up to 1, which forgets nothing."""
    setpoint_index: Index = 0
    """Where the observation holds y_d(k), degC."""
    error_index: Index = 3
    """Where it holds e(k), degC."""

    observation = PAPER_WINDOWS  # that the default indices are for

    # How fast evidence becomes control.
    _every = 10  # samples between two designs
    _share = 0.5  # of a design that is taken over
    _caution = 0.5  # factor of the log-likelihood, as the errors are not quite white
    # How sure the step test is: standard deviations of the gain, as a share of it, of the
    # delay, samples, and of the time constant's logarithm.
    _gain_spread, _delay_spread, _time_constant_spread = 0.5, 8.0, 0.5
    _noise = 0.5  # degC, that is expected
    # Of the prefilter of what is compared: 0.92 makes the noise white; nearer to 1, a load that
    # changes is taken less for another gain.
    _prefilter_zero = 0.92

    def __post_init__(self) -> None:
        super().__post_init__()
        self.n_obs = max(self.setpoint_index, self.error_index) + 1
        shortest = self.shortest_delay
        longest = check_count("longest_delay", self.longest_delay, shortest, MOST_DELAY)
        if self.forgetting > 1.0:
            raise ValueError(f"forgetting must be above 0, up to 1, got {self.forgetting!r}")
        limit = max(abs(self.u_min), abs(self.u_max))
        zones = self.dead_zone + limit * np.array(ZONES)
        self._zones = zones[(zones == self.dead_zone) | (zones >= 0.0) & (zones < limit)]

        # Responses without delay differ by dead zone and pole, models by delay, too: the
        # longest one first, as in the history of the responses.
        self._delays = np.arange(longest, shortest - 1, -DELAY_STEP)
        told = self.time_constant / self.sampling_interval
        self._constants = np.tile(told * np.array(TIME_CONSTANTS), len(self._zones))
        self._poles = np.exp(-1.0 / self._constants)
        self._dead_zones = np.repeat(self._zones, len(TIME_CONSTANTS))
        self._fading = (self._poles ** self._delays[:, np.newaxis]).ravel()
        off_delay = (self._delays - (self._delay_samples - 1.0)) / self._delay_spread
        off_constant = np.log(self._constants / told) / self._time_constant_spread
        off_zone = (self._dead_zones - self.dead_zone) / (ZONE_SPREAD * limit)
        off = np.square(off_delay)[:, np.newaxis] + np.square(off_constant) + off_zone**2
        self._prior = -0.5 * off.ravel()  # log-probability, but for a constant
        self._excited = EXCITED * (self.u_max - self.u_min) / 2.0
        self._history = longest + max(MEMORY, self._every) + 2
        self._loops = 0  # not known before the first observation

    @property
    def estimates(self) -> dict[str, Array]:
        """What is thought of the plants now, the mean over the models, each of shape (batch,).

        `gain` (degC per t/h), `time_constant` (s), `delay` (s, as in the constructor) and
        `dead_zone` (t/h, the most likely one). Empty before the first observation.
        """
        if not self._loops:
            return {}
        by_mode, by_delay = (self._by_model(self._weights).sum(axis) for axis in (1, 2))
        return {
            "gain": self._gains.sum(1),
            "time_constant": (by_mode * self._constants).sum(1) * self.sampling_interval,
            "delay": ((by_delay * self._delays).sum(1) + 1.0) * self.sampling_interval,
            "dead_zone": self._zone.copy(),
        }

    def reset(self) -> None:
        """Forget the episode and what was learnt: the next plant may be another."""
        super().reset()
        self._loops = 0

    def _start(self, loops: int) -> None:
        """Bring everything to rest, and the models to what the step test has shown."""
        models, size = (loops, len(self._prior)), self._history + 1
        self._loops, self._samples, self._now = loops, 0, size - 1
        # Responses without delay, of unit gain, and the same prefiltered, (loops, time,
        # responses); the flow within the limits, t/h, (loops, time).
        shape = loops, size + _ROOM, len(self._poles)
        self._units, self._filtered = np.zeros(shape), np.zeros(shape)
        self._flows = np.zeros(shape[:2])
        # The last outputs, newest first, prefiltered ones, newest last, the outputs' offset and
        # the disturbance that is foreseen, degC.
        self._outputs, self._filtered_outputs = (
            np.zeros((loops, 3)),
            np.zeros((loops, self._every)),
        )
        self._bias, self._disturbance = np.zeros(loops), np.zeros(loops)
        # Sums over the past: of squared regressors, of regressors times outputs, of squared
        # outputs and of the samples themselves.
        self._information, self._products = np.zeros(models), np.zeros(models)
        self._energy, self._seen = np.zeros((loops, 1)), np.zeros((loops, 1))
        # The design: the noise, and the probabilities of the models and, times these, gains.
        self._variance = np.full((loops, 1), self._noise**2)
        self._weights, self._gains = np.zeros(models), np.zeros(models)
        self._design(1.0)

    def _learn(self) -> None:
        """Add the last samples to the sums, of those loops whose flow has moved."""
        interval = self._every
        flows = self._flows[:, self._now - self._history : self._now]
        moved = flows.max(1) - flows.min(1) > self._excited
        gate = moved.astype(float)[:, np.newaxis]
        kept = 1.0 - gate * (1.0 - self.forgetting**interval)
        outputs = self._filtered_outputs * gate
        information = self._by_model(self._information)
        products = self._by_model(self._products)
        self._information *= kept
        self._products *= kept
        longest, shortest = int(self._delays[0]), int(self._delays[-1])
        oldest = self._now - longest - interval + 1
        filtered = self._filtered[:, oldest : self._now - shortest + 1]
        squares = np.square(filtered) * gate[:, :, np.newaxis]
        for i in range(interval):
            delayed = slice(i, i + longest - shortest + 1, DELAY_STEP)
            products += filtered[:, delayed] * outputs[:, i, np.newaxis, np.newaxis]
            information += squares[:, delayed]
        self._energy *= kept
        self._energy += np.square(outputs).sum(1, keepdims=True)
        self._seen *= kept
        self._seen += interval * gate

    def _design(self, share: float) -> None:
        """Weigh the models by what was seen, and take over a share of what they ask for."""
        prior = self._variance / (self._gain_spread * self.gain) ** 2
        information = self._information + prior
        products = self._products + prior * self.gain
        gains = products / information
        errors = self._energy + prior * self.gain**2 - products * gains  # sums of squares
        weights = self._prior - (0.5 * self._caution) * errors / self._variance
        weights -= weights.max(1, keepdims=True)
        np.exp(weights, out=weights)
        weights /= weights.sum(1, keepdims=True)
        least = np.maximum(errors.min(1, keepdims=True), LEAST_NOISE**2 * self._seen)
        self._variance = (least + NOISE_SAMPLES * self._noise**2) / (self._seen + NOISE_SAMPLES)

        gains = np.clip(gains / self.gain, *GAINS) * self.gain  # the direction stays
        spread = np.square(gains) + self._variance / information
        mean = (weights * gains).sum(1)
        # Of all gains, as a share of the square of their mean.
        self._gain_variance = (weights * spread).sum(1) / np.square(mean) - 1.0
        self._weights += share * (weights - self._weights)
        self._gains += share * (weights * gains - self._gains)

        # Averages over the models of what the control law needs.
        self._faded = self._gains * self._fading
        self._trust = np.einsum("ij,j->i", self._weights, self._fading)
        self._sums = self._by_model(self._gains).sum(1)
        rates = self._sums * (1.0 - self._poles)
        rate = rates.sum(1)
        self._shares = rates / rate[:, np.newaxis]
        constant = self._sums.sum(1) / rate  # of the average plant, samples
        self._feedback = -np.expm1(-1.0 / (self.closed_loop_time_constant * constant)) / rate
        by_zone = self._by_model(self._weights).sum(1)
        by_zone = by_zone.reshape(self._loops, len(self._zones), -1).sum(2)
        self._zone = self._zones[by_zone.argmax(1)]

    def _control(self, observation: Array) -> Values:
        rows = np.atleast_2d(observation)
        if not self._loops:
            self._start(len(rows))
        setpoint = rows[:, self.setpoint_index]
        output = setpoint - rows[:, self.error_index]
        filtered = self._filter(self._filtered_outputs[:, -1], output, self._outputs[:, 0])
        self._outputs = np.column_stack([output, self._outputs[:, :-1]])
        self._filtered_outputs[:, :-1] = self._filtered_outputs[:, 1:].copy()
        self._filtered_outputs[:, -1] = filtered
        self._samples += 1
        if self._samples % self._every == 0:
            self._learn()
            self._design(self._share)

        command = self._beyond_the_dead_zone(self._law(setpoint))
        self._apply(command)
        return command if observation.ndim == 2 else command[0]

    def _law(self, setpoint: Array) -> Array:
        """Return the command that is wanted, t/h."""
        output, delayed = self._outputs[:, 0], self._delayed(0)
        off = output - _dot(self._gains, delayed)
        self._bias = self._bias + BIAS_RATE * (off - self._bias)
        fading = self._trust * (output - self._bias) - _dot(self._faded, delayed)
        self._disturbance += (1.0 - DISTURBANCE_POLE) * (fading - self._disturbance)
        response = self._units[:, self._now]
        foreseen = _dot(self._sums, response) + self._bias + self._disturbance
        command: Array = _dot(self._shares, response)
        command += self._feedback * (setpoint - foreseen)
        return command

    def _delayed(self, ago: int) -> Array:
        """Return what each model of gain 1 made of the output some samples ago."""
        return self._units[:, self._now - self._delays - ago].reshape(self._loops, -1)

    def _beyond_the_dead_zone(self, command: Array) -> Array:
        """Move what lies within the dead zone to its edge or to 0, whichever is nearer."""
        edge = np.where(self._zone > 0.0, self._zone + CLEARANCE, 0.0)
        size = np.abs(command)
        moved = np.where(size < edge / 2.0, 0.0, np.copysign(edge, command))
        return np.where(size < edge, moved, command)

    def _apply(self, command: Array) -> None:
        """Let the models without delay respond to a command."""
        flow = np.clip(command, self.u_min, self.u_max)
        column = flow[:, np.newaxis]
        applied = column * (np.abs(column) >= self._dead_zones)
        now = self._now
        units = self._poles * self._units[:, now] + (1.0 - self._poles) * applied
        filtered = self._filter(self._filtered[:, now], units, self._units[:, now])
        self._flows[:, now] = flow
        if now + 1 == self._units.shape[1]:
            for history in (self._units, self._filtered, self._flows):
                history[:, : self._history] = history[:, _ROOM + 1 :].copy()
            now = self._history - 1
        self._now = now = now + 1
        self._units[:, now] = units
        self._filtered[:, now] = filtered

    def _filter(self, filtered: Array, new: Array, before: Array) -> Array:
        """Return the next sample of the prefilter."""
        return PREFILTER_POLE * filtered + new - self._prefilter_zero * before

    def _by_model(self, values: Array) -> Array:
        """Return what there is of each model by loop, delay and response without delay."""
        return values.reshape(self._loops, len(self._delays), -1)


def _dot(first: Array, second: Array) -> Array:
    """Return the products of rows with rows."""
    products: Array = np.einsum("ij,ij->i", first, second)
    return products
