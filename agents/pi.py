"""The PI controller that the paper compares with (Section 5)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agents.controller import Controller, Values, check_count, check_number

# From `python -m benchmarks.tune pi`.
SEARCHED_GAINS = {"kp": 1.34, "ki": 0.0456}


class PIController(Controller):
    """u(k) = -Kp e(k) - Ki sum_{i<=k} e(i), as printed in Section 5: without anti-windup.

    The signs are those of a plant whose output falls when its input rises, D(G) = -1.

    Parameters
    ----------
    kp
        Kp, t/h per degC.
    ki
        Ki, t/h per degC and sample.
    error_index
        Where the observation holds e(k), degC.
    u_min, u_max
        The actuator's limits, t/h. They scale the action; they do not limit the command.

    Raises
    ------
    ValueError
        If an argument is out of range; the message names it.
    """

    def __init__(
        self,
        kp: float = 2.2,
        ki: float = 0.3,
        *,
        error_index: int = 3,
        u_min: float = -10.0,
        u_max: float = 10.0,
    ) -> None:
        self.error_index = check_count("error_index", error_index, 0)
        super().__init__(n_obs=self.error_index + 1, u_min=u_min, u_max=u_max)
        self.kp = check_number("kp", kp)
        self.ki = check_number("ki", ki)
        self._sum: Values | None = None  # of all errors so far

    def reset(self) -> None:
        """Set the integral to zero."""
        super().reset()
        self._sum = None

    def _control(self, observation: NDArray[np.float64]) -> Values:
        error: Values = observation[..., self.error_index]
        if self._sum is None:
            self._sum = np.zeros_like(error)
        if np.shape(self._sum) != np.shape(error):
            raise ValueError(
                f"observation must be of {np.shape(self._sum)} loops until reset, "
                f"got {np.shape(error)}"
            )
        self._sum = self._sum + error
        return -self.kp * error - self.ki * self._sum  # Section 5
