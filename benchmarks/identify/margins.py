"""Compute a loop's stability margins from its frequency response."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.polynomial.polynomial import polyadd
from numpy.typing import NDArray
from scipy import signal

from agents import PIController
from benchmarks.loop.linear import nominal
from mptc_gym import Parameters

Array = NDArray[np.float64]

SLOWEST = 1e-5  # lowest frequency, as a share of the Nyquist frequency
POINTS = 20_000  # frequencies, of logarithmic and of linear spacing each


@dataclass(frozen=True)
class Margins:
    """Stability margins of a loop, all NaN if it is not stable."""

    gain: float = math.nan
    """Factor on the plant's gain at which the loop becomes unstable; infinite if none does."""
    phase: float = math.nan
    """Phase shift in either direction, degrees; infinite if the loop gain stays below 1."""
    delay: float = math.nan
    """Additional delay, s; infinite if the loop gain stays below 1."""
    sensitivity: float = math.nan
    """Ms, the largest factor by which the loop amplifies a disturbance, 1 or more. 1 / Ms is
    the smallest distance of the loop's frequency response from -1."""

    @property
    def stable(self) -> bool:
        """Whether the loop is stable."""
        return not math.isnan(self.sensitivity)


class Loop:
    """The loop of a controller and a plant, (28) without the actuator, opened at the error.

    L is its transfer function from e to y.

    Parameters
    ----------
    controller
        Linear between the limits of the flow, with the transfer function that `transfer` gives.
    parameters
        The plant's. A range stands for its middle, and a plant that drifts is taken at k = 0.
    """

    def __init__(self, controller: PIController, parameters: Parameters) -> None:
        # G_u from e to u, and G from u to y: L = G_u G, in powers of z^-1.
        (up, down), (b, a) = controller.transfer(), nominal(parameters).transfer()
        self.numerator, self.denominator = np.convolve(up, b), np.convolve(down, a)
        self._interval = parameters.sampling_interval
        nyquist = math.pi / self._interval
        # rad/s, dense enough to see every crossing
        self.frequency = np.union1d(
            np.geomspace(SLOWEST * nyquist, nyquist, POINTS),
            np.linspace(nyquist / POINTS, nyquist, POINTS),
        )

    def response_at(self, frequency: Array) -> NDArray[np.complex128]:
        """Return L at frequencies, rad/s."""
        at = frequency * self._interval
        return np.asarray(signal.freqz(self.numerator, self.denominator, at)[1])

    @cached_property
    def response(self) -> NDArray[np.complex128]:
        """L at `frequency`."""
        return self.response_at(self.frequency)

    @cached_property
    def margins(self) -> Margins:
        """Margins while no limit and no dead zone is met."""
        closed = polyadd(self.denominator, self.numerator)
        if not np.all(np.abs(np.roots(closed)) < 1.0):
            return Margins()
        values = self.response
        at = self.response_at(self._crossings(values.imag)).real
        at = np.append(at, values[-1].real)  # at the Nyquist frequency L is real, too
        gains = -1.0 / at[(at > -1.0) & (at < 0.0)]
        of_one = self._crossings(np.abs(values) - 1.0)
        left = (np.angle(self.response_at(of_one)) + math.pi) % (2.0 * math.pi)
        phases = np.degrees(np.minimum(left, 2.0 * math.pi - left))
        return Margins(
            float(gains.min(initial=math.inf)),
            float(phases.min(initial=math.inf)),
            float((left / of_one).min(initial=math.inf)),
            float(1.0 / np.abs(1.0 + values).min()),
        )

    def _crossings(self, values: Array) -> Array:
        """Return the frequencies at which values change sign, by linear interpolation."""
        i = np.flatnonzero(np.signbit(values[:-1]) != np.signbit(values[1:]))
        share = values[i] / (values[i] - values[i + 1])
        result: Array = self.frequency[i] + share * (self.frequency[i + 1] - self.frequency[i])
        return result
