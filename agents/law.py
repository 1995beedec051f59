"""Choose flows by the predictions of a bank of models and of a Kalman filter.

As in a Smith predictor, the models predict the effect of flows that have not yet shown in the
output. The Kalman filter forecasts the part of the output that the models do not explain. The
next flow moves the predicted output towards a target.

The control law runs both in NumPy and in PyTorch. With PyTorch, a neural network that corrects
the control law is trained by gradients. Quantities are scaled as in `agents.bank`: flows by
half the actuator's range, temperatures by the authority, and times by the sampling interval.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from agents.actuator import avoid_dead_zone
from agents.bank import LAGS, LEAST_NOISE, Bank, Estimate, second_order
from agents.hedge import RandomSetpoint
from agents.output_filter import LOAD_CHANGES, OutputFilter

Array = NDArray[np.floating[Any]]

SHARE: Final = 0.5  # share of the way to the target that one sample covers, without a network
# Standard deviation of the error of a forecast over the delay, divided by that of the noise.
FORECAST_SPREAD: Final = 1.2
REACTION: Final = 2.0  # samples that the output takes, after the delay, to follow a flow
# Signals of a network are limited to this multiple of the noise, as larger ones are outliers.
OUTLIER: Final = 12.0
# Added to the noise before signals are divided by the noise, of the authority, so that tiny
# model errors are not taken for signals where there is hardly any noise.
DOUBT: Final = 0.002
# A typical delay, samples, and a typical natural logarithm of a time constant in samples: those
# of the plant, equation (28) of the paper. They centre the inputs of a network.
TYPICAL_DELAY: Final = 18.0
TYPICAL_LOG_CONSTANT: Final = 3.0

# Numbers of inputs and outputs of a network. `PAST_INPUTS` inputs come from the observer, and
# five more from the control law's models and last flow. The outputs correct the control law.
PAST_INPUTS: Final = 21 + LAGS + len(LOAD_CHANGES)
INPUTS: Final = PAST_INPUTS + 5
OUTPUTS: Final = 3

# A network maps inputs of shape (n, INPUTS), for n loops, to outputs of shape (n, OUTPUTS).
Network = Callable[[Any], Any]


@dataclass(frozen=True)
class Situation:
    """The knowledge about n control loops at a sample, by which flows are chosen."""

    targets: Array
    """Target of the mean model's output at the time when the present flow shows, of the
    authority, shape (n,): the hedged set point (see `agents.hedge`) minus the forecast of the
    part of the output that the models do not explain."""
    estimate: Estimate
    """The bank's estimates of delays and time constants."""
    gain: Array
    """Estimated gain of the plant, as a multiple of the step test's gain, shape (n,)."""
    gain_spread: Array
    """Standard deviation of `gain`, shape (n,)."""
    noise: Array
    """Standard deviation of the bank's one-step errors, plus `DOUBT`, of the authority, shape
    (n,)."""
    inputs: Array
    """Inputs of a network that come from the observer, shape (n, PAST_INPUTS)."""


