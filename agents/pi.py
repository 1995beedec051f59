"""Implement PI controllers: the paper's (Section 5) and better-tuned ones."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.controller import (
    Controller,
    Flag,
    Gain,
    Index,
    NotNegative,
    Number,
    Positive,
    Values,
    check,
)

Array = NDArray[np.float64]

# The gains of the search `benchmarks.tune pi` in version 0.1.
SEARCHED_GAINS = {"kp": 1.34, "ki": 0.0456}


@dataclass(eq=False, kw_only=True)
class PIController(Controller):
    """PI controller u(k) = -Kp e(k) - Ki sum_{i<=k} e(i), as printed in Section 5.

    The signs suit a plant whose output falls when its input rises, D(G) = -1. For a plant of
    the opposite direction, both gains are negative.

    `u_min` and `u_max` are those of `Controller`.

    Parameters
    ----------
    kp
        Proportional gain Kp, t/h per degC.
    ki
        Integral gain Ki, t/h per degC and sample.
    anti_windup
        Whether to hold the sum while the command is beyond a limit and the error would drive it
        further (conditional integration; Astrom and Hagglund, "PID Controllers", 2nd edition,
        1995, section 3.5). The paper's controller always integrates.
    error_index
        Index of e(k), degC, in the observation.
    """

    kp: Number = field(default=2.2, kw_only=False)
    ki: Number = field(default=0.3, kw_only=False)
    anti_windup: Flag = False
    error_index: Index = 3

    def __post_init__(self) -> None:
        super().__post_init__()
        self.n_obs = self.error_index + 1

    @classmethod
    def simc(
        cls,
        *,
        gain: float,
        time_constant: float,
        delay: float,
        closed_loop_time_constant: float | None = None,
        sampling_interval: float = 8.0,
        **arguments: Any,
    ) -> PIController:
        """Return a controller tuned by the SIMC rule, with anti-windup.

        S. Skogestad, "Simple analytic rules for model reduction and PID controller tuning",
        Journal of Process Control 13, 2003, 291-309, equations (23) and (24).

        Parameters
        ----------
        gain
            k, the plant's steady-state gain, degC per t/h, of either sign.
        time_constant
            tau_1, the plant's time constant, s.
        delay
            theta, the plant's delay, s.
        closed_loop_time_constant
            tau_c, s; by default the delay, "tight control with good robustness".
        sampling_interval
            Sampling interval, s.
        arguments
            Other arguments of the controller.
        """
        k = check("gain", gain, Gain)
        tau_1 = check("time_constant", time_constant, Positive)
        theta = check("delay", delay, NotNegative)
        if closed_loop_time_constant is None and theta == 0.0:
            raise ValueError("closed_loop_time_constant must be given where delay is 0")
        if closed_loop_time_constant is None:
            closed_loop_time_constant = theta
        tau_c = check("closed_loop_time_constant", closed_loop_time_constant, Positive)
        interval = check("sampling_interval", sampling_interval, Positive)
        kp = -tau_1 / (k * (tau_c + theta))  # (23), with the sign of u = -Kp e
        tau_i = min(tau_1, 4 * (tau_c + theta))  # (24)
        return cls(kp, kp * interval / tau_i, **{"anti_windup": True, **arguments})

    def reset(self) -> None:
        """Set the integral to zero."""
        super().reset()
        self._sum: Values = np.float64(0.0)  # of all errors so far

    def transfer(self) -> tuple[Array, Array]:
        """Return the transfer function from e to u, valid between the limits.

        Returns
        -------
        numerator, denominator
            Coefficients of z^0, z^-1 and so on, of -Kp - Ki / (1 - z^-1).
        """
        numerator = np.array([-(self.kp + self.ki), self.kp])
        return numerator, np.array([1.0, -1.0])

    def _control(self, rows: Array) -> Array:
        """Return u, t/h, and add the errors to the integral."""
        error: Array = rows[:, self.error_index]
        total = self._sum + error
        command = -self.kp * error - self.ki * total  # Section 5
        if self.anti_windup:
            change = -self.ki * error  # of the command, through the integral
            is_above = command > self.u_max
            is_below = command < self.u_min
            drives_outward = is_above & (change > 0) | is_below & (change < 0)
            total = np.where(drives_outward, self._sum, total)
            command = -self.kp * error - self.ki * total
        self._sum = total
        return command
