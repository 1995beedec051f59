"""Implement the PI controller of Section 5 of the paper, and the SIMC tuning rule."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mptc_gym.plant.checks import count_from_0, nonzero, not_negative, number, positive

from .controller import Controller, Values

Array = NDArray[np.float64]

# Gains Kp, t/h per degC, and Ki, t/h per degC and sample, for the paper's plant. The search
# `benchmarks.tune pi` of version 0.1 found these gains.
SEARCHED_GAINS = {"kp": 1.34, "ki": 0.0456}


@dataclass(eq=False, kw_only=True)
class PIController(Controller):
    """PI controller u(k) = -Kp e(k) - Ki sum_{i<=k} e(i), as in Section 5 of the paper.

    The command u(k) is in t/h, and the error e(k), set point minus output, in degC. The gains
    must be positive for a plant whose output falls when the flow rises, and negative for a
    plant whose output rises with the flow.

    The arguments `u_min` and `u_max` are described in `Controller`.

    Parameters
    ----------
    kp
        Proportional gain Kp, t/h per degC.
    ki
        Integral gain Ki, t/h per degC and sample.
    anti_windup
        Whether to stop the sum of the errors where the command reaches a flow limit, as long as
        the error would move the command further beyond this limit (conditional integration;
        Astrom and Hagglund, "PID Controllers", 2nd edition, 1995, section 3.5). The controller
        in the paper has no anti-windup.
    error_index
        Index of the error e(k), degC, in an observation.
    """

    kp: float = field(default=2.2, kw_only=False)
    ki: float = field(default=0.3, kw_only=False)
    anti_windup: bool = False
    error_index: int = 3

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check(number, "kp", "ki")
        self._check(count_from_0, "error_index")
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
        """Return a controller tuned by the SIMC rule, by default with anti-windup.

        The SIMC rule for PI controllers was published by Skogestad, "Simple analytic rules for
        model reduction and PID controller tuning", Journal of Process Control 13, 2003,
        291-309, equations (23) and (24).

        Parameters
        ----------
        gain
            k, the plant's steady-state gain, degC per t/h; positive or negative.
        time_constant
            tau_1, the plant's time constant, s.
        delay
            theta, the plant's delay, s.
        closed_loop_time_constant
            tau_c, the wanted time constant of the closed loop, s; None for a tau_c equal to
            `delay`, as Skogestad recommends for fast control that is still robust.
        sampling_interval
            Sampling interval, s.
        **arguments
            Any other arguments of `PIController`, such as `u_min`.

        Raises
        ------
        ValueError
            If an argument is out of range, or if `delay` is 0 and `closed_loop_time_constant`
            is None.
        """
        k = nonzero("gain", gain)
        tau_1 = positive("time_constant", time_constant)
        theta = not_negative("delay", delay)
        if closed_loop_time_constant is None:
            if theta == 0.0:
                raise ValueError("closed_loop_time_constant must be given if delay is 0")
            closed_loop_time_constant = theta
        tau_c = positive("closed_loop_time_constant", closed_loop_time_constant)
        interval = positive("sampling_interval", sampling_interval)
        # Equations (23) and (24) of Skogestad. Kp has the opposite sign, because u = -Kp e
        # here.
        kp = -tau_1 / (k * (tau_c + theta))
        tau_i = min(tau_1, 4 * (tau_c + theta))
        ki = kp * interval / tau_i
        arguments.setdefault("anti_windup", True)
        return cls(kp, ki, **arguments)

    def reset(self) -> None:
        """Set the sum of past errors to 0, before a new episode."""
        super().reset()
        self._sum: Values = np.float64(0.0)  # sum of past errors, degC

    def transfer(self) -> tuple[Array, Array]:
        """Return the transfer function from the error e to the command u, t/h per degC.

        The transfer function is -Kp - Ki / (1 - z^-1), as long as the command is within the
        flow limits.

        Returns
        -------
        numerator, denominator
            Coefficients of z^0 and z^-1 in the numerator and in the denominator of the transfer
            function, two arrays of shape (2,).
        """
        # -Kp (1 - z^-1) - Ki, over the denominator 1 - z^-1.
        numerator = np.array([-(self.kp + self.ki), self.kp])
        return numerator, np.array([1.0, -1.0])

    def _control(self, rows: Array) -> Array:
        """Return the commands u(k), t/h, shape (loops,), and update the sums of the errors."""
        error: Array = rows[:, self.error_index]
        total = self._sum + error
        command = -self.kp * error - self.ki * total  # Section 5
        if self.anti_windup and self.ki:
            change = -self.ki * error  # of the command by the present error
            excess = command - np.clip(command, self.u_min, self.u_max)
            # The part of the change that leads beyond a limit. It is the whole change if the
            # command was beyond the limit before, because of the proportional part.
            needless = np.clip(excess, np.minimum(change, 0.0), np.maximum(change, 0.0))
            # The sum changes so that -Ki times the sum changes by -needless.
            total = total + needless / self.ki
            command = command - needless
        self._sum = total
        return command
