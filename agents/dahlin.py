"""Implement Dahlin's controller, whose closed loop responds like a first-order lag."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.polynomial.polynomial import polysub
from numpy.typing import NDArray

from mptc_gym.plant.checks import count_from_0, not_negative, positive

from .controller import Values
from .internal_model import InternalModelController

Array = NDArray[np.float64]


@dataclass(eq=False, kw_only=True)
class DahlinController(InternalModelController):
    """A controller with which the output approaches the set point like a first-order lag.

    Dahlin's control law was published in "Designing and tuning digital controllers",
    Instruments and Control Systems 41 (6), 1968, 77-83. This class implements Dahlin's control
    law as internal model control (Morari and Zafiriou, "Robust Process Control", 1989, chapter
    3). The control law has the factors g = 1 - exp(-h / lambda) and f = 1 - exp(-h / T_f),
    where h is the sampling interval, lambda the time constant of the response to the set point,
    and T_f the time constant of the low-pass filter.

    - A first-order model, x(k+1) = p x(k) + b u_a(k), runs in parallel with the plant, where x
      is the output of the model without delay, p the pole, b the input gain, and u_a the flow
      that leaves the actuator. The prediction of the plant's output y(k) is x(k-d), for the
      transport delay d, in samples, of equation (28) of the paper. The argument `delay` is d +
      1 sampling intervals.
    - The estimated disturbance D(k), degC, is the low-pass filtered difference between the
      measured output and the model's delayed output: D(k) = D(k-1) + f (y(k) - x(k-d) -
      D(k-1)).
    - The command u(k) moves the model's state x by a share g of the distance to the set point
      minus the disturbance, y_d - D: u(k) = ((1 - p) x(k) + g (y_d(k) - D(k) - x(k))) / b.

    A command inside the dead zone is moved to 0 or to the edge of the dead zone, whichever is
    nearer. The controller needs no anti-windup, because the controller has no integral, and
    because the model's input is the flow u_a that leaves the actuator.

    All other parameters are described in `ModelBasedController`.

    Parameters
    ----------
    closed_loop_time_constant
        lambda, the time constant of the response to a step of the set point, s. If the flow and
        the model's output are 0, errors up to about 0.5 |gain| dead_zone
        closed_loop_time_constant / time_constant, degC, are not corrected, because a command of
        less than half of `dead_zone` is moved to 0.
    filter_time_constant
        T_f, the time constant of the low-pass filter of the estimated disturbance, s; 0 for no
        filter, as in Dahlin's paper. A larger filter time constant makes the closed loop more
        robust, and has no effect on the response to the set point if the model equals the
        plant.
    setpoint_index, error_index
        Indices of the set point y_d(k) and the error e(k), both in degC, in an observation.
    """

    closed_loop_time_constant: float
    filter_time_constant: float = 0.0
    setpoint_index: int = 0
    error_index: int = 3

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check(positive, "closed_loop_time_constant")
        self._check(not_negative, "filter_time_constant")
        self._check(count_from_0, "setpoint_index", "error_index")
        self.n_obs = max(self.setpoint_index, self.error_index) + 1
        # The shares g and f of a distance that are covered per sample; f = 1 is no filter.
        self._approach = -math.expm1(-self.sampling_interval / self.closed_loop_time_constant)
        self._filter = 1.0
        if self.filter_time_constant > 0.0:
            self._filter = -math.expm1(-self.sampling_interval / self.filter_time_constant)

    def reset(self) -> None:
        """Set the model's output and the estimated disturbance to 0, before a new episode."""
        super().reset()
        self._disturbance: Values = np.float64(0.0)  # estimated disturbance D, degC

    def transfer(self) -> tuple[Array, Array]:
        """Return the transfer function from the error e to the command u for the set point 0.

        The unit is t/h per degC. For the set point 0, the error is the negative output. The
        transfer function is valid while the command is within the flow limits and outside the
        dead zone.

        Returns
        -------
        numerator, denominator
            Coefficients of z^0, z^-1, z^-2 and so on in the numerator and in the denominator of
            the transfer function, as arrays.
        """
        # The equations in the docstring of the class, solved for u with y_d = 0 and u_a = u.
        share = self._approach * self._filter  # g f
        numerator = share * np.array([1.0, -self._pole])
        lag = np.array([1.0, self._approach - 1.0])  # 1 - (1 - g) z^-1
        smoothed = np.convolve(lag, [1.0, self._filter - 1.0])  # times 1 - (1 - f) z^-1
        in_transit = np.append(np.zeros(self._delay), share)  # g f z^-(d+1)
        return numerator, self._input_gain * polysub(smoothed, in_transit)

    def _control(self, rows: Array) -> Array:
        """Return the commands u(k), t/h, shape (loops,), and advance the model by a sample."""
        setpoint = rows[:, self.setpoint_index]
        output = setpoint - rows[:, self.error_index]
        residual = output - self._delayed  # y(k) - x(k-d)
        self._disturbance = self._disturbance + self._filter * (residual - self._disturbance)
        state = self._undelayed  # x(k)
        move = self._approach * (setpoint - self._disturbance - state)
        wanted = ((1.0 - self._pole) * state + move) / self._input_gain
        # `_command` moves the flow out of the dead zone, and advances the model to x(k+1).
        return self._command(wanted)
