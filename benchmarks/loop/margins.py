"""Compute the stability margins of loops from their frequency responses."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy  # loads its modules on first use
from numpy.polynomial.polynomial import polyadd
from numpy.typing import NDArray

from agents import PIController
from benchmarks.loop.linear import LinearModel

Array = NDArray[np.float64]

SLOWEST = 1e-5  # lowest frequency, as a share of the Nyquist frequency
POINTS = 20_000  # frequencies, of logarithmic and of linear spacing each
COARSE = 0.003  # lowest frequency of the coarse grid, as a share of the first plant's rate


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

    L is its transfer function from e to y. The controller is taken as linear, with the transfer
    function that its `transfer` gives.
    """

    def __init__(self, controller: PIController, plant: LinearModel) -> None:
        # G_u from e to u, and G from u to y: L = G_u G, in powers of z^-1.
        (up, down), (b, a) = controller.transfer(), plant.transfer()
        self.numerator, self.denominator = np.convolve(up, b), np.convolve(down, a)
        self._interval = plant.sampling_interval
        nyquist = math.pi / self._interval
        # rad/s, dense enough to see every crossing
        self.frequency = np.union1d(
            np.geomspace(SLOWEST * nyquist, nyquist, POINTS),
            np.linspace(nyquist / POINTS, nyquist, POINTS),
        )

    def response_at(self, frequency: Array) -> NDArray[np.complex128]:
        """Return L at frequencies, rad/s."""
        at = frequency * self._interval
        return np.asarray(scipy.signal.freqz(self.numerator, self.denominator, at)[1])

    @cached_property
    def response(self) -> NDArray[np.complex128]:
        """L at `frequency`."""
        return self.response_at(self.frequency)

    @cached_property
    def largest_pole(self) -> float:
        """Modulus of the closed loop's largest pole: it is stable if this is below 1."""
        return float(np.abs(np.roots(polyadd(self.denominator, self.numerator))).max())

    @cached_property
    def margins(self) -> Margins:
        """Margins while no limit and no dead zone is met."""
        if self.largest_pole >= 1.0:
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


def sensitivities(plants: Sequence[LinearModel]) -> Callable[[PIController], Array]:
    """Return a function from a controller to its Ms with each of many stable plants.

    The grid of frequencies is coarser than that of `Loop`, and set by the first plant. Ms is
    infinite for an unstable loop: 1 + L begins at -90 degrees, because of the integrator, and
    ends real. By Nyquist's criterion the loop is stable if 1 + L does not encircle 0 and no
    controller pole is outside the unit circle.
    """
    slowest = COARSE * (1.0 - float(np.abs(plants[0].poles).max(initial=0.0)))
    turns = 8 * (max(plant.delay + len(plant.b) for plant in plants) + 50)
    at = np.union1d(np.geomspace(slowest, np.pi, 400), np.linspace(np.pi / turns, np.pi, turns))
    back = np.exp(-1j * at)
    responses = np.array([
        scipy.signal.freqz(each.b, each.a, at)[1] * back ** (each.delay + 1) for each in plants
    ])  # fmt: skip

    def sensitivity(controller: PIController) -> Array:
        numerator, denominator = controller.transfer()
        if np.any(np.abs(np.roots(denominator)) > 1.0 + 1e-6):
            return np.full(len(plants), np.inf)
        difference = 1.0 + responses * scipy.signal.freqz(numerator, denominator, at)[1]
        steps = np.angle(difference[:, 1:] / difference[:, :-1])
        start = np.angle(difference[:, 0])
        stable = (start < 0.0) & (np.abs(start + steps.sum(axis=1)) < 1.0)
        return np.where(stable, 1.0 / np.abs(difference).min(axis=1), np.inf)

    return sensitivity
