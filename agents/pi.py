"""PI controllers: the one that the paper compares with (Section 5), and better ones."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.controller import (
    PAPER_WINDOWS,
    Controller,
    Values,
    check_count,
    check_flag,
    check_number,
    check_positive,
)

# From `python -m benchmarks.tune pi`.
SEARCHED_GAINS = {"kp": 1.34, "ki": 0.0456}


class PIController(Controller):
    """u(k) = -Kp e(k) - Ki sum_{i<=k} e(i), as printed in Section 5.

    The signs are those of a plant whose output falls when its input rises, D(G) = -1. For a
    plant of the other direction both gains are below zero.

    Parameters
    ----------
    kp
        Kp, t/h per degC.
    ki
        Ki, t/h per degC and sample.
    anti_windup
        Whether the sum stands still while the command lies beyond a limit and the error would
        drive it further (conditional integration; Astrom and Hagglund, "PID Controllers",
        2nd edition, 1995, section 3.5). The paper's goes on.
    error_index
        Where the observation holds e(k), degC.
    u_min, u_max
        The actuator's limits, t/h. They scale the action; they do not limit the command.

    Raises
    ------
    ValueError
        If an argument is out of range; the message names it.
    """

    observation = PAPER_WINDOWS  # that the default indices are for

    def __init__(
        self,
        kp: float = 2.2,
        ki: float = 0.3,
        *,
        anti_windup: bool = False,
        error_index: int = 3,
        u_min: float = -10.0,
        u_max: float = 10.0,
    ) -> None:
        self.error_index = check_count("error_index", error_index, 0)
        super().__init__(n_obs=self.error_index + 1, u_min=u_min, u_max=u_max)
        self.kp = check_number("kp", kp)
        self.ki = check_number("ki", ki)
        self.anti_windup = check_flag("anti_windup", anti_windup)
        self._sum: Values | None = None  # of all errors so far

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
        """Return a controller tuned by SIMC's rule, with anti-windup.

        S. Skogestad, "Simple analytic rules for model reduction and PID controller tuning",
        Journal of Process Control 13, 2003, 291-309, equations (23) and (24).

        Parameters
        ----------
        gain
            Steady-state gain k of the plant, degC per t/h, of either sign.
        time_constant
            Its time constant tau_1, s.
        delay
            Its delay theta, s.
        closed_loop_time_constant
            tau_c, s; by default the delay, "tight control with good robustness".
        sampling_interval
            s.
        arguments
            Of the controller.

        Raises
        ------
        ValueError
            If an argument is out of range; the message names it.
        """
        kp, ki = simc_gains(
            gain=gain,
            time_constant=time_constant,
            delay=delay,
            closed_loop_time_constant=closed_loop_time_constant,
            sampling_interval=sampling_interval,
        )
        return cls(kp, ki, **{"anti_windup": True, **arguments})

    def reset(self) -> None:
        """Set the integral to zero."""
        super().reset()
        self._sum = None

    def transfer(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the transfer function from e to u while no limit is met.

        Returns
        -------
        numerator, denominator
            Coefficients of z^0, z^-1 and so on. Kp e + Ki e / (1 - z^-1), with the sign of u.
        """
        numerator = np.array([-(self.kp + self.ki), self.kp])
        return numerator, np.array([1.0, -1.0])

    def _control(self, observation: NDArray[np.float64]) -> Values:
        error: Values = observation[..., self.error_index]
        if self._sum is None:
            self._sum = np.zeros_like(error)
        total = self._sum + error
        command = -self.kp * error - self.ki * total  # Section 5
        if self.anti_windup:
            drive = -self.ki * error  # what this error adds to the command from now on
            above, below = command > self.u_max, command < self.u_min
            outward = above & (drive > 0) | below & (drive < 0)
            total = np.where(outward, self._sum, total)
            command = -self.kp * error - self.ki * total
        self._sum = total
        return command


def simc_gains(
    *,
    gain: float,
    time_constant: float,
    delay: float,
    closed_loop_time_constant: float | None = None,
    sampling_interval: float = 8.0,
) -> tuple[float, float]:
    """Return Kp, t/h per degC, and Ki, t/h per degC and sample: see `PIController.simc`."""
    k = check_number("gain", gain)
    if k == 0:
        raise ValueError(f"gain must not be 0, got {gain!r}")
    tau_1 = check_positive("time_constant", time_constant)
    theta = check_number("delay", delay, 0)
    if closed_loop_time_constant is None and theta == 0.0:
        raise ValueError("closed_loop_time_constant must be given where delay is 0")
    tau_c = theta if closed_loop_time_constant is None else closed_loop_time_constant
    tau_c = check_positive("closed_loop_time_constant", tau_c)
    interval = check_positive("sampling_interval", sampling_interval)
    kp = -tau_1 / (k * (tau_c + theta))  # (23), with the sign of u = -Kp e
    tau_i = min(tau_1, 4 * (tau_c + theta))  # (24)
    return kp, kp * interval / tau_i
