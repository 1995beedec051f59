"""Estimates of a plant, with intervals: from the fits that the search is left with."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from scipy import linalg, optimize, stats

from benchmarks.identify.armax import Array, Orders, Solution
from benchmarks.identify.likelihood import Candidate, Gap, Likelihood
from benchmarks.identify.model import CONFIDENCE, Interval

THRESHOLD = float(stats.chi2.ppf(CONFIDENCE, 1))  # of twice a difference of log likelihoods
ENDS = (1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2  # of the posterior, where an interval ends


class Estimates:
    """What fits of the same orders, for several delays and dead zones, say of the plant.

    Parameters
    ----------
    likelihood
        Of the log.
    orders
        Of A, B and C.
    fits
        The best first.

    Attributes
    ----------
    delay, dead_zone : Interval
        Samples and t/h.
    chosen : Candidate
        The fit of these two.
    """

    def __init__(
        self, likelihood: Likelihood, orders: Orders, fits: Sequence[Candidate]
    ) -> None:
        self._likelihood, self._orders = likelihood, orders
        self._least = least = fits[0].deviance
        self._within = [fit for fit in fits if fit.deviance - least < THRESHOLD]
        weights = np.array([math.exp((least - fit.deviance) / 2.0) for fit in fits])
        if likelihood.options.find_dead_zone:
            weights *= [fit.gap.width for fit in fits]
        weights /= weights.sum()
        self.delay = _of_delay(fits, weights)
        self.dead_zone = _of_dead_zone(fits, weights)
        self.chosen = max(
            (fit for fit in fits if fit.delay == self.delay.value),
            key=lambda fit: (
                fit.gap.low <= self.dead_zone.value <= fit.gap.high,
                -fit.deviance,
            ),
        )

    def gain(self) -> Interval:
        """Return the steady-state gain, degC per t/h."""
        return self._profile(self._within, _gain, self._with_gain)

    def time_constant(self) -> Interval:
        """Return the time constant of the slowest pole, samples; no ends if it is complex."""
        real = [fit for fit in self._within if _slowest_is_real(fit.solution, self._orders)]
        if not real:
            value = _time_constant(self.chosen.solution, self._orders)
            return Interval(value, math.nan, math.nan)
        return self._profile(real, _time_constant, self._with_time_constant)

    def noise_variance(self) -> Interval:
        """Return R, degC^2."""
        freedom = len(self._likelihood.rows) - self._orders.count
        low, high = stats.chi2.ppf(ENDS, freedom)
        square = self.chosen.solution.square
        return Interval(square / freedom, square / float(high), square / float(low))

    def coefficients(self, covariance: Array) -> dict[str, Interval]:
        """Return A, B and C with intervals from the curvature of the likelihood, by name."""
        orders, solution = self._orders, self.chosen.solution
        values = np.concatenate([solution.linear[:-1], solution.c])
        spreads = stats.norm.ppf(ENDS[1]) * np.sqrt(np.diag(covariance))
        names = [
            f"{letter}{i}"
            for letter, count in (("a", orders.a), ("b", orders.b), ("c", orders.c))
            for i in range(1, count + 1)
        ]
        return {
            name: Interval(float(value), float(value - spread), float(value + spread))
            for name, value, spread in zip(names, values, spreads, strict=True)
        }

    def covariance(self) -> Array:
        """Return the covariance of the coefficients of A, B and C, without the constant."""
        rows, orders, solution = self._likelihood.rows, self._orders, self.chosen.solution
        _, columns = self._likelihood.regressors(self.chosen.delay, self.chosen.gap, orders)
        white = rows.whitened(columns, solution.c)
        slope = rows.whitened(solution.errors[:, np.newaxis], solution.c)[:, 0]
        lags = np.column_stack(
            [np.zeros((len(slope), 0))]
            + [np.concatenate([np.zeros(i), slope[:-i]]) for i in range(1, orders.c + 1)]
        )
        jacobian = np.hstack([white[:, :-1], lags, white[:, -1:]])
        information = jacobian.T @ jacobian
        variance = solution.square / (len(rows) - orders.count)
        return np.asarray(variance * linalg.pinvh(information))[:-1, :-1]

    def _profile(
        self,
        candidates: Sequence[Candidate],
        measure: Callable[[Solution, Orders], float],
        constrain: Callable[[float, Candidate], tuple[Array, Array]],
    ) -> Interval:
        """Return where the likelihood, at its best in all else, is near its maximum."""
        value = measure(self.chosen.solution, self._orders)
        ends = [value]
        for candidate in candidates:
            centre = measure(candidate.solution, self._orders)
            shortfall = partial(self._shortfall, candidate, constrain)
            ends += [_edge(shortfall, centre, direction) for direction in (-1.0, 1.0)]
        return Interval(value, min(ends), max(ends))

    def _shortfall(
        self,
        candidate: Candidate,
        constrain: Callable[[float, Candidate], tuple[Array, Array]],
        value: float,
    ) -> float:
        target, columns = constrain(value, candidate)
        solution = self._likelihood.rows.solve(
            target, columns, self._orders.c, candidate.solution.c
        )
        short = max(self._likelihood.deviance(solution.square) - self._least, 0.0)
        return math.sqrt(short) - math.sqrt(THRESHOLD)  # nearly straight, to be solved fast

    def _with_gain(self, gain: float, candidate: Candidate) -> tuple[Array, Array]:
        """Return target and regressors that leave the steady-state gain no choice.

        The last coefficient of B is gain A(1) less the others.
        """
        orders = self._orders
        target, columns = self._likelihood.regressors(candidate.delay, candidate.gap, orders)
        last = columns[:, orders.a + orders.b - 1]
        reduced = np.delete(columns, orders.a + orders.b - 1, axis=1)
        reduced[:, : orders.a] += gain * last[:, np.newaxis]
        reduced[:, orders.a : orders.a + orders.b - 1] -= last[:, np.newaxis]
        return target - gain * last, reduced

    def _with_time_constant(self, samples: float, candidate: Candidate) -> tuple[Array, Array]:
        """Return target and regressors that leave one pole no choice: the rest of A is free."""
        orders = self._orders
        pole = math.exp(-1.0 / samples)
        target, columns = self._likelihood.regressors(candidate.delay, candidate.gap, orders)
        lags = np.column_stack([target, -columns[:, : orders.a]])  # y(k), y(k-1), ...
        slow = lags[:, :-1] - pole * lags[:, 1:]
        return slow[:, 0], np.hstack([-slow[:, 1:], columns[:, orders.a :]])


def polynomials(
    solution: Solution, orders: Orders
) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...], float]:
    """Return A, B and C with their leading 1s, and the constant."""
    linear = solution.linear.tolist()
    a = (1.0, *linear[: orders.a])
    b = tuple(linear[orders.a : orders.a + orders.b])
    return a, b, (1.0, *solution.c.tolist()), linear[-1]


def _gain(solution: Solution, orders: Orders) -> float:
    a, b, *_ = polynomials(solution, orders)
    return sum(b) / sum(a)


def _slowest(solution: Solution, orders: Orders) -> complex:
    """Return the pole that a step response ends with: the largest real one above 0, if any.

    Poles below 0, whose responses change sign at every sample, tell how the noise is made.
    """
    poles = np.roots(polynomials(solution, orders)[0])
    settling = poles[np.isreal(poles) & (poles.real > 0.0)]
    chosen = settling if len(settling) else poles
    return complex(chosen[np.argmax(np.abs(chosen))])


def _slowest_is_real(solution: Solution, orders: Orders) -> bool:
    pole = _slowest(solution, orders)
    return pole.imag == 0.0 and 0.0 < pole.real < 1.0


def _time_constant(solution: Solution, orders: Orders) -> float:
    """Return the time constant of the slowest pole, samples."""
    size = min(max(abs(_slowest(solution, orders)), 1e-12), 1.0 - 1e-9)
    return -1.0 / math.log(size)


def _edge(shortfall: Callable[[float], float], centre: float, direction: float) -> float:
    """Return where a shortfall comes to 0, going from a centre up or down in magnitude."""
    if shortfall(centre) >= 0.0:
        return centre
    near, factor = centre, 1.0
    for _ in range(12):
        factor *= 1.1 if factor < 1.5 else 1.5
        far = centre * factor**direction
        if shortfall(far) >= 0.0:
            low, high = sorted((near, far))
            return float(optimize.brentq(shortfall, low, high, rtol=1e-3, xtol=1e-9))
        near = far
    return math.copysign(math.inf, centre) if direction > 0 else 0.0


def _of_delay(fits: Sequence[Candidate], weights: Array) -> Interval:
    """Return the delay that has most of the posterior within one sample, and its interval."""
    delays = np.array([fit.delay for fit in fits])
    tried = np.unique(delays)
    shares = np.array([weights[delays == delay].sum() for delay in tried])
    near = np.abs(tried[:, np.newaxis] - tried) <= 1
    # Of equal ones, the delay that is itself the likelier.
    value = tried[np.lexsort((shares, (near @ shares).round(6)))[-1]]
    sums = np.cumsum(shares)
    low, high = (
        float(tried[min(int(np.searchsorted(sums, share)), len(tried) - 1)]) for share in ENDS
    )
    return Interval(float(value), min(low, float(value)), max(high, float(value)))


def _of_dead_zone(fits: Sequence[Candidate], weights: Array) -> Interval:
    """Return the dead zone: its posterior is spread evenly within each gap."""
    shares: dict[Gap, float] = {}
    for fit, weight in zip(fits, weights, strict=True):
        shares[fit.gap] = shares.get(fit.gap, 0.0) + float(weight)
    gaps = sorted(shares, key=lambda gap: gap.low)

    def at(probability: float) -> tuple[Gap, float]:
        below = 0.0
        for gap in gaps:
            if below + shares[gap] >= probability:
                inside = gap.width * (probability - below) / shares[gap]
                return gap, gap.low + inside
            below += shares[gap]
        return gaps[-1], gaps[-1].high

    # The likelihood is the same all over a gap: the interval takes gaps as a whole.
    low = at(ENDS[0])[0].low
    high = at(ENDS[1])[0].high
    if gaps[0].low == 0.0 and shares[gaps[0]] > 0.5:
        return Interval(0.0, 0.0, high)  # every command has had an effect
    return Interval(at(0.5)[1], low, high)