class Observer:
    """The memory of n control loops: bank of models, Kalman filters, and age of the set point.

    The observer uses NumPy alone, so no gradient of PyTorch passes through the observer.

    Parameters
    ----------
    bank
        The bank of models, for n plants at rest.
    edge
        Greatest half width that the dead zone may have, as a share of half the actuator's
        range, shape (n,); 0 for an actuator without a dead zone.
    limits
        Lowest and highest flow, as shares of half the actuator's range, each of shape (n,).
    setpoint
        The distribution of random set points, with amplitudes as shares of the authority; None
        if nothing is known about changes of the set points.

    Attributes
    ----------
    bank : Bank
        The bank of models.
    filter : OutputFilter
        The Kalman filters of gain and load.
    """

    def __init__(
        self,
        bank: Bank,
        edge: Array,
        limits: tuple[Array, Array],
        setpoint: RandomSetpoint | None = None,
    ) -> None:
        self.bank = bank
        self.filter = OutputFilter(bank.gain_spread)
        self._edge = edge
        self._centre = (limits[0] + limits[1]) / 2.0
        self._random = setpoint
        self._age: Array = np.zeros(bank.n)  # samples since the set point changed
        self._setpoint: Array | None = None
        self._k = 0

    def observe(self, setpoint: Array, output: Array) -> Situation:
        """Update the memory with a sample of each loop, and return the present situation.

        Call this method once per sample, before the flow is chosen.

        Parameters
        ----------
        setpoint
            Set points y_d(k), of the authority, shape (n,).
        output
            Measured outputs y(k), of the authority, shape (n,).
        """
        bank = self.bank
        bank.observe(output)
        estimate = bank.estimate
        self.filter.update(output, bank.responses[:2], estimate.pole, bank.variance)
        forecast = self.filter.forecast(estimate.pole, estimate.fading)
        if self._setpoint is None:
            self._setpoint = setpoint
        self._age = np.where(setpoint == self._setpoint, self._age + 1.0, 0.0)
        self._setpoint = setpoint
        held: Array = np.ones(bank.n)
        aim = setpoint
        if self._random is not None:
            held = self._random.probability_held(self._age, estimate.delay + 1.0 + REACTION)
            aim = self._random.targets(setpoint, held, FORECAST_SPREAD * bank.noise)
        noise = bank.noise + DOUBT
        inputs = self._inputs(output, aim, held, forecast, noise)
        self._k += 1
        targets = (aim - forecast).astype(np.float32)
        gain = self.filter.gain.astype(np.float32)
        gain_spread = self.filter.gain_spread.astype(np.float32)
        return Situation(targets, estimate, gain, gain_spread, noise, inputs)

    def _inputs(
        self, output: Array, aim: Array, held: Array, forecast: Array, noise: Array
    ) -> Array:
        """Return the observer's inputs of a network, scaled to be of order 1.

        Parameters
        ----------
        output
            Measured outputs y(k), of the authority, shape (n,).
        aim
            Hedged set points, of the authority, shape (n,).
        held
            Probabilities that the set points do not change before the present flow shows,
            shape (n,).
        forecast
            Forecasts of the part of the output that the models do not explain, of the
            authority, shape (n,).
        noise
            Standard deviations of one-step errors, plus `DOUBT`, of the authority, shape (n,).

        Returns
        -------
        ndarray of float32
            Shape (n, PAST_INPUTS).
        """
        bank, estimate = self.bank, self.bank.estimate
        setpoint = self._setpoint
        assert setpoint is not None
        load, gain = self.filter.load, self.filter.gain
        residuals = bank.outputs - gain * bank.responses
        signals = [
            setpoint,
            np.abs(setpoint),
            aim - setpoint,
            held,
            output,
            load,
            forecast - load,
            *_limited(residuals / noise),
            _limited(bank.innovation / noise),
            _limited(self.filter.innovation / noise),
            *self.filter.weights,
            3.0 * np.log(gain),
            5.0 * self.filter.gain_spread,
            (estimate.delay - TYPICAL_DELAY) / 10.0,
            estimate.delay_spread / 4.0,
            2.0 * (estimate.log_constant - TYPICAL_LOG_CONSTANT),
            4.0 * estimate.constant_spread,
            0.5 * np.log(noise) + 1.5,
            2.0 * estimate.fading - 1.0,
            self._edge,
            self._centre,
            np.full(bank.n, min(self._k / 600.0, 2.0)),
            np.full(bank.n, min(self._k / 60.0, 1.0)),
        ]
        return np.stack(signals, axis=1).astype(np.float32)


def _limited(signals: Array) -> Array:
    """Return half of the signals, after limiting them to +-`OUTLIER`, in the same shape.

    `signals` are divided by the standard deviation of the noise.
    """
    limited: Array = 0.5 * np.clip(signals, -OUTLIER, OUTLIER)
    return limited


