"""A Smith predictor: a PI controller that reckons with what is still on its way."""

from __future__ import annotations

import math

import numpy as np
from numpy.polynomial.polynomial import polyadd
from numpy.typing import NDArray

from agents.controller import MOST, Values, check_number
from agents.pi import PIController, simc_gains

Array = NDArray[np.float64]


class SmithPredictor(PIController):
    """A PI controller on the error that a model of the plant, without its delay, foresees.

    The model is of first order with a delay. It runs beside the plant. Its output without the
    delay less its output with it is the effect of the inputs that are still in transit. The
    controller acts on the error less this effect. So far as the model is right, it acts as if
    there were no delay (O. J. M. Smith, "Closer control of loops with dead time", Chemical
    Engineering Progress 53, 1957, 217-219).
    Its gains are SIMC's for the plant without delay; it has anti-windup.

    Parameters
    ----------
    gain, time_constant, delay, sampling_interval
        The model, as for `PIController.simc`: degC per t/h, s, s, s. The sample that any input
        takes to show is part of the delay.
    closed_loop_time_constant
        Of the loop without the delay, s.
    dead_zone
        The actuator's, t/h: commands within it are 0 to the model, those on its edge have an
        effect. 0 if it is not known.
    error_index, u_min, u_max
        As for `PIController`; to the model the command stays within the limits.

    Raises
    ------
    ValueError
        If an argument is out of range; the message names it.
    """

    def __init__(
        self,
        *,
        gain: float,
        time_constant: float,
        delay: float,
        closed_loop_time_constant: float,
        dead_zone: float = 0.0,
        sampling_interval: float = 8.0,
        error_index: int = 3,
        u_min: float = -10.0,
        u_max: float = 10.0,
    ) -> None:
        kp, ki = simc_gains(
            gain=gain,
            time_constant=time_constant,
            delay=0.0,
            closed_loop_time_constant=closed_loop_time_constant,
            sampling_interval=sampling_interval,
        )
        super().__init__(
            kp, ki, anti_windup=True, error_index=error_index, u_min=u_min, u_max=u_max
        )
        self.dead_zone = check_number("dead_zone", dead_zone, 0)
        self._pole = math.exp(-sampling_interval / time_constant)
        self._input_gain = gain * (1.0 - self._pole)
        samples = check_number("delay", delay, 0) / sampling_interval
        if samples > MOST:
            raise ValueError(
                f"delay must be at most {MOST:,} times sampling_interval = "
                f"{sampling_interval!r}, got {delay!r}"
            )
        self._delay = max(round(samples), 1)
        self._model: list[Values] = []  # its last outputs without delay, newest last

    def reset(self) -> None:
        """Set the integral to zero, and the model to rest."""
        super().reset()
        self._model = []

    def transfer(self) -> tuple[Array, Array]:
        """Return the transfer function from e to u while no limit and no dead zone is met.

        Returns
        -------
        numerator, denominator
            Coefficients of z^0, z^-1 and so on: those of the PI controller with the model, with
            and without its delay, fed back around it.
        """
        pi, integral = super().transfer()
        model = np.array([0.0, self._input_gain]), np.array([1.0, -self._pole])
        ahead = np.zeros(self._delay)  # 1 - z^-(delay - 1): what is on its way
        ahead[0] += 1.0
        ahead[-1] -= 1.0
        outgoing = np.convolve(integral, model[1])
        returning = np.convolve(np.convolve(pi, model[0]), ahead)
        return np.convolve(pi, model[1]), polyadd(outgoing, returning)

    def _control(self, observation: Array) -> Values:
        if not self._model:
            rest = np.zeros_like(observation[..., self.error_index])
            self._model = [rest] * self._delay
        now, delayed = self._model[-1], self._model[0]
        foreseen = np.array(observation)
        foreseen[..., self.error_index] -= now - delayed
        command = super()._control(foreseen)
        applied = np.clip(command, self.u_min, self.u_max)
        applied = np.where(np.abs(applied) < self.dead_zone, 0.0, applied)
        self._model = [*self._model[1:], self._pole * now + self._input_gain * applied]
        return command
