"""Compute flows from the predictions of a bank of candidate models and of Kalman filters.

As in a Smith predictor, the models predict the effect of past flows that have not yet affected
the output. Kalman filters forecast the part of the output that the models do not explain. The
next flow moves the predicted output towards a target.

The control law runs both in NumPy and in PyTorch. In PyTorch, a neural network that corrects
the control law is trained by gradients. Quantities are dimensionless as in `agents.bank`: flows
are divided by half the flow range, temperatures by the steady temperature change for half the
flow range, and times by the sampling interval.
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

# Fraction `share` of the control law (see `Law`), without a network.
SHARE: Final = 0.5
# Standard deviation of the error of a forecast over the plant's delay, as a multiple of the
# standard deviation of the models' one-step prediction errors.
FORECAST_SPREAD: Final = 1.2
REACTION: Final = 2.0  # samples, after the delay, that the output takes to respond to a flow
# Limit of the errors that are inputs of a network, as a multiple of the noise's standard
# deviation. Larger errors are outliers.
LARGEST_ERROR: Final = 12.0
# Number that is added to the noise's standard deviation, in units of the steady temperature
# change for half the flow range. Without this addition, tiny model errors would be taken for
# signals on a plant with hardly any noise.
MODEL_ERROR: Final = 0.002
# Delay of the paper's plant, equation (28), in samples, and natural logarithm of this plant's
# time constant in samples. Two inputs of a network are differences from these two numbers.
TYPICAL_DELAY: Final = 18.0
TYPICAL_LOG_CONSTANT: Final = 3.0

# Numbers of inputs and outputs of a network that corrects the control law. `PAST_INPUTS` inputs
# come from `Observer`, and five inputs from the models and the last flow of `Law`.
PAST_INPUTS: Final = 21 + LAGS + len(LOAD_CHANGES)
INPUTS: Final = PAST_INPUTS + 5
OUTPUTS: Final = 3

# Function that maps network inputs, shape (n, INPUTS), to outputs, shape (n, OUTPUTS).
Network = Callable[[Any], Any]


@dataclass(frozen=True)
class Situation:
    """Estimates of n plants at one sample, from which the control law computes flows."""

    targets: Array
    """Target of the mean model's output when the present flow affects the output, shape (n,).
    The target is the hedged set point (see `agents.hedge`) minus the forecast of the part of
    the output that the models do not explain, in units of the steady temperature change for
    half the flow range."""
    shares: Array
    """Probabilities of the candidate time constants, shape (time constants, n)."""
    pole: Array
    """Estimated pole of the plant: the mean of exp(-1 / T) over the candidate time constants T
    in samples, with the probabilities of the time constants as weights, shape (n,)."""
    gain: Array
    """Estimated gain of the plant, divided by the gain that the step test measured, shape
    (n,)."""
    gain_spread: Array
    """Standard deviation of the estimated gain, in the unit of `gain`, shape (n,)."""
    noise: Array
    """Standard deviation of the models' one-step prediction errors, plus the constant
    `MODEL_ERROR`, in units of the steady temperature change for half the flow range, shape
    (n,)."""
    inputs: Array
    """Inputs of a correcting network that `Observer` computes, shape (n, PAST_INPUTS)."""


class Observer:
    """Estimator of the delays, gains and loads of n plants, by models and Kalman filters.

    The computation is in NumPy, so PyTorch gradients do not pass through the estimates.

    Parameters
    ----------
    bank
        Bank of candidate models for n plants at rest.
    dead_zone_edge
        Greatest possible half width of the dead zone, as a share of half the flow range, shape
        (n,); 0 for an actuator without a dead zone.
    limits
        Lowest and highest flow, as shares of half the flow range, each of shape (n,).
    setpoint
        Distribution of random set points, in units of the steady temperature change for half
        the flow range; None if the distribution is unknown.

    Attributes
    ----------
    filter : OutputFilter
        Kalman filters that estimate the gain and the load disturbance of each plant.
    """

    def __init__(
        self,
        bank: Bank,
        dead_zone_edge: Array,
        limits: tuple[Array, Array],
        setpoint: RandomSetpoint | None = None,
    ) -> None:
        self.filter = OutputFilter(bank.gain_spread)
        self._bank = bank
        self._dead_zone_edge = dead_zone_edge
        self._middle_flow = (limits[0] + limits[1]) / 2.0
        self._random_setpoint = setpoint
        self._setpoint: Array | None = None
        # Number of samples since the last change of the set point. Before a change, the number
        # of observations since the start of the episode.
        self._age: Array = np.zeros(bank.n)
        self._k = 0

    def observe(self, setpoint: Array, output: Array) -> Situation:
        """Return the estimates of the n plants from the set points and outputs of a sample.

        Call this method once per sample, before the flow of this sample is computed. In the
        returned `Situation`, the field `shares` has the shape (time constants, n), the field
        `inputs` the shape (n, PAST_INPUTS), and every other field the shape (n,).

        Parameters
        ----------
        setpoint
            Set points y_d(k), in units of the steady temperature change for half the flow
            range, shape (n,).
        output
            Measured outputs y(k), in the unit of `setpoint`, shape (n,).
        """
        bank = self._bank
        bank.observe(output)
        # `bank.responses` are mean outputs of the models with gain 1, newest first, shape
        # (LAGS, n). The Kalman filters need the mean outputs of this and of the previous
        # sample. `bank.fading` is the share of a deviation from the models that remains after
        # the delay, shape (n,).
        self.filter.update(output, bank.responses[:2], bank.pole, bank.variance)
        forecast = self.filter.forecast(bank.pole, bank.fading)
        # At the first sample of an episode, there is no earlier set point to differ from.
        is_unchanged = self._setpoint is None or setpoint == self._setpoint
        self._age = np.where(is_unchanged, self._age + 1.0, 0.0)
        self._setpoint = setpoint
        deviation = np.sqrt(bank.variance)
        # Probability that the set point does not change before the present flow affects the
        # output.
        held: Array = np.ones(bank.n)
        aim = setpoint
        if self._random_setpoint is not None:
            # Samples until the output has responded to the present flow.
            ahead = bank.delay + 1.0 + REACTION
            held = self._random_setpoint.probability_held(self._age, ahead)
            aim = self._random_setpoint.targets(setpoint, held, FORECAST_SPREAD * deviation)
        noise = deviation + MODEL_ERROR
        inputs = self._inputs(setpoint, output, aim, held, forecast, noise)
        self._k += 1
        return Situation(
            targets=(aim - forecast).astype(np.float32),
            shares=bank.shares,  # probabilities of the candidate time constants
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
        """Return the inputs of a correcting network that `Observer` computes, (n, PAST_INPUTS).

        A correcting network is a neural network that corrects the control law, and its inputs
        are of order 1. All arguments have the shape (n,), and temperatures are in units of the
        steady temperature change for half the flow range.

        Parameters
        ----------
        setpoint
            Set points y_d(k).
        output
            Measured outputs y(k).
        aim
            Hedged set points, from `RandomSetpoint.targets`.
        held
            Probabilities that the set points do not change before the present flows affect the
            outputs.
        forecast
            Forecasts of the part of the output that the models do not explain.
        noise
            Standard deviations of the models' one-step prediction errors, plus `MODEL_ERROR`.
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
            # the output, and the part of the output that the models do not explain
            output,
            load,
            forecast - load,
            *_relative_errors(residuals, noise),
            _relative_errors(bank.innovation, noise),
            _relative_errors(self.filter.innovation, noise),
            # the estimates of the Kalman filters and of the candidate models
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
            self._dead_zone_edge,
            self._middle_flow,
            np.full(bank.n, min(self._k / 600.0, 2.0)),
            np.full(bank.n, min(self._k / 60.0, 1.0)),
        ]
        return np.stack(signals, axis=1).astype(np.float32)


