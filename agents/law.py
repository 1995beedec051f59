"""Compute flows from the predictions of a bank of candidate models and of Kalman filters.

As in a Smith predictor, the models predict the effect of past flows that have not yet affected
the output. Kalman filters forecast the part of the output that the models do not explain. The
next flow moves the predicted output towards a target.

Quantities are dimensionless as in `agents.bank`: flows are divided by half the flow range,
temperatures by the steady temperature change for half the flow range, and times by the interval
between two changes of the command.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mptc_gym.plant.actuator import avoid_dead_zone

from .bank import Bank
from .hedge import RandomSetpoint
from .output_filter import OutputFilter

Array = NDArray[np.floating[Any]]

# Fraction of the gap between output and target that a flow closes in one sample.
SHARE: Final = 0.5
# Standard deviation of the error of a forecast over the plant's delay, as a multiple of the
# standard deviation of the models' one-step prediction errors.
FORECAST_SPREAD: Final = 1.2
REACTION: Final = 2.0  # samples, after the delay, that the output takes to respond to a flow


class Law:
    """The control law of n control loops, which estimates the plants and computes flows.

    The mean of the candidate models has the gain g, the pole p and, without the delay, the
    output m. The target r of the output m is the set point minus the forecast of the part of
    the output that the models do not explain; the set point is hedged if its distribution is
    known (see `agents.hedge`). The control law computes the flow f = (r + `SHARE` (r - m) / (1
    - p)) / g. The part r / g of the flow keeps the output m at the target r. For a model of
    first order, the other part of the flow closes the fraction `SHARE` of the gap r - m in one
    sample. Then the control law moves the flow f out of the dead zone, and clips f to the flow
    limits.

    Parameters
    ----------
    bank
        Bank of candidate models for n plants at rest.
    n
        Number of plants.
    dead_zone_edge
        Greatest possible half width of the dead zone, as a share of half the flow range; 0 for
        an actuator without a dead zone.
    limits
        Lowest and highest flow, as shares of half the flow range.
    random_setpoint
        Distribution of random set points, in units of the steady temperature change for half
        the flow range; None if the distribution is unknown.

    Attributes
    ----------
    output_filter : OutputFilter
        Kalman filters that estimate the gains and load disturbances of the plants.
    """

    def __init__(
        self,
        bank: Bank,
        n: int,
        dead_zone_edge: float,
        limits: tuple[float, float],
        random_setpoint: RandomSetpoint | None,
    ) -> None:
        self._bank = bank
        self.output_filter = OutputFilter(n)
        self._dead_zone_edge = np.float32(dead_zone_edge)  # so that flows remain float32
        self._limits = limits
        self._random_setpoint = random_setpoint
        self._setpoint: Array | None = None
        # Number of samples since the last change of the set point. Before the first change, the
        # number of observations since the start of the episode.
        self._age: Array = np.zeros(n)

    def flow(self, setpoint: Array, output: Array) -> Array:
        """Return the flows of a sample, as shares of half the flow range, shape (n,).

        Each flow is within the flow limits. If the flow limits are outside the dead zone, each
        flow is 0 or outside the dead zone. Call this method once per sample, as the call also
        updates all estimates.

        Parameters
        ----------
        setpoint
            Set points y_d(k), in units of the steady temperature change for half the flow
            range, shape (n,), in float32.
        output
            Measured outputs y(k), in the unit of `setpoint`, shape (n,), in float32.
        """
        bank = self._bank
        bank.observe(output)  # before all else, as the following lines use the new estimates
        self.output_filter.update(output, bank.responses, bank.pole, bank.variance)
        forecast = self.output_filter.forecast(bank.pole, bank.fading)
        target = (self._hedged(setpoint) - forecast).astype(np.float32)  # r
        gain = self.output_filter.gain.astype(np.float32)  # g
        model_output = (gain * bank.shares * bank.models.outputs).sum(0)  # m
        approach = SHARE / (1.0 - bank.pole) * (target - model_output)
        wanted = (target + approach) / gain
        flow: Array = np.clip(avoid_dead_zone(wanted, self._dead_zone_edge), *self._limits)
        bank.apply(flow)  # moves the models on to the next sample
        return flow

    def _hedged(self, setpoint: Array) -> Array:
        """Return the outputs at which the flows of this sample aim, shape (n,).

        `setpoint` are the set points y_d(k), shape (n,), and the returned outputs have the same
        unit.
        """
        # At the first sample of an episode, there is no earlier set point to differ from.
        is_unchanged = self._setpoint is None or setpoint == self._setpoint
        self._age = np.where(is_unchanged, self._age + 1.0, 0.0)
        self._setpoint = setpoint
        if self._random_setpoint is None:
            return setpoint
        # Samples until the output has responded to the present flow, and probability that the
        # set point does not change before.
        ahead = self._bank.delay + 1.0 + REACTION
        held = self._random_setpoint.probability_held(self._age, ahead)
        deviations = FORECAST_SPREAD * np.sqrt(self._bank.variance)
        return self._random_setpoint.targets(setpoint, held, deviations)
