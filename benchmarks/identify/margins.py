"""How far a loop is from instability: margins from its frequency response."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.polynomial.polynomial import polyadd, polyval
from numpy.typing import NDArray

from benchmarks.lib.drawing import colours, drawn
from benchmarks.loop.linear import nominal
from mptc_gym import Parameters

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

SLOWEST = 1e-5  # lowest frequency, of the Nyquist frequency
POINTS = 20_000  # of the frequency response


class Linear(Protocol):
    """A controller that is linear between the limits of the flow."""

    def transfer(self) -> tuple[Array, Array]:
        """Return numerator and denominator, in powers of z^-1, from e to u."""


@dataclass(frozen=True)
class Margins:
    """What a loop bears before it is unstable.

    Attributes
    ----------
    gain
        Factor on the gain of the plant; infinite if none makes it unstable.
    phase
        Phase shift in either direction, degrees; infinite if the loop gain is below 1
        everywhere.
    delay
        Further delay, s; infinite likewise.
    sensitivity
        Ms, the largest factor by which the loop amplifies a disturbance, 1 or more. 1 / Ms is
        the least distance of the loop's frequency response from -1.

    All are NaN if the loop is not stable.
    """

    gain: float
    phase: float
    delay: float
    sensitivity: float

    @property
    def stable(self) -> bool:
        """Whether the loop is stable."""
        return not math.isnan(self.sensitivity)


@dataclass(frozen=True)
class Loop:
    """A controller and a plant, opened at the error: what e comes back as.

    Attributes
    ----------
    numerator, denominator
        Of the loop's transfer function, in powers of z^-1.
    sampling_interval
        s.
    """

    numerator: Array
    denominator: Array
    sampling_interval: float

    @classmethod
    def of(cls, controller: Linear, parameters: Parameters) -> Loop:
        """Return the loop of a controller and a plant, (28) without the actuator.

        Parameters
        ----------
        controller
            Linear between the limits.
        parameters
            The plant's. A range stands for its middle, and a plant that drifts is taken at
            k = 0.
        """
        # u follows e, and y follows u: L = G_u G.
        up, down = controller.transfer()
        b, a = nominal(parameters).transfer()
        numerator, denominator = (
            np.convolve(*pair).astype(np.float64) for pair in ((up, b), (down, a))
        )
        return cls(numerator, denominator, parameters.sampling_interval)

    def response(self, frequency: Array) -> Complex:
        """Return L at frequencies, rad/s."""
        back = np.exp(-1j * np.asarray(frequency) * self.sampling_interval)  # z^-1
        return ratio(self.numerator, self.denominator, back)

    def frequencies(self) -> Array:
        """Return frequencies up to Nyquist's, rad/s, dense enough to see every crossing."""
        nyquist = math.pi / self.sampling_interval
        slow = np.geomspace(SLOWEST * nyquist, nyquist, POINTS)
        return np.union1d(slow, np.linspace(nyquist / POINTS, nyquist, POINTS))

    @property
    def stable(self) -> bool:
        """Whether the closed loop is stable: no root of 1 + L at or beyond the unit circle."""
        closed = polyadd(self.denominator, self.numerator)
        return bool(np.all(np.abs(np.roots(closed)) < 1.0))


def ratio(
    numerator: Array | Sequence[float], denominator: Array | Sequence[float], back: NDArray[Any]
) -> Complex:
    """Return a transfer function, given in powers of z^-1, at values `back` of z^-1."""
    up, down = (polyval(back, part) for part in (numerator, denominator))
    values: Complex = np.asarray(up / down)
    return values


def margins(controller: Linear, parameters: Parameters) -> Margins:
    """Return the margins of a controller on a plant, while no limit and no dead zone is met.

    Parameters
    ----------
    controller
        `agents.PIController` or `agents.SmithPredictor`, or anything else with their method
        `transfer`.
    parameters
        The plant's.
    """
    loop = Loop.of(controller, parameters)
    if not loop.stable:
        return Margins(math.nan, math.nan, math.nan, math.nan)
    frequency = loop.frequencies()
    values = loop.response(frequency)

    at = loop.response(_crossings(frequency, values.imag)).real
    at = np.append(at, values[-1].real)  # at Nyquist's frequency L is real, too
    gains = -1.0 / at[(at > -1.0) & (at < 0.0)]
    of_one = _crossings(frequency, np.abs(values) - 1.0)
    left = (np.angle(loop.response(of_one)) + math.pi) % (2.0 * math.pi)
    phases = np.degrees(np.minimum(left, 2.0 * math.pi - left))
    return Margins(
        float(gains.min(initial=math.inf)),
        float(phases.min(initial=math.inf)),
        float((left / of_one).min(initial=math.inf)),
        float(1.0 / np.abs(1.0 + values).min()),
    )


def _crossings(frequency: Array, values: Array) -> Array:
    """Return the frequencies at which values change their sign, by lines in between."""
    i = np.flatnonzero(np.signbit(values[:-1]) != np.signbit(values[1:]))
    share = values[i] / (values[i] - values[i + 1])
    result: Array = frequency[i] + share * (frequency[i + 1] - frequency[i])
    return result


def plot_margins(loops: Mapping[str, Loop], path: Path) -> None:
    """Draw the loops around -1, and how much they amplify a disturbance of each frequency.

    Parameters
    ----------
    loops
        By the name of the controller.
    path
        The PNG file to write.
    """
    palette = colours(list(loops))
    turn = np.linspace(0.0, 2.0 * math.pi, 200)
    with drawn(path, 10, 4.2) as figure:
        plane, sensitivity = figure.subplots(1, 2)
        for name, loop in loops.items():
            frequency = loop.frequencies()
            values = loop.response(frequency)
            plane.plot(values.real, values.imag, color=palette[name], label=name)
            sensitivity.loglog(frequency, 1.0 / np.abs(1.0 + values), color=palette[name])
        for peak, style in ((1.6, "--"), (2.0, ":")):
            plane.plot(
                -1 + np.cos(turn) / peak, np.sin(turn) / peak, style, color="0.4",
                linewidth=1, label=f"Ms = {peak:g}",
            )  # fmt: skip
        plane.plot(-1, 0, "k+")
        plane.set(xlim=(-2.2, 0.8), ylim=(-1.5, 1.5), aspect="equal")
        plane.set(xlabel="Re L", ylabel="Im L", title="the loop around -1")
        plane.legend(fontsize="small", loc="upper left")
        sensitivity.axhline(1.0, color="0.4", linewidth=1)
        sensitivity.set_ylim(bottom=0.02)
        sensitivity.set(xlabel="frequency (rad/s)", title="amplification of a disturbance |S|")
