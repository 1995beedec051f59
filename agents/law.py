"""Choose flows by the predictions of a bank of models and of a filter.

As in a Smith predictor, the models predict the response to flows that are in transit. The
filter forecasts the part of the output that the models do not explain. The flow moves the
predicted output towards its target.

The control law is written once for two libraries: it runs in NumPy, and in PyTorch a network
that corrects it is trained. Quantities are scaled as in `agents.bank`.
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

SHARE: Final = 0.5  # of the way to the target that a sample covers, without a network
FORECAST_SPREAD: Final = 1.2  # error of a forecast over the delay, in units of the noise
REACTION: Final = 2.0  # samples after the delay, by which the output follows a flow
OUTLIER: Final = 12.0  # multiples of the noise, beyond which a network sees no difference
DOUBT: Final = 0.002  # of the authority, added to the noise that signals are divided by
TYPICAL_DELAY: Final = 18.0  # samples, that of (28)
TYPICAL_LOG_CONSTANT: Final = 3.0  # natural logarithm of its time constant in samples

# Of a network: what it sees of the past, and of the law's state; and what it corrects.
PAST_INPUTS: Final = 21 + LAGS + len(LOAD_CHANGES)
INPUTS: Final = PAST_INPUTS + 5
OUTPUTS: Final = 3

# From inputs, shape (n, INPUTS), to outputs, shape (n, OUTPUTS).
Network = Callable[[Any], Any]


@dataclass(frozen=True)
class Situation:
    """The knowledge of n loops at a sample, by which they choose their flows."""

    targets: Array
    """Wanted outputs of the models when the next flows show: the set point, hedged, less the
    forecast residual, shape (n,)."""
    estimate: Estimate
    gain: Array
    """Gain, as a multiple of the step test's, shape (n,)."""
    gain_spread: Array
    """Standard deviation of the gain, shape (n,)."""
    noise: Array
    """Standard deviation of one-step errors, plus `DOUBT`, of the authority, shape (n,)."""
    inputs: Array
    """Inputs of a network that do not depend on the present flow, shape (n, PAST_INPUTS)."""


class Observer:
    """The memory of n loops: the bank of models, the filter, and the age of the set point.

    The observer is NumPy alone, so no gradient passes through it.

    Parameters
    ----------
    bank
        The bank of models, for n loops at rest.
    edge
        Widest edge of the dead zone, of half the range, shape (n,); 0 without one.
    limits
        Lowest and highest flow, each of shape (n,).
    setpoint
        The distribution of random set points, with amplitudes as shares of the authority; None
        if nothing is known about changes of the set points.
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
        """Take the set points and outputs of a sample, of the authority, shape (n,).

        The situation that is returned includes them.
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
        """Return the inputs of a network from the past, shape (n, PAST_INPUTS).

        `aim` is the hedged set point, and `held` the probability that the set point stays.
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
    """Return half of signals that were divided by the noise, limited to `OUTLIER` times it."""
    limited: Array = 0.5 * np.clip(signals, -OUTLIER, OUTLIER)
    return limited


class Law:
    """The control law of n loops: from a situation to flows.

    With the mean model's output m, its gain g and its pole p, and the target r, the flow is

        f = (r + share (r - m) / (1 - p)) / g,

    moved out of the dead zone and limited. The first term holds m at r, and the second closes a
    share of the gap in one sample. A network, if there is one, has three outputs: an addition
    to r in units of the noise, a relative change of r in units of the gain's standard
    deviation, and half the logit of the share.

    Parameters
    ----------
    bank
        The bank, whose models without delay the law runs itself, so that gradients reach past
        flows.
    edge
        Widest edge of the dead zone, of half the range, shape (n,); 0 without one.
    limits
        Lowest and highest flow, each of shape (n,).
    xp, convert
        The array module, NumPy or PyTorch, and what makes its arrays from those of NumPy.
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
        # The undelayed responses of the models, those of a sample before, and the last flow.
        self._response = convert(np.zeros_like(bank.time_constants))
        self._before = self._response
        self._flow = convert(np.zeros(bank.n, np.float32))

    def flow(self, situation: Situation, network: Network | None = None) -> Any:
        """Return the flows of half the actuator's range, shape (n,).

        Each flow is 0 or passes the dead zone. Without a network, the control law is linear
        apart from the dead zone and the limits.
        """
        convert = self._convert
        estimate = situation.estimate
        gain = convert(situation.gain)
        gains = gain * convert(estimate.shares)
        rate = 1.0 - convert(estimate.pole)
        target = convert(situation.targets)
        model = (gains * self._response).sum(0)
        share: Any = SHARE
        if network is not None:
            slope = model - (gains * self._before).sum(0)
            outputs = network(self._inputs(situation, model, slope))
            excess = convert(situation.noise - LEAST_NOISE - DOUBT)
            spread = convert(situation.gain_spread)
            target = target * (1.0 + spread * outputs[:, 1]) + excess * outputs[:, 0]
            share = 1.0 / (1.0 + self._exp(-2.0 * outputs[:, 2]))
        return self._passing((target + share / rate * (target - model)) / gain)

    def _inputs(self, situation: Situation, model: Any, slope: Any) -> Any:
        """Return the inputs of a network, shape (n, INPUTS)."""
        xp = self._xp
        gap = self._convert(situation.targets) - model
        noise = self._convert(situation.noise)
        signals = [model, 10.0 * slope, gap, self._flow, gap / (abs(gap) + 2.0 * noise)]
        past = self._convert(situation.inputs)
        return xp.concatenate([past, xp.stack(signals, axis=1)], axis=1)

    def _exp(self, exponents: Any) -> Any:
        """Return exponentials, without an overflow where a network sees nonsense."""
        return self._xp.exp(self._xp.clip(exponents, -20.0, 20.0))

    def _passing(self, wanted: Any) -> Any:
        """Return flows that pass the dead zone and the limits, and let the models follow them.

        The gradient goes straight through the dead zone.
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
        """Cut the graph of PyTorch that leads to earlier flows."""
        self._response = self._response.detach()
        self._before = self._before.detach()
        self._flow = self._flow.detach()
