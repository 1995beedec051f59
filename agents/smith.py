"""Implement a Smith predictor: a PI controller on the error that a model predicts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial.polynomial import polyadd
from numpy.typing import NDArray

from agents.controller import Index, Positive, Values
from agents.internal_model import InternalModelController
from agents.pi import PIController

Array = NDArray[np.float64]


@dataclass(eq=False, kw_only=True)
class SmithPredictor(InternalModelController):
    """A PI controller on the error that an undelayed model of the plant predicts.

    A first-order model with a delay runs in parallel with the plant. The model's undelayed
    output minus the model's delayed output is the effect of flows that have not yet shown in
    the plant's output. The PI controller acts on the error minus the effect of these flows. If
    the model is right, the PI controller acts as if the plant had no delay (Smith, "Closer
    control of loops with dead time", Chemical Engineering Progress 53, 1957, 217-219).

    The gains `kp` and `ki` follow from the SIMC rule for the plant without delay (see
    `PIController.simc`). The input of the model is the flow that the actuator passes. A command
    inside the dead zone is moved to 0 or to the edge of the dead zone, whichever is nearer.

    To prevent windup, the integral part of the command follows the wanted flow, limited to the
    actuator's range, with the time constant of the integral action (Astrom and Hagglund, "PID
    Controllers", 2nd edition, 1995, section 3.5). As long as no limit of the flow is active,
    the controller with anti-windup equals an ordinary PI controller. While the wanted flow is
    inside the dead zone, the controller goes on integrating.

    The other parameters are those of `ModelBasedController`.

    Parameters
    ----------
    closed_loop_time_constant
        Time constant that the closed loop would have if the plant had no delay, s.
    error_index
        Index of the error e(k), degC, in the observation.

    Attributes
    ----------
    kp : float
        Proportional gain of the PI controller, t/h per degC.
    ki : float
        Integral gain of the PI controller, t/h per degC and sample.
    """

    closed_loop_time_constant: Positive
    error_index: Index = 3

    def __post_init__(self) -> None:
        super().__post_init__()
        rule = PIController.simc(
            gain=self.gain,
            time_constant=self.time_constant,
            delay=0.0,
            closed_loop_time_constant=self.closed_loop_time_constant,
            sampling_interval=self.sampling_interval,
        )
        self.kp = rule.kp  # t/h per degC
        self.ki = rule.ki  # t/h per degC and sample
        self.n_obs = self.error_index + 1

    def reset(self) -> None:
        """Set the integral and the model's output to 0, before a new episode."""
        super().reset()
        self._integral: Values = np.float64(0.0)  # -Ki times the sum of past errors, t/h

    def transfer(self) -> tuple[Array, Array]:
        """Return the transfer function from the error e to the command u, t/h per degC.

        The Smith predictor is linear while the command is between the limits of the flow and
        outside the dead zone. The predictor is the PI controller with a feedback from u: the
        undelayed model minus the delayed model.

        Returns
        -------
        numerator, denominator
            Coefficients of z^0, z^-1 and so on.
        """
        pi_numerator, pi_denominator = PIController(self.kp, self.ki).transfer()
        model_numerator = np.array([0.0, self._input_gain])
        model_denominator = np.array([1.0, -self._pole])
        # The undelayed minus the delayed model is the model times 1 - z^-(delay - 1).
        in_transit = np.zeros(self._delay)
        in_transit[0] += 1.0
        in_transit[-1] -= 1.0
        forward = np.convolve(pi_denominator, model_denominator)
        feedback = np.convolve(np.convolve(pi_numerator, model_numerator), in_transit)
        return np.convolve(pi_numerator, model_denominator), polyadd(forward, feedback)

    def _control(self, rows: Array) -> Array:
        """Return the commands u(k), t/h, shape (loops,), and advance the model by a sample.

        `rows` are the observations, shape (loops, size).
        """
        in_transit = self._undelayed - self._delayed
        error = rows[:, self.error_index] - in_transit
        gain = self.kp + self.ki  # of the present error, which the sum of errors includes
        wanted = self._integral - gain * error
        # Anti-windup: the integral follows the limited flow, and not the wanted flow.
        limited = np.clip(wanted, self.u_min, self.u_max)
        self._integral = self._integral + self.ki / gain * (limited - self._integral)
        return self._command(wanted)
