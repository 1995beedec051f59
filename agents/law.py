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
from agents.bank import LAGS, LEAST_NOISE, Bank, UndelayedModels
from agents.hedge import RandomSetpoint
from agents.output_filter import LOAD_CHANGES, OutputFilter

Array = NDArray[np.floating[Any]]

SHARE: Final = 0.5  # share of the way to the target that one sample covers, without a network
# Standard deviation of the error of a forecast over the delay, as a multiple of the standard
# deviation of the noise.
FORECAST_SPREAD: Final = 1.2
REACTION: Final = 2.0  # samples that the output takes, after the delay, to follow a flow
# Errors that are inputs of a network are limited to this multiple of the noise, as larger
# errors are outliers.
LARGEST_ERROR: Final = 12.0
# Added to the standard deviation of the noise, in units of the authority. Without it, tiny
# errors of the models would count as signals where there is hardly any noise.
MODEL_ERROR: Final = 0.002
# Delay, samples, and natural logarithm of the time constant in samples, of the paper's plant,
# equation (28). They centre the inputs of a network.
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
    """Target of the mean model's output at the time when the present flow shows, in units of
    the authority, shape (n,): the hedged set point (see `agents.hedge`) minus the forecast of
    the part of the output that the models do not explain."""
    shares: Array
    """Probabilities of the bank's time constants, shape (time constants, n)."""
    pole: Array
    """Pole of the mean model: the mean of exp(-1 / T) over the bank's time constants T in
    samples, shape (n,)."""
    gain: Array
    """Estimated gain of the plant, as a multiple of the step test's gain, shape (n,)."""
    gain_spread: Array
    """Standard deviation of `gain`, shape (n,)."""
    noise: Array
    """Standard deviation of the bank's one-step errors, plus `MODEL_ERROR`, in units of the
    authority, shape (n,)."""
    inputs: Array
    """Inputs of a network that come from the observer, shape (n, PAST_INPUTS)."""


