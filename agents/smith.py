"""Implement a Smith predictor: a PI controller in front of a model without delay."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.polynomial.polynomial import polyadd
from numpy.typing import NDArray

from agents.actuator import applied_flow
from agents.controller import Flag, ModelBasedController, Number, Positive, Values
from agents.pi import PIController

Array = NDArray[np.float64]


@dataclass(eq=False, kw_only=True)
class SmithPredictor(ModelBasedController, PIController):
    """A PI controller on the error that an undelayed model of the plant predicts.

    A first-order model with a delay runs in parallel with the plant. Its undelayed output minus
    its delayed output is the effect of the inputs that are still in transit. The controller
    acts on the error minus this effect. As far as the model is right, it acts as if there were
    no delay (O. J. M. Smith, "Closer control of loops with dead time", Chemical Engineering
    Progress 53, 1957, 217-219).
    The gains are SIMC's for the plant without delay, with anti-windup. The model sees the
    command as the actuator passes it, after the dead zone and the limits.

    The other parameters are those of `ModelBasedController`, and `error_index`.

    Parameters
    ----------
    closed_loop_time_constant
        Time constant of the closed loop without the delay, s.
    """

    closed_loop_time_constant: Positive
    kp: Number = field(init=False)
    ki: Number = field(init=False)
    anti_windup: Flag = field(init=False, default=True)

    def __post_init__(self) -> None:
        rule = PIController.simc(
            gain=self.gain,
            time_constant=self.time_constant,
            delay=0.0,
            closed_loop_time_constant=self.closed_loop_time_constant,
            sampling_interval=self.sampling_interval,
        )
        self.kp, self.ki = rule.kp, rule.ki
        super().__post_init__()
        self._edge = self.dead_zone
        self._pole = math.exp(-self.sampling_interval / self.time_constant)
        self._input_gain = self.gain * (1.0 - self._pole)
        self._delay = max(round(self._delay_samples), 1)

    def reset(self) -> None:
        """Set the integral to zero, and return the model to rest."""
        super().reset()
        self._model: list[Values] = []  # its last undelayed outputs, newest last

    def transfer(self) -> tuple[Array, Array]:
        """Return the transfer function from e to u, valid away from limits and dead zone.

        It is that of the PI controller with the undelayed minus the delayed model fed back
        around it, in the coefficients of `PIController.transfer`.
        """
        pi, integral = super().transfer()
        model = np.array([0.0, self._input_gain]), np.array([1.0, -self._pole])
        ahead = np.zeros(self._delay)  # 1 - z^-(delay - 1): inputs in transit
        ahead[0] += 1.0
        ahead[-1] -= 1.0
        outgoing = np.convolve(integral, model[1])
        returning = np.convolve(np.convolve(pi, model[0]), ahead)
        return np.convolve(pi, model[1]), polyadd(outgoing, returning)

    def _control(self, rows: Array) -> Array:
        model = self._model or [np.float64(0.0)] * self._delay
        now, delayed = model[-1], model[0]
        foreseen = rows.copy()
        foreseen[:, self.error_index] -= now - delayed
        command = super()._control(foreseen)
        applied = applied_flow(command, self.dead_zone, self.u_min, self.u_max)
        self._model = [*model[1:], self._pole * now + self._input_gain * applied]
        return command
