"""Implement a Smith predictor, which applies a PI controller to a predicted error."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial.polynomial import polyadd
from numpy.typing import NDArray

from mptc_gym.plant.checks import count_from_0, positive

from .controller import Values
from .internal_model import InternalModelController
from .pi import PIController

Array = NDArray[np.float64]


@dataclass(eq=False, kw_only=True)
class SmithPredictor(InternalModelController):
    """A Smith predictor: a PI controller whose input is a predicted error.

    A first-order model with a delay runs in parallel with the plant. The effect of past flows
    that have not yet affected the plant's output is the model's undelayed output minus the
    model's delayed output. The input of the PI controller is the error minus the effect of past
    flows that have not yet affected the output. If the model equals the plant, the PI
    controller acts as if the plant had no delay (Smith, "Closer control of loops with dead
    time", Chemical Engineering Progress 53, 1957, 217-219).

    The gains `kp` and `ki` follow from `PIController.simc`, the SIMC rule, for the plant
    without delay. The input of the model is the flow that leaves the actuator. A command inside
    the dead zone is moved to 0 or to the edge of the dead zone, whichever is nearer.

    To prevent windup, the integral part of the command follows the wanted flow, clipped to the
    flow limits, with the time constant of the integral action (Astrom and Hagglund, "PID
    Controllers", 2nd edition, 1995, section 3.5). While the wanted flow is within the flow
    limits, the anti-windup has no effect. While the wanted flow is inside the dead zone, the PI
    controller continues to integrate.

    All other parameters are described in `ModelBasedController`.

    Parameters
    ----------
    closed_loop_time_constant
        Time constant of the closed loop for the plant without delay, s.
    error_index
        Index of the error e(k), degC, in an observation.

    Attributes
    ----------
    kp : float
        Proportional gain of the PI controller, t/h per degC.
    ki : float
        Integral gain of the PI controller, t/h per degC and sample.
    """

    closed_loop_time_constant: float
    error_index: int = 3

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check(positive, "closed_loop_time_constant")
        self._check(count_from_0, "error_index")
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
        """Set the integral part and the model's output to 0, before a new episode."""
        super().reset()
        # Integral part of the command, t/h. Without saturation, the integral part is -Ki times
        # the sum of the past inputs of the PI controller.
        self._integral: Values = np.float64(0.0)

    def transfer(self) -> tuple[Array, Array]:
        """Return the transfer function from the error e to the command u, t/h per degC.

        The transfer function is valid while the command is within the flow limits and outside
        the dead zone. The feedback around the PI controller is the model without delay minus
        the model with delay.

        Returns
        -------
        numerator, denominator
            Coefficients of z^0, z^-1, z^-2 and so on in the numerator and in the denominator of
            the transfer function, as arrays.
        """
        pi_numerator, pi_denominator = PIController(self.kp, self.ki).transfer()
        model_numerator = np.array([0.0, self._input_gain])
        model_denominator = np.array([1.0, -self._pole])
        # The undelayed minus the delayed model is the undelayed model times 1 - z^-d. `_delay`
        # is d + 1; if d is 0, both terms are in the same element, and cancel.
        in_transit = np.zeros(self._delay)
        in_transit[0] += 1.0
        in_transit[-1] -= 1.0
        forward = np.convolve(pi_denominator, model_denominator)
        feedback = np.convolve(np.convolve(pi_numerator, model_numerator), in_transit)
        return np.convolve(pi_numerator, model_denominator), polyadd(forward, feedback)

    def _control(self, rows: Array) -> Array:
        """Return the commands u(k), t/h, shape (loops,), and advance the model by a sample."""
        # x(k) - x(k-d), the outputs of the model without and with its delay: the effect of past
        # flows that have not yet affected the plant's output.
        in_transit = self._undelayed - self._delayed
        error = rows[:, self.error_index] - in_transit
        # The integral does not contain the present error yet.
        error_gain = self.kp + self.ki
        wanted = self._integral - error_gain * error
        # For anti-windup, the integral follows the clipped flow instead of the wanted flow.
        # Within the limits, it changes by -Ki times the error, as without anti-windup.
        limited = np.clip(wanted, self.u_min, self.u_max)
        self._integral = self._integral + self.ki / error_gain * (limited - self._integral)
        # `_command` moves the flow out of the dead zone, and advances the model to x(k+1).
        return self._command(wanted)
