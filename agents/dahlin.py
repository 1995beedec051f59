"""Implement Dahlin's controller: internal model control with a first-order response."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.polynomial.polynomial import polysub
from numpy.typing import NDArray

from agents.controller import Index, NotNegative, Positive, Values
from agents.internal_model import InternalModelController

Array = NDArray[np.float64]


@dataclass(eq=False, kw_only=True)
class DahlinController(InternalModelController):
    """A controller that makes the output approach the set point like a first-order lag.

    E. B. Dahlin, "Designing and tuning digital controllers", Instruments and Control Systems
    41 (6), 1968, 77-83. It is written here as internal model control (M. Morari and E.
    Zafiriou, "Robust Process Control", 1989, chapter 3), with g = 1 - exp(-h / lambda) and
    f = 1 - exp(-h / T_f) for the sampling interval h:

    - A model of first order, x(k+1) = p x(k) + b u_a(k), runs beside the plant; x(k-d) is what
      the plant should show now.
    - D is the estimated disturbance: the measured output less the output of the model, after a
      low-pass filter: D(k) = D(k-1) + f (y(k) - x(k-d) - D(k-1)).
    - The command is the one that moves the model a share g of its way to y_d - D:
      u(k) = ((1 - p) x(k) + g (y_d(k) - D(k) - x(k))) / b.

    A command inside the dead zone is moved to 0 or to the edge of the zone, whichever is
    nearer. There is no integral: the model has the flow u_a that the actuator passes, so that
    nothing winds up.

    The other parameters are those of `ModelBasedController`.

    Parameters
    ----------
    closed_loop_time_constant
        lambda, time constant of the response to the set point, s. With a large lambda, the
        commands for small errors stay inside the dead zone and have no effect. The controller
        then does not correct errors up to 0.5 |gain| dead_zone lambda / time_constant, degC.
    filter_time_constant
        T_f, time constant of the filter of the disturbance, s. It sets the robustness of the
        loop without changing the response to the set point; 0 for no filter, as in 1968.
    setpoint_index, error_index
        Indices of y_d(k) and e(k), degC, in the observation.
    """

    closed_loop_time_constant: Positive
    filter_time_constant: NotNegative = 0.0
    setpoint_index: Index = 0
    error_index: Index = 3

    def __post_init__(self) -> None:
        super().__post_init__()
        self.n_obs = max(self.setpoint_index, self.error_index) + 1
        self._approach = -math.expm1(-self.sampling_interval / self.closed_loop_time_constant)
        self._filter = 1.0
        if self.filter_time_constant > 0.0:
            self._filter = -math.expm1(-self.sampling_interval / self.filter_time_constant)

    def reset(self) -> None:
        """Return the model and the estimate of the disturbance to rest."""
        super().reset()
        self._disturbance: Values = np.float64(0.0)  # D, degC

    def transfer(self) -> tuple[Array, Array]:
        """Return the transfer function from -y to u, valid away from limits and dead zone.

        The set point is 0, where -y is the error. The coefficients are those of
        `PIController.transfer`.
        """
        share = self._approach * self._filter
        numerator = share * np.array([1.0, -self._pole])
        to_setpoint = np.array([1.0, self._approach - 1.0])
        smoothed = np.convolve(to_setpoint, [1.0, self._filter - 1.0])
        in_transit = np.append(np.zeros(self._delay), share)
        return numerator, self._input_gain * polysub(smoothed, in_transit)

    def _control(self, rows: Array) -> Array:
        setpoint = rows[:, self.setpoint_index]
        output = setpoint - rows[:, self.error_index]
        residual = output - self._delayed
        self._disturbance = self._disturbance + self._filter * (residual - self._disturbance)
        now = self._undelayed
        move = self._approach * (setpoint - self._disturbance - now)
        command = self._passable(((1.0 - self._pole) * now + move) / self._input_gain)
        self._advance(command)
        return command
