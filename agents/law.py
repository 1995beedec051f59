"""Control plants by what a bank of models predicts.

As in a Smith predictor, the response to past flows is known before the delay is over. What the
models do not explain, the *residual*, is a load that has to be forecast to the end of the
delay. The law is written once for NumPy, in which it runs, and PyTorch, in which a network that
corrects it is trained. Quantities are scaled as in `agents.bank`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from agents.actuator import avoid_dead_zone
from agents.bank import Bank, Estimate, second_order

Array = NDArray[np.floating[Any]]

# Weights of the newest sample in running means of the load: over 3 to 100 samples.
LOAD_RATES: Final = np.array([[0.3], [0.1], [0.03], [0.01]], np.float32)
# The same of the residual: over 1 to 4 samples, as far as noise is to be averaged.
RESIDUAL_RATES: Final = np.array([[1.0], [0.5], [0.25]], np.float32)
# Logarithms of the means' shares in the forecast, which the network changes.
LOAD_PREFERENCE: Final = np.array([-2.0, -1.0, 1.0, 0.0], np.float32)
RESIDUAL_PREFERENCE: Final = np.array([-1.0, 1.0, 0.0], np.float32)
APPROACH: Final = -0.7  # logit of the share of the way to the target that a sample should cover
OUTLIER: Final = 12.0  # multiples of the noise, beyond which a network sees no difference
DOUBT: Final = 0.002  # of the authority, added to the noise that signals are divided by
HEDGED: Final = 0.03  # of the authority, noise above which a hedge gains something
# Where there is less noise than this, of the authority, nothing is to be filtered: the newest
# samples tell most, and the law is linear, with these additions to the preferences.
CALM: Final = 0.04
CALM_LOAD: Final = np.array([6.0, 0.0, -3.0, -3.0], np.float32)
CALM_RESIDUAL: Final = np.array([2.0, -2.0, -2.0], np.float32)
LONGEST_HOLD: Final = 300.0  # samples, age of a set point beyond which it is not counted
TYPICAL_DELAY: Final = 18.0  # samples, that of (28)
TYPICAL_LOG_CONSTANT: Final = 3.0  # natural logarithm of its time constant in samples

PAST_INPUTS: Final = 34
INPUTS: Final = PAST_INPUTS + 5
OUTPUTS: Final = 5 + len(LOAD_RATES) + len(RESIDUAL_RATES)

# From inputs, shape (n, INPUTS), to outputs, shape (n, OUTPUTS), which are `Corrections`.
Network = Callable[[Any], Any]


@dataclass(frozen=True)
class Situation:
    """What n loops have seen so far, by which they choose their flows."""

    setpoint: Array
    estimate: Estimate
    noise: Array
    """Standard deviation of one-step errors and `DOUBT`, of the authority."""
    residuals: Array
    """Running means of the residual, shape (3, n)."""
    loads: Array
    """Running means of the load, shape (4, n)."""
    inputs: Array
    """What a network sees of it, shape (n, PAST_INPUTS)."""


@dataclass(frozen=True)
class Corrections:
    """What a network changes in the law; all are 0 in the linear law. Shape (n,) or (n, m)."""

    forecast: Any
    """Addition to the forecast of the residual, in units of the noise."""
    share: Any
    """Addition to the logit of the share of the way to the target that a sample covers."""
    flow: Any
    """Addition to the flow."""
    gain: Any
    """Logarithm of a factor of the flow."""
    hedge: Any
    """Share by which the target falls short of the set point, which may change before the
    flow shows."""
    load: Any
    """Additions to `LOAD_PREFERENCE`."""
    residual: Any
    """Additions to `RESIDUAL_PREFERENCE`."""

    @classmethod
    def of(cls, outputs: Any) -> Corrections:
        """Return those of a network's outputs, shape (n, OUTPUTS).

        The factors make a change of 1 in any output matter about as much as in the others.
        """
        first_residual = 5 + len(LOAD_RATES)
        return cls(
            forecast=outputs[:, 0],
            share=2.0 * outputs[:, 1],
            flow=0.3 * outputs[:, 2],
            gain=0.5 * outputs[:, 3],
            hedge=outputs[:, 4],
            load=2.0 * outputs[:, 5:first_residual],
            residual=2.0 * outputs[:, first_residual:],
        )


class Observer:
    """The memory of the law without gradients: bank, loads, age of the set point."""

    def __init__(self, bank: Bank, edge: Array, limits: tuple[Array, Array]) -> None:
        self.bank = bank
        self._edge = edge
        self._centre = (limits[0] + limits[1]) / 2.0
        self._loads = np.zeros((len(LOAD_RATES), bank.n), np.float32)
        self._residuals = np.zeros((len(RESIDUAL_RATES), bank.n), np.float32)
        self._age = np.zeros(bank.n, np.float32)
        self._newest_residual = np.zeros(bank.n, np.float32)
        self._setpoint: Array | None = None
        self._k = 0

    def observe(self, setpoint: Array, output: Array) -> Situation:
        """Take set points and outputs of a sample, shape (n,), and return the situation."""
        bank = self.bank
        bank.observe(output)
        estimate = bank.estimate
        if self._setpoint is None:
            self._setpoint = setpoint
        self._age = np.where(setpoint == self._setpoint, self._age + 1.0, 0.0)
        self._setpoint = setpoint
        # Since the last sample, the mean model may have changed, and the residual with it.
        changed = bank.residuals[1] - self._newest_residual
        self._newest_residual = bank.residuals[0]
        self._residuals = self._residuals + changed
        self._residuals += RESIDUAL_RATES * (bank.residuals[0] - self._residuals)
        residual = (bank.residuals[0] + bank.residuals[1]) / 2.0
        before = (bank.residuals[1] + bank.residuals[2]) / 2.0
        # The steady load that would have moved the residual like this.
        load = before + (residual - before) / estimate.rate
        innovation = load - self._loads[0]
        self._loads = self._loads + LOAD_RATES * (load - self._loads)
        noise = bank.noise + DOUBT
        inputs = self._inputs(setpoint, output, noise, innovation)
        self._k += 1
        return Situation(setpoint, estimate, noise, self._residuals, self._loads, inputs)

    def _inputs(self, setpoint: Array, output: Array, noise: Array, innovation: Array) -> Array:
        """Return what a network sees of the past, shape (n, PAST_INPUTS)."""
        bank, loads, estimate = self.bank, self._loads, self.bank.estimate
        trends = (loads[:-1] - loads[1:]) / np.sqrt(LOAD_RATES[:-1])
        age = np.minimum(self._age, LONGEST_HOLD) / 100.0
        signals = [
            setpoint,
            output,
            *loads,
            *_limited(bank.residuals / noise),
            *_limited(self._residuals[1:] / noise),
            _limited(bank.innovation / noise),
            _limited(innovation * estimate.rate / noise),
            *_limited(trends * estimate.rate / noise),
            3.0 * np.log(estimate.gain),
            5.0 * estimate.gain_spread,
            (estimate.delay - TYPICAL_DELAY) / 10.0,
            estimate.delay_spread / 4.0,
            2.0 * (estimate.log_constant - TYPICAL_LOG_CONSTANT),
            4.0 * estimate.constant_spread,
            0.5 * np.log(noise) + 1.5,
            2.0 * estimate.fading - 1.0,
            self._edge,
            self._centre,
            age,
            np.maximum(age - 1.0, 0.0),
            2.0 * np.maximum(age - 2.0, 0.0),
            4.0 * np.maximum(age - 2.5, 0.0),
            np.abs(setpoint),
            np.full_like(setpoint, min(self._k / 600.0, 2.0)),
            np.full_like(setpoint, min(self._k / 60.0, 1.0)),
        ]
        return np.stack(signals, axis=1).astype(np.float32)


def _limited(signals: Array) -> Array:
    """Return half of signals that were divided by the noise, limited to `OUTLIER` times it."""
    limited: Array = 0.5 * np.clip(signals, -OUTLIER, OUTLIER)
    return limited


class Law:
    """The law of n loops: from what they have seen, and a network's corrections, to flows.

    The target is the set point less the forecast of the residual, which fades to the load over
    the delay. The flow holds the model's output at the target, and moves it there by a share a
    sample. A network corrects this; see `Corrections`.

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
        self._load_preference = convert(LOAD_PREFERENCE)
        self._residual_preference = convert(RESIDUAL_PREFERENCE)
        self._calm_load, self._calm_residual = convert(CALM_LOAD), convert(CALM_RESIDUAL)
        # The undelayed responses of the models, their last ones, and the last flow.
        self._response = convert(np.zeros_like(bank.time_constants))
        self._before = self._response
        self._flow = convert(np.zeros(bank.n, np.float32))

    def flow(self, situation: Situation, network: Network) -> Any:
        """Return the flows, shape (n,), which pass the dead zone or are 0."""
        xp, convert, estimate = self._xp, self._convert, situation.estimate
        gains, gain, fading = map(convert, (estimate.gains, estimate.gain, estimate.fading))
        noise, setpoint = convert(situation.noise), convert(situation.setpoint)
        loads, residuals = convert(situation.loads), convert(situation.residuals)
        model = (gains * self._response).sum(0)
        slope = model - (gains * self._before).sum(0)
        gap = setpoint - fading * residuals[1] - (1.0 - fading) * loads[2] - model
        signals = [model, 10.0 * slope, gap, self._flow, gap / (abs(gap) + 2.0 * noise)]
        past = convert(situation.inputs)
        inputs = xp.concatenate([past, xp.stack(signals, axis=1)], axis=1)
        calm = (1.0 / (1.0 + (noise / CALM) ** 6))[:, None]
        corrections = Corrections.of((1.0 - calm) * network(inputs))

        load_logits = corrections.load + self._load_preference + calm * self._calm_load
        load = self._mean(loads, load_logits)
        residual_logits = corrections.residual + self._residual_preference
        residual = self._mean(residuals, residual_logits + calm * self._calm_residual)
        forecast = fading * residual + (1.0 - fading) * load + noise * corrections.forecast
        hedge = corrections.hedge * noise**2 / (noise**2 + HEDGED**2)
        target = setpoint * (1.0 - hedge) - forecast
        share = 1.0 / (1.0 + self._exp(-corrections.share - APPROACH))
        wanted = (target + share / convert(estimate.rate) * (target - model)) / gain
        wanted = wanted * self._exp(corrections.gain) + corrections.flow
        return self._passing(wanted)

    def _exp(self, exponents: Any) -> Any:
        """Return exponentials, without an overflow where a network sees nonsense."""
        return self._xp.exp(self._xp.clip(exponents, -20.0, 20.0))

    def _mean(self, values: Any, logits: Any) -> Any:
        """Return the mean of values, shape (m, n), by their logits, shape (n, m)."""
        shares = self._exp(logits)
        return (shares * values.T).sum(1) / shares.sum(1)

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
