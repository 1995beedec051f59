"""Fit a plant with a delay and one to three lags to a log, by weighted output error."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares
from scipy.signal import lfilter

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

BLOCKS = 30  # means of the temperature in a delay and a lag: more take time, and say no more


@dataclass(frozen=True)
class Plant:
    """Lags side by side behind one delay: exp(-delay s) times the sum of gain / (1 + lag s)."""

    delay: float  # s
    lags: Complex  # time constants, s; those of a plant that oscillates are complex
    gains: Complex  # degC per t/h, one for each lag

    @property
    def gain(self) -> float:
        """Steady-state gain, degC per t/h."""
        return float(self.gains.sum().real)

    @property
    def slowest(self) -> float:
        """Largest time constant, s."""
        return float(np.abs(self.lags).max())

    def first_order(self) -> tuple[float, float]:
        """Return time constant and delay, s, of a first-order plant like it.

        Skogestad's half rule (Journal of Process Control 13, 2003, 291-309): of what the mean
        lag has beyond the slowest one, half goes to the time constant and half to the delay.
        """
        mean = float((self.gains * self.lags).sum().real) / self.gain
        slow = min(self.slowest, max(mean, self.slowest / 5.0))
        half = max(mean - slow, 0.0) / 2.0
        return slow + half, self.delay + half

    def sampled(self, h: float) -> tuple[int, Complex, Complex]:
        """Return whole samples of delay, and B and A of the lags for flows held for h, exactly.

        There is a row for each lag. B begins with z^-1, as in (28), and has two coefficients.
        """
        whole = int(self.delay / h)
        poles = np.exp(-h / self.lags)
        # What a lag forgets in the rest of a sample, once the flow has arrived.
        kept = np.exp((self.delay - whole * h - h) / self.lags)
        upper = self.gains * np.array([1.0 - kept, kept - poles])
        return whole, upper.T, np.array([np.ones(len(poles)), -poles]).T

    def response(self, h: float, frequency: Array) -> Complex:
        """Return the frequency response from one sample to the next, at rad/s."""
        whole, b, a = self.sampled(h)
        back = np.exp(-1j * h * frequency)
        powers = np.array([np.ones(len(back)), back])
        return np.asarray(((b @ powers) / (a @ powers)).sum(axis=0) * back ** (whole + 1))

    def simulated(self, flow: Array, h: float) -> Array:
        """Return the temperatures of a plant that has been at rest before the flow."""
        whole, upper, lower = self.sampled(h)
        # The imaginary parts of a pair of complex lags cancel.
        moved = [lfilter([0.0, *b], a, flow).real for b, a in zip(upper, lower, strict=True)]
        return np.asarray(np.concatenate([np.zeros(whole), sum(moved)])[: len(flow)])


def in_series(lags: ArrayLike, delay: float = 0.0) -> Plant:
    """Return the plant of gain 1 with lags behind one another, by partial fractions."""
    each = np.asarray(lags, np.complex128)
    others = each[:, np.newaxis] - each
    np.fill_diagonal(others, 1.0)
    return Plant(delay, each, each ** (len(each) - 1) / np.prod(others, axis=1))


class Solution(NamedTuple):
    """The best coefficients, those of the plants first, and what they leave."""

    c: Array
    errors: Array  # of the blocks, weighted: white noise if all is right
    weighted: Array  # the columns that the coefficients multiply, weighted


@dataclass(frozen=True)
class Fit:
    """A log, what is known so far of its valve, noise and loads, and a plant for it."""

    flow: Array  # behind the valve, row by row, t/h from where it was at first
    temperature: Array  # means of blocks of rows, degC from the mean; NaN where unknown
    h: float  # sampling interval of the rows, s
    known: tuple[Array, ...] = ()  # measured disturbances, row by row
    rows: int = 1  # in a block
    scale: float = 1.0  # delay and lag, s, roughly: the unit of the delay among the parameters
    # The polynomial that makes the noise of the blocks white.
    weights: Array = field(default_factory=lambda: np.array([1.0, -0.8]))
    loads: tuple[float, ...] = ()  # times of steps of an unmeasured load, s
    extra: tuple[Array, ...] = ()  # further inputs of the plant, with gains of their own
    shape: str = "one lag"  # of the plant
    # The delay, the logarithm of the first lag, and one more.
    p: Array = field(default_factory=lambda: np.zeros(2))

    def at(self, p: Array) -> "Fit":
        """Return the fit of other parameters."""
        return replace(self, p=p)

    def behind(self, passed: Array) -> "Fit":
        """Return the fit with another flow behind the valve."""
        return replace(self, flow=passed - passed[0])

    def means(self, x: Array) -> Array:
        """Return the means of blocks of rows."""
        count = len(x) // self.rows
        return np.asarray(x[: count * self.rows].reshape(count, self.rows).mean(axis=1))

    def in_blocks(self, rows: int) -> "Fit":
        """Return the fit to a log of single rows in blocks."""
        blocks = replace(self, rows=rows)
        return replace(blocks, temperature=blocks.means(self.temperature))

    @cached_property
    def units(self) -> list[Plant]:
        """The plants of gain 1 whose weighted sum is the plant."""
        delay, longest = self.scale * max(float(self.p[0]), 0.0), len(self.flow) * self.h / 3.0
        first = float(np.exp(np.clip(self.p[1], np.log(self.h / 4.0), np.log(longest))))
        # The second is never quite the first: equal ones have no partial fractions.
        second = first * min(np.exp(np.clip(self.p[-1], -6.0, 0.0)), 0.97)
        turned = np.exp(1j * np.clip(self.p[-1], 0.1, 1.45) * np.array([1.0, -1.0]))
        units: dict[str, list[ArrayLike]] = {
            "one lag": [[first]],
            "two lags": [[first, second]],
            "three lags": [[first, second, 0.9 * second]],
            "a zero": [[first], [second]],
            "a pair": [first * turned],
        }
        return [in_series(lags, delay) for lags in units[self.shape]]

    @cached_property
    def columns(self) -> tuple[Array, int]:
        """What temperatures are a weighted sum of, and how many of these are inputs.

        After these come what is left of the time before the log, the loads and the base line.
        """
        times, units = np.arange(len(self.flow)) * self.h, self.units
        lag = units[0].slowest
        late, now = in_series([lag], units[0].delay), in_series([lag])
        # A disturbance has lags of its own: three fixed ones make any slow response.
        wide = [in_series([ratio * lag]) for ratio in (0.3, 1.0, 3.0)]
        found = [unit.simulated(self.flow, self.h) for unit in units]
        found += [late.simulated(each, self.h) for each in self.extra]
        found += [plant.simulated(each, self.h) for each in self.known for plant in wide]
        inputs = len(found)
        for each in np.unique(np.concatenate([unit.lags for unit in units])):
            decay = np.exp(-times / each)
            found.append(decay.real if each.imag >= 0.0 else decay.imag)
        found += [now.simulated(np.heaviside(times - at, 1.0), self.h) for at in self.loads]
        found.append(np.ones(len(times)))
        return np.column_stack([self.means(each) for each in found]), inputs

    @cached_property
    def solution(self) -> Solution:
        """The best coefficients for the parameters."""
        table, inputs = self.columns
        whole, n = np.column_stack([table, self.temperature]), len(self.weights)
        w = sum(
            share * whole[n - 1 - i : len(whole) - i] for i, share in enumerate(self.weights)
        )
        w = w[np.isfinite(w[:, -1])]
        a, b = w[:, :-1], w[:, -1]
        # Start, loads and base line are within a few deviations of the log.
        weak = np.zeros(a.shape[1])
        weak[inputs:] = b.std() / (5.0 * np.nanstd(self.temperature))
        size = np.sqrt((a**2).sum(axis=0) + weak**2) + 1e-12
        square = (a / size).T @ (a / size) + np.diag((weak / size) ** 2 + 1e-11)
        c = np.linalg.solve(square, (a / size).T @ b) / size
        return Solution(c, b - a @ c, a)

    @cached_property
    def deviance(self) -> float:
        """Minus twice the logarithm of the likelihood."""
        errors = self.solution.errors
        return len(errors) * float(np.log(np.mean(errors**2) + 1e-14))

    @property
    def price(self) -> float:
        """Akaike's criterion."""
        return self.deviance + 2.0 * (len(self.p) + len(self.units))

    @property
    def plant(self) -> Plant:
        """The plant of the best coefficients."""
        return self.plant_of(self.solution.c)

    def plant_of(self, c: Array) -> Plant:
        """Return the plant of other coefficients."""
        gains = [x * each.gains for x, each in zip(c, self.units, strict=False)]
        lags = np.concatenate([each.lags for each in self.units])
        return Plant(self.units[0].delay, lags, np.concatenate(gains))

    def refined(self, evaluations: int = 40) -> "Fit":
        """Return the fit of the least deviance near the parameters."""
        # Steps are relative to the place: about 1, so that all are as long.
        found = least_squares(
            lambda q: self.at(self.p + q - 1.0).solution.errors, np.ones(len(self.p)),
            method="lm", diff_step=0.01, ftol=3e-5, xtol=1e-3, max_nfev=evaluations,
        )  # fmt: skip
        return self.at(self.p + found.x - 1.0)

    def reweighted(self) -> "Fit":
        """Return the fit with weights from the noise that this one leaves."""
        table, inputs = self.columns
        left = self.temperature - table[:, :inputs] @ self.solution.c[:inputs]
        order = min(8, len(left) // 15)
        lagged = np.column_stack([left[order - i : len(left) - i] for i in range(order + 1)])
        lagged = lagged[np.isfinite(lagged).all(axis=1)]
        past = np.column_stack([lagged[:, 1:], np.ones(len(lagged))])
        c = np.linalg.lstsq(past, lagged[:, 0], rcond=None)[0]
        return replace(self, weights=np.r_[1.0, -c[:-1]])
