"""Implement the PI controller of Section 5 of the paper, and PI controllers tuned by a rule."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.controller import (
    Controller,
    Flag,
    Index,
    Number,
    Values,
    nonzero,
    not_negative,
    positive,
)

Array = NDArray[np.float64]

# Gains Kp, t/h per degC, and Ki, t/h per degC and sample, found on the paper's plant by the
# search `benchmarks.tune pi` in version 0.1.
SEARCHED_GAINS = {"kp": 1.34, "ki": 0.0456}


@dataclass(eq=False, kw_only=True)
class PIController(Controller):
    """PI controller u(k) = -Kp e(k) - Ki sum_{i<=k} e(i), as in Section 5 of the paper.

    Here u(k) is the command, t/h, and e(k) the error, set point minus output, degC. With
    positive gains, the controller suits a plant whose output falls when its input rises. For a
    plant whose output rises with its input, both gains must be negative.

    The arguments `u_min` and `u_max` are those of `Controller`.

    Parameters
    ----------
    kp
        Proportional gain Kp, t/h per degC.
    ki
        Integral gain Ki, t/h per degC and sample.
    anti_windup
        Whether to stop the sum of the errors while the command is beyond a limit of the flow
        and the error would drive the command further beyond (conditional integration; Astrom
        and Hagglund, "PID Controllers", 2nd edition, 1995, section 3.5). The paper's controller
        always integrates.
    error_index
        Index of the error e(k), degC, in the observation.
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

        The SIMC rule for PI controllers was published by Skogestad, "Simple analytic rules for
        model reduction and PID controller tuning", Journal of Process Control 13, 2003,
        291-309, equations (23) and (24).

        Parameters
        ----------
        gain
            k, the plant's steady-state gain, degC per t/h, of either sign.
        time_constant
            tau_1, the plant's time constant, s.
        delay
            theta, the plant's delay, s.
        closed_loop_time_constant
            tau_c, the wanted time constant of the closed loop, s. Without this argument, tau_c
            is the delay, as Skogestad recommends for "tight control with good robustness".
        sampling_interval
            Sampling interval, s.
        **arguments
            Further arguments of `PIController`, such as `u_min`.

        Raises
        ------
        ValueError
            If an argument is out of range, or if the delay is 0 and no
            `closed_loop_time_constant` is given.
        """
        k = nonzero("gain", gain)
        tau_1 = positive("time_constant", time_constant)
        theta = not_negative("delay", delay)
        if closed_loop_time_constant is None:
            if theta == 0.0:
                raise ValueError("closed_loop_time_constant must be given where delay is 0")
            closed_loop_time_constant = theta
        tau_c = positive("closed_loop_time_constant", closed_loop_time_constant)
        interval = positive("sampling_interval", sampling_interval)
        # Equation (23) of Skogestad, with the sign of u = -Kp e, and equation (24).
        kp = -tau_1 / (k * (tau_c + theta))
        tau_i = min(tau_1, 4 * (tau_c + theta))
        ki = kp * interval / tau_i
        arguments.setdefault("anti_windup", True)
        return cls(kp, ki, **arguments)

    def reset(self) -> None:
        """Set the sum of the errors to 0, before a new episode."""
        super().reset()
        self._sum: Values = np.float64(0.0)  # of all errors so far

    def transfer(self) -> tuple[Array, Array]:
        """Return the transfer function from the error e to the command u, t/h per degC.

        While the command is between the limits of the flow, the controller is linear and has
        the transfer function -Kp - Ki / (1 - z^-1).

        Returns
        -------
        numerator, denominator
            Coefficients of z^0, z^-1 and so on, each of shape (2,).
        """
        numerator = np.array([-(self.kp + self.ki), self.kp])
        return numerator, np.array([1.0, -1.0])

    def _control(self, rows: Array) -> Array:
        """Return the commands u(k), t/h, shape (loops,), and add the errors to their sums.

        `rows` are the observations, shape (loops, size).
        """
        error: Array = rows[:, self.error_index]
        total = self._sum + error
        command = -self.kp * error - self.ki * total  # Section 5
        if self.anti_windup:
            change = -self.ki * error  # of the command by the present error's place in the sum
            is_above = command > self.u_max
            is_below = command < self.u_min
            drives_outward = is_above & (change > 0) | is_below & (change < 0)
            total = np.where(drives_outward, self._sum, total)
            command = -self.kp * error - self.ki * total
        self._sum = total
        return command