class Observer:
    """The memory of n control loops: bank of models, Kalman filters, and age of the set point.

    The observer uses NumPy alone, so no gradient of PyTorch passes through it.

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
        The distribution of random set points, in units of the authority; None if nothing is
        known about changes of the set points.

    Attributes
    ----------
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
        self.filter = OutputFilter(bank.gain_spread)
        self._bank = bank
        self._edge = edge
        self._centre = (limits[0] + limits[1]) / 2.0
        self._random_setpoint = setpoint
        self._setpoint: Array | None = None
        self._age: Array = np.zeros(bank.n)  # samples since the set point changed
        self._k = 0

    def observe(self, setpoint: Array, output: Array) -> Situation:
        """Update the memory with a sample of each loop, and return the present situation.

        Call this method once per sample, before the flow is chosen.

        Parameters
        ----------
        setpoint
            Set points y_d(k), in units of the authority (see `agents.bank`), shape (n,).
        output
            Measured outputs y(k), in units of the authority, shape (n,).
        """
        bank = self._bank
        bank.observe(output)
        self.filter.update(output, bank.responses[:2], bank.pole, bank.variance)
        forecast = self.filter.forecast(bank.pole, bank.fading)
        # At the first sample, the set point counts as unchanged.
        is_unchanged = self._setpoint is None or setpoint == self._setpoint
        self._age = np.where(is_unchanged, self._age + 1.0, 0.0)
        self._setpoint = setpoint
        deviation = np.sqrt(bank.variance)
        held: Array = np.ones(bank.n)
        aim = setpoint
        if self._random_setpoint is not None:
            ahead = bank.delay + 1.0 + REACTION
            held = self._random_setpoint.probability_held(self._age, ahead)
            aim = self._random_setpoint.targets(setpoint, held, FORECAST_SPREAD * deviation)
        noise = deviation + MODEL_ERROR
        inputs = self._inputs(setpoint, output, aim, held, forecast, noise)
        self._k += 1
        return Situation(
            targets=(aim - forecast).astype(np.float32),
            shares=bank.shares,
            pole=bank.pole,
            gain=self.filter.gain.astype(np.float32),
            gain_spread=self.filter.gain_spread.astype(np.float32),
            noise=noise,
            inputs=inputs,
        )

    def _inputs(
        self,
        setpoint: Array,
        output: Array,
        aim: Array,
        held: Array,
        forecast: Array,
        noise: Array,
    ) -> Array:
        """Return the observer's inputs of a network, scaled to magnitudes of about 1.

        Parameters
        ----------
        setpoint
            Set points y_d(k), in units of the authority (see `agents.bank`), shape (n,).
        output
            Measured outputs y(k), in units of the authority, shape (n,).
        aim
            Hedged set points (see `agents.hedge`), in units of the authority, shape (n,).
        held
            Probabilities that the set points do not change before the present flow shows,
            shape (n,).
        forecast
            Forecasts of the part of the output that the models do not explain, in units of the
            authority, shape (n,).
        noise
            Standard deviations of one-step errors, plus `MODEL_ERROR`, in units of the
            authority, shape (n,).

        Returns
        -------
        ndarray of float32
            Shape (n, PAST_INPUTS).
        """
        bank = self._bank
        load = self.filter.load
        gain = self.filter.gain
        residuals = bank.outputs - gain * bank.responses
        signals = [
            # the set point
            setpoint,
            np.abs(setpoint),
            aim - setpoint,
            held,
            # the output, and what the models do not explain
            output,
            load,
            forecast - load,
            *_relative_errors(residuals, noise),
            _relative_errors(bank.innovation, noise),
            _relative_errors(self.filter.innovation, noise),
            # the estimates of filters and bank
            *self.filter.weights,
            3.0 * np.log(gain),
            5.0 * self.filter.gain_spread,
            (bank.delay - TYPICAL_DELAY) / 10.0,
            bank.delay_spread / 4.0,
            2.0 * (bank.log_constant - TYPICAL_LOG_CONSTANT),
            4.0 * bank.log_constant_spread,
            0.5 * np.log(noise) + 1.5,
            2.0 * bank.fading - 1.0,
            # the actuator, and the time since the start of the episode
            self._edge,
            self._centre,
            np.full(bank.n, min(self._k / 600.0, 2.0)),
            np.full(bank.n, min(self._k / 60.0, 1.0)),
        ]
        return np.stack(signals, axis=1).astype(np.float32)


def _relative_errors(errors: Array, noise: Array) -> Array:
    """Return half of errors / noise, after the ratios are limited to +-`LARGEST_ERROR`.

    `errors` have the shape (n,) or (lags, n), like the result, and `noise`, the standard
    deviations of the noise, the shape (n,).
    """
    ratios: Array = 0.5 * np.clip(errors / noise, -LARGEST_ERROR, LARGEST_ERROR)
    return ratios


class Law:
    """The control law of n control loops: it computes flows from a `Situation`.

    The mean model has the output m without delay, the gain g and the pole p. For the target r,
    the flow is

        f = (r + share (r - m) / (1 - p)) / g.

    The flow f is then moved out of the dead zone and limited. The term r / g is the flow that
    keeps m at r, and the other term closes a share of the gap r - m in one sample. A neural
    network can correct the control law by three outputs: an addition to r in units of the
    noise, a relative change of r in units of the gain's standard deviation, and half the logit
    of the share.

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
        self._lowest = convert(limits[0])
        self._highest = convert(limits[1])
        self._models = UndelayedModels(bank.time_constants, convert)

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
        xp, convert = self._xp, self._convert
        gain = convert(situation.gain)
        gains = gain * convert(situation.shares)  # factors of the models in the mean model
        model_output = (gains * self._models.outputs).sum(0)
        target = convert(situation.targets)
        share: Any = SHARE
        if network is not None:
            change = model_output - (gains * self._models.last_outputs).sum(0)
            outputs = network(self._inputs(situation, model_output, change))
            shift = outputs[:, 0]
            stretch = outputs[:, 1]
            half_logit = outputs[:, 2]
            # Without noise, the shift is 0, so that it leaves no offset.
            noise = convert(situation.noise - LEAST_NOISE - MODEL_ERROR)
            spread = convert(situation.gain_spread)
            target = target * (1.0 + spread * stretch) + noise * shift
            # The limits keep exp from an overflow.
            share = 1.0 / (1.0 + xp.exp(xp.clip(-2.0 * half_logit, -20.0, 20.0)))
        # The flow for `target` holds the output there, and the flow for `approach` closes a
        # share of the gap in one sample.
        rate = 1.0 - convert(situation.pole)
        approach = share / rate * (target - model_output)
        flow = self._passable((target + approach) / gain)
        self._models.advance(flow)
        return flow

    def _inputs(self, situation: Situation, model_output: Any, change: Any) -> Any:
        """Return all inputs of a network, with magnitudes of about 1, shape (n, INPUTS).

        `model_output` is the output of the mean model without delay, and `change` its change
        since the last sample, both in units of the authority, shape (n,).
        """
        xp = self._xp
        gap = self._convert(situation.targets) - model_output
        relative_gap = gap / (abs(gap) + 2.0 * self._convert(situation.noise))
        signals = [model_output, 10.0 * change, gap, self._models.last_flow, relative_gap]
        past_inputs = self._convert(situation.inputs)
        return xp.concatenate([past_inputs, xp.stack(signals, axis=1)], axis=1)

    def _passable(self, wanted: Any) -> Any:
        """Return wanted flows after they are moved out of the dead zone and limited.

        `wanted` and the returned flows are in units of half the actuator's range, shape (n,).
        In PyTorch, the move out of the dead zone counts as a constant for gradients.
        """
        constant = wanted.detach() if self._xp is not np else wanted
        move = avoid_dead_zone(constant, self._edge, self._xp) - constant
        return self._xp.clip(wanted + move, self._lowest, self._highest)

    def detach(self) -> None:
        """Cut the PyTorch graph, so that later gradients do not reach earlier flows."""
        models = self._models
        models.outputs = models.outputs.detach()
        models.last_outputs = models.last_outputs.detach()
        models.last_flow = models.last_flow.detach()