def _relative_errors(errors: Array, noise: Array) -> Array:
    """Return errors / (2 noise) in the shape of `errors`, clipped to +-`LARGEST_ERROR` / 2.

    `errors` have the shape (n,) or (lags, n). `noise` are standard deviations, shape (n,).
    """
    ratios: Array = 0.5 * np.clip(errors / noise, -LARGEST_ERROR, LARGEST_ERROR)
    return ratios


class Law:
    """The control law of n control loops, which computes flows from estimates of the plants.

    The mean of the candidate models has the gain g, the pole p and, without the delay, the
    output m. If the output shall reach a target r, the control law computes the flow f = (r +
    share (r - m) / (1 - p)) / g, with a number `share` from 0 to 1. Then the control law moves
    the flow f out of the dead zone, and clips f to the flow limits. The part r / g of the flow
    keeps the output m at the target r. For a model of first order, the other part of the flow
    closes the fraction `share` of the gap r - m between target and output in one sample. A
    neural network can correct the control law by three outputs:

    - a number that is added to the target r, in units of the noise's standard deviation less
      `LEAST_NOISE`,
    - a relative change of the target r, in units of the standard deviation of the estimated
      gain,
    - half the logit of the fraction `share`.

    Parameters
    ----------
    bank
        Bank of candidate models. The control law runs copies of the bank's models without
        delay, through which PyTorch gradients with respect to past flows can pass.
    dead_zone_edge
        Greatest possible half width of the dead zone, as a share of half the flow range, shape
        (n,); 0 for an actuator without a dead zone.
    limits
        Lowest and highest flow, as shares of half the flow range, each of shape (n,).
    xp
        Array module: `numpy`, or `torch` to compute gradients.
    convert
        Function that converts a NumPy array to an array of the module `xp`.
    """

    def __init__(
        self,
        bank: Bank,
        dead_zone_edge: Any,
        limits: tuple[Any, Any],
        xp: Any = np,
        convert: Callable[[Array], Any] = np.asarray,
    ) -> None:
        self._xp = xp
        self._convert = convert
        self._dead_zone_edge = convert(dead_zone_edge)
        self._lowest = convert(limits[0])
        self._highest = convert(limits[1])
        self._models = UndelayedModels(bank.time_constants, convert)

    def flow(self, situation: Situation, network: Network | None = None) -> Any:
        """Return the flows of a sample, as shares of half the flow range, shape (n,).

        Each flow is within the flow limits. If the flow limits are outside the dead zone, each
        flow is 0 or outside the dead zone. Call this method once per sample, as the call also
        updates the outputs of the models.

        Parameters
        ----------
        situation
            Estimates of the plants from `Observer.observe`.
        network
            Network that corrects the control law; None for the control law without corrections.
        """
        xp, convert = self._xp, self._convert
        gain = convert(situation.gain)
        gains = gain * convert(situation.shares)  # factors of the models' outputs in the mean
        model_output = (gains * self._models.outputs).sum(0)
        target = convert(situation.targets)
        share: Any = SHARE
        if network is not None:
            change = model_output - (gains * self._models.last_outputs).sum(0)
            outputs = network(self._inputs(situation, model_output, change))
            shift = outputs[:, 0]
            stretch = outputs[:, 1]
            half_logit = outputs[:, 2]
            # The shift is 0 for a plant without noise, and then causes no steady control error.
            noise = convert(situation.noise - LEAST_NOISE - MODEL_ERROR)
            spread = convert(situation.gain_spread)
            target = target * (1.0 + spread * stretch) + noise * shift
            # The exponent is clipped to prevent an overflow.
            share = 1.0 / (1.0 + xp.exp(xp.clip(-2.0 * half_logit, -20.0, 20.0)))
        # The flow target / gain keeps the output at the target. For a model of first order, the
        # flow approach / gain closes the fraction `share` of the gap to the target in one
        # sample.
        rate = 1.0 - convert(situation.pole)
        approach = share / rate * (target - model_output)
        flow = self._passable((target + approach) / gain)
        self._models.advance(flow)
        return flow

    def _inputs(self, situation: Situation, model_output: Any, change: Any) -> Any:
        """Return all inputs of the network that corrects the control law, shape (n, INPUTS).

        The inputs are of order 1. `model_output` is the mean output of the candidate models
        without delay, and `change` is the difference from its value at the previous sample,
        both of shape (n,), in units of the steady temperature change for half the flow range.
        """
        xp = self._xp
        gap = self._convert(situation.targets) - model_output
        relative_gap = gap / (abs(gap) + 2.0 * self._convert(situation.noise))
        signals = [model_output, 10.0 * change, gap, self._models.last_flow, relative_gap]
        past_inputs = self._convert(situation.inputs)
        return xp.concatenate([past_inputs, xp.stack(signals, axis=1)], axis=1)

    def _passable(self, wanted: Any) -> Any:
        """Return wanted flows, moved out of the dead zone and clipped to the flow limits.

        Flows are shares of half the flow range, shape (n,). For PyTorch gradients, the move out
        of the dead zone counts as a constant.
        """
        constant = wanted.detach() if self._xp is not np else wanted
        move = avoid_dead_zone(constant, self._dead_zone_edge, self._xp) - constant
        return self._xp.clip(wanted + move, self._lowest, self._highest)

    def detach(self) -> None:
        """Detach the models from the PyTorch graph, so that gradients end at this sample."""
        models = self._models
        models.outputs = models.outputs.detach()
        models.last_outputs = models.last_outputs.detach()
        models.last_flow = models.last_flow.detach()