class Law:
    """The control law of n control loops: it computes flows from a `Situation`.

    The mean model has the output m without delay, the gain g and the pole p. For the target r,
    the flow is

        f = (r + share (r - m) / (1 - p)) / g,

    moved out of the dead zone and limited. The term r / g is the flow that keeps m at r, and
    the other term closes a share of the gap r - m in one sample. A neural network can correct
    the control law by three outputs: an addition to r in units of the noise, a relative change
    of r in units of the gain's standard deviation, and half the logit of the share.

    Parameters
    ----------
    bank
        The bank of models. The control law runs the bank's models without delay once more, so
        that the gradients of PyTorch reach past flows.
    edge
        Greatest half width that the dead zone may have, as a share of half the actuator's
        range, shape (n,); 0 for an actuator without a dead zone.
    limits
        Lowest and highest flow, as shares of half the actuator's range, each of shape (n,).
    xp
        The array module: NumPy, or PyTorch to compute gradients.
    convert
        Function that converts a NumPy array to an array of `xp`.
    """

    def __init__(
        self,
        bank: Bank,
        edge: Any,
        limits: tuple[Any, Any],
        xp: Any = np,
        convert: Callable[[Array], Any] = np.asarray,
    ) -> None:
        self._xp = xp
        self._convert = convert
        self._edge = convert(edge)
        self._low, self._high = map(convert, limits)
        self._coefficients = tuple(map(convert, second_order(bank.time_constants)))
        # Outputs of the models with gain 1 and no delay at the present and at the last sample,
        # shape (time constants, n), and the last flow, shape (n,).
        self._response = convert(np.zeros_like(bank.time_constants))
        self._before = self._response
        self._flow = convert(np.zeros(bank.n, np.float32))

    def flow(self, situation: Situation, network: Network | None = None) -> Any:
        """Return the flows of a sample, as shares of half the actuator's range, shape (n,).

        Each flow is 0 or passes the dead zone, and lies within the limits. The models advance
        by a sample with these flows, so call this method once per sample.

        Parameters
        ----------
        situation
            The knowledge about the loops at this sample, from `Observer.observe`.
        network
            The network that corrects the control law. Without a network, the control law is
            linear apart from the dead zone and the limits.
        """
        convert = self._convert
        estimate = situation.estimate
        gain = convert(situation.gain)
        gains = gain * convert(estimate.shares)
        rate = 1.0 - convert(estimate.pole)
        target = convert(situation.targets)
        model_output = (gains * self._response).sum(0)
        share: Any = SHARE
        if network is not None:
            slope = model_output - (gains * self._before).sum(0)
            outputs = network(self._inputs(situation, model_output, slope))
            shift = outputs[:, 0]
            stretch = outputs[:, 1]
            speed = outputs[:, 2]
            # Without noise, the shift is 0, so that it leaves no offset.
            noise = convert(situation.noise - LEAST_NOISE - DOUBT)
            spread = convert(situation.gain_spread)
            target = target * (1.0 + spread * stretch) + noise * shift
            share = 1.0 / (1.0 + self._exp(-2.0 * speed))
        # The flow for `target` holds the output there, and the flow for `approach` closes a
        # share of the gap in one sample.
        approach = share / rate * (target - model_output)
        return self._passing((target + approach) / gain)

    def _inputs(self, situation: Situation, model: Any, slope: Any) -> Any:
        """Return all inputs of a network, shape (n, INPUTS), of order 1.

        `model` is the output of the mean model without delay, and `slope` its change since the
        last sample, both of the authority, shape (n,). `flow` calls this method.
        """
        xp = self._xp
        gap = self._convert(situation.targets) - model
        noise = self._convert(situation.noise)
        signals = [model, 10.0 * slope, gap, self._flow, gap / (abs(gap) + 2.0 * noise)]
        past = self._convert(situation.inputs)
        return xp.concatenate([past, xp.stack(signals, axis=1)], axis=1)

    def _exp(self, exponents: Any) -> Any:
        """Return exp of `exponents`, which are limited to +-20 so that exp cannot overflow."""
        return self._xp.exp(self._xp.clip(exponents, -20.0, 20.0))

    def _passing(self, wanted: Any) -> Any:
        """Return wanted flows moved out of the dead zone and limited, and advance the models.

        `wanted` are the flows of the control law, as shares of half the actuator's range, shape
        (n,). For gradients, the move out of the dead zone is a constant (straight-through
        estimator).
        """
        xp = self._xp
        value = wanted.detach() if hasattr(wanted, "detach") else wanted
        passing = wanted + (avoid_dead_zone(value, self._edge, xp) - value)
        flow = xp.clip(passing, self._low, self._high)
        a1, a2, newer, older = self._coefficients
        response = a1 * self._response + a2 * self._before + newer * flow + older * self._flow
        self._before = self._response
        self._response = response
        self._flow = flow
        return flow

    def detach(self) -> None:
        """Cut the PyTorch graph, so that later gradients do not reach earlier flows."""
        self._response = self._response.detach()
        self._before = self._before.detach()
        self._flow = self._flow.detach()
