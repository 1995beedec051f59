"""Implement Dahlin's controller: the closed loop follows set points like a first-order lag."""

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

    The controller is that of Dahlin, "Designing and tuning digital controllers", Instruments
    and Control Systems 41 (6), 1968, 77-83, written as internal model control (Morari and
    Zafiriou, "Robust Process Control", 1989, chapter 3). With the sampling interval h, the
    factors below are g = 1 - exp(-h / lambda) and f = 1 - exp(-h / T_f).

    - A first-order model, x(k+1) = p x(k) + b u_a(k), runs in parallel with the plant, where
      u_a is the flow that the actuator passes. With the delay of d samples, the model predicts
      that the plant's output y(k) is x(k-d).
    - The estimated disturbance D(k), degC, is the measured output minus the model's output,
      after a low-pass filter: D(k) = D(k-1) + f (y(k) - x(k-d) - D(k-1)).
    - The command u(k) moves the model's state x a share g of its way to y_d - D, the set point
      minus the disturbance: u(k) = ((1 - p) x(k) + g (y_d(k) - D(k) - x(k))) / b.

    A command inside the dead zone is moved to 0 or to the edge of the dead zone, whichever is
    nearer. The controller needs no anti-windup: it has no integral, and the model's input is
    the flow u_a that the actuator passes.

    The other parameters are those of `ModelBasedController`.

    Parameters
    ----------
    closed_loop_time_constant
        lambda, time constant of the response to a step of the set point, s. With a large
        lambda, the commands for small errors stay inside the dead zone and have no effect.
        Errors up to 0.5 |gain| dead_zone lambda / time_constant, degC, are then not corrected.
    filter_time_constant
        T_f, time constant of the low-pass filter of the disturbance, s; 0 for no filter, as in
        Dahlin's paper. A larger T_f makes the loop more robust, and does not change the
        response to the set point if the model is right.
    setpoint_index, error_index
        Indices of the set point y_d(k) and of the error e(k), both in degC, in the observation.
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
        """Set the model's output and the estimated disturbance to 0, before a new episode."""
        super().reset()
        self._disturbance: Values = np.float64(0.0)  # D, degC

    def transfer(self) -> tuple[Array, Array]:
        """Return the transfer function from -y to the command u, t/h per degC.

        The set point is 0, so the error is -y, the negative output. The controller is linear
        while the command is between the limits of the flow and outside the dead zone.

        Returns
        -------
        numerator, denominator
            Coefficients of z^0, z^-1 and so on.
        """
        share = self._approach * self._filter
        numerator = share * np.array([1.0, -self._pole])
        lag = np.array([1.0, self._approach - 1.0])  # 1 - (1 - g) z^-1
        smoothed = np.convolve(lag, [1.0, self._filter - 1.0])  # times 1 - (1 - f) z^-1
        in_transit = np.append(np.zeros(self._delay), share)
        return numerator, self._input_gain * polysub(smoothed, in_transit)

    def _control(self, rows: Array) -> Array:
        """Return the commands u(k), t/h, shape (loops,), and advance the model by a sample.

        `rows` are the observations, shape (loops, size).
        """
        setpoint = rows[:, self.setpoint_index]
        output = setpoint - rows[:, self.error_index]
        residual = output - self._delayed
        self._disturbance = self._disturbance + self._filter * (residual - self._disturbance)
        state = self._undelayed
        move = self._approach * (setpoint - self._disturbance - state)
        return self._command(((1.0 - self._pole) * state + move) / self._input_gain)
