"""Combine a trained network with a bank of models that identifies the plant."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from agents.actuator import applied_flow
from agents.controller import NotNegative, Positive
from agents.neural_law import NOMINAL, Law, LawNetwork, Prior
from agents.self_tuning import SelfTuningController, dot

Array = NDArray[np.float64]

MOST_UNCERTAIN = 0.3  # for the network, which was trained up to 0.4


@dataclass(eq=False, kw_only=True)
class NeuralSelfTuningController(SelfTuningController):
    """A self-tuning controller whose control law is a trained network.

    The bank of models replaces the nominal model of a `NeuralSmithPredictor`, and the spread of
    the bank its uncertainty. New estimates are adopted within a few samples: the network was
    trained on models that are wrong, and knows how wrong they may be.

    The other parameters are those of `SelfTuningController`, except for
    `closed_loop_time_constant`. Its bank is in float32, like the network: a loop in a batch can
    differ from a single one by rounding.

    Parameters
    ----------
    network
        The weights; by default those that come with the project.
    aggressiveness
        How much quicker the law is than the network asks for, which was trained with fixed
        models: the residual of a changing one is sooner out of date. It fades where the plant
        is calm, as it would only move the valve there. 0 halves the valve travel in noise.
    """

    forgetting: Positive = 0.999
    network: LawNetwork = field(default_factory=LawNetwork.load, repr=False)
    aggressiveness: NotNegative = 0.75
    closed_loop_time_constant: float = field(init=False, default=0.15)

    # Chosen by error and valve travel on drawn plants. What moves the valve of a calm plant is
    # that models take turns: with every second delay alone no model fits a plant in between,
    # and designs that change by leaps show as loads.
    _precision = np.float32  # twice as fast, and the same error to 1e-6 degC
    _delay_step, _every, _share, _clearance = 1, 1, 0.6, 0.05
    _caution, _noise = 1.0, 0.25
    _gain_spread, _delay_spread, _time_constant_spread = 0.25, 6.0, 0.3
    _prefilter_zero = 0.965

    def __post_init__(self) -> None:
        super().__post_init__()
        self._half = (self.u_max - self.u_min) / 2.0
        self._flow = self._half * np.sign(self.gain)  # t/h at a flow of 1

    def _informed(self, before: Array) -> Law:
        """Return the law, updated with the bank's estimates."""
        gain = self._sums.sum(1)
        authority = np.abs(gain) * self._half
        unit = (self._sums * (1.0 - self._poles)).sum(1) / gain
        delay = self._by_delay @ self._delays
        prior = Prior(
            unit=unit,
            fading=self._trust * (1.0 - unit) ** 1.5,
            time_constant=np.clip(1.0 / unit / NOMINAL, 0.3, 3.3),
            delay=np.minimum(delay, 44.0),
            dead_zone=self._zone / self._half,
            centre=np.full(self._loops, (self.u_max + self.u_min) / 2.0 / self._flow),
            uncertainty=np.minimum(self._spread(delay), MOST_UNCERTAIN),
        )
        if self._samples == 1:
            self._rule = Law(prior, aggressiveness=self.aggressiveness)
        else:
            missed = (before - self._residual) / authority
            self._rule.adopt(prior, self._authority / authority, missed)
        self._authority: Array = authority  # of the bank's model, degC
        return self._rule

    def _spread(self, delay: Array) -> Array:
        """Return the bank's uncertainty, as that of the natural logarithm of the gain."""
        constants = np.log(self._constants)
        constant = self._by_response @ constants
        of_constant = self._by_response * (constants - constant[:, np.newaxis]) ** 2
        of_delay = self._by_delay * (self._delays - delay[:, np.newaxis]) ** 2
        variance = of_constant.sum(1) / 1.5**2 + of_delay.sum(1) / 20.0**2
        spread: Array = np.sqrt((variance + self._gain_variance) / 3.0)
        return spread

    def _law(self, setpoint: Array) -> Array:
        gains = self._by_model(self._gains)
        off = [
            self._outputs[:, ago] - np.einsum("ldr,ldr->l", gains, self._delayed(ago))
            for ago in range(3)
        ]
        # First-order models miss fast dynamics, which the average of two samples reduces.
        residual, before = (off[0] + off[1]) / 2.0, (off[1] + off[2]) / 2.0
        rule = self._informed(before)
        load = residual - (1.0 - rule.prior.unit) * before
        self._residual = residual
        now, last = (
            dot(self._sums, self._units[:, self._now - ago]) / self._authority
            for ago in range(2)
        )
        flow = self._flows[:, self._now - 1]
        passed = applied_flow(flow, self._zone, self.u_min, self.u_max) / self._flow
        wanted = rule.flow(
            self.network,
            setpoint / self._authority,
            residual / self._authority,
            load / self._authority,
            (now, last, passed),
        )
        command: Array = self._flow * wanted
        return command
