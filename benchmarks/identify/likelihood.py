"""The likelihood of a log for a delay, a dead zone and orders of A, B and C."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pandas as pd
from numpy.lib.stride_tricks import sliding_window_view
from scipy import ndimage

from benchmarks.identify.armax import Array, Flags, Orders, Rows, Solution
from benchmarks.identify.excitation import LEAST_SAMPLES, check_excitation
from benchmarks.identify.log import Log
from benchmarks.identify.model import CannotTellError, Options
from benchmarks.identify.simulation import held, response

COARSE = 40  # dead zones that are tried first
MOST_GAPS = 250  # that are tried in all
FINEST = 1e-6  # of the temperature's deviation, what its numbers tell
BRIDGE = 10  # missing temperatures in a row that are filled in, for the noise to go on
SHORTEST = 30  # rows of a stretch without a gap
OWN_LAG = -0.3  # the C of first order, below which it cancels a time constant
STILL = 0.99  # the root of C', above which it cancels the random walk
Whiten = Callable[[Array], Array]
OF_KNOWN = 4  # coefficients of a known disturbance


@dataclass(frozen=True, order=True)
class Gap:
    """Neighbours among the magnitudes of the commands that are tried, and the zone between."""

    low: float
    high: float


@dataclass(frozen=True)
class Place:
    """A delay and a place of the dead zone, with the deviance there.

    The deviance is twice the negative log likelihood, but for a constant.
    """

    deviance: float
    delay: int
    gap: Gap


@dataclass(frozen=True, eq=False)
class Candidate:
    """Orders at a place, with the coefficients of maximum likelihood."""

    orders: Orders
    place: Place
    solution: Solution

    @property
    def has_own_lag(self) -> bool:
        """Whether the plant has a second time constant that is not one of the noise."""
        c = self.solution.c
        return self.orders == Orders(2, self.orders.b, 1) and float(c[0]) < OWN_LAG

    @property
    def walks_nowhere(self) -> bool:
        """Whether the random walk is one of (nearly) no variance."""
        roots = np.roots([1.0, *self.solution.c])
        return self.orders.walk and bool(np.max(roots.real, initial=0.0) > STILL)

    @property
    def deviance(self) -> float:
        """Twice the negative log likelihood, but for a constant."""
        return self.place.deviance


@dataclass
class Likelihood:
    """A log in deviations from its operating point, and how well models explain it.

    Parameters
    ----------
    log
        What was recorded.
    options
        What is known.

    Attributes
    ----------
    operating_flow, level : float
        What is subtracted from flow and temperature, t/h and degC.
    u_min, u_max : float
        Limits of the flow, t/h.
    command, output
        u(k), t/h, and y(k), degC, of the log; NaN where they are not known.
    known
        The known disturbances, as deviations from their first values.
    lags
        The delay of each of them, samples.
    magnitudes
        Of the commands, ascending, without 0, t/h.
    rows : Rows
        Those that are predicted: in them all is known that (28) takes, for every delay and all
        orders that are tried.

    Raises
    ------
    CannotTellError
        If the log is too short, or nothing moves in it.
    ValueError
        If the options do not fit to the log.
    """

    log: Log
    options: Options
    longest_b: int = 1
    lags: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        log, options = self.log, self.options
        self.operating_flow = _operating_flow(log.flow, options)
        command = log.flow - self.operating_flow
        self.u_min, self.u_max = _limits(command, options)
        self.command = np.clip(command, self.u_min, self.u_max)
        self.level = float(np.nanmean(log.temperature)) if len(log.temperature) else 0.0
        self.output = log.temperature - self.level
        self.known = [each - each[np.isfinite(each)][0] for each in log.disturbances.values()]
        self.lags = self.lags or [0] * len(self.known)
        # Smaller errors than this are rounding, and no reason for higher orders.
        self.resolution = FINEST**2 * float(np.nanvar(self.output)) if len(self.output) else 0.0
        check_excitation(self.command, self.output)
        magnitudes = np.unique(np.abs(self.command[np.isfinite(self.command)]))
        self.magnitudes = magnitudes[magnitudes > 0.0]
        self.narrow(options.longest_delay)
        if len(self.rows) < LEAST_SAMPLES:
            raise CannotTellError(
                f"the log is too short: {len(self.output)} rows leave {len(self.rows)} without "
                f"a gap in the {options.longest_delay} samples before them, and at least "
                f"{LEAST_SAMPLES} are needed. A shorter --longest-delay needs less; where "
                "many temperatures are missing, resample the log to longer steps"
            )

    def narrow(self, longest_delay: int, last: int | None = None) -> None:
        """Look at delays up to this one only, which may leave more rows; and up to a row."""
        self.longest_delay = longest_delay
        order_a = 3 if self.options.orders is None else self.options.orders.a
        reach = longest_delay + self.longest_b
        missing = ~np.isfinite(self.output)
        filled = pd.Series(self.output).interpolate(limit_direction="both").fillna(0.0)
        self.filled = np.asarray(filled, np.float64)
        bridged = missing & ~_runs(missing, BRIDGE + 1)
        temperatures = _all_of_last(~missing | bridged, order_a + 1)
        flows = _all_of_last(np.isfinite(self.command), reach)
        for known in self.known:
            flows &= _all_of_last(np.isfinite(known), reach + OF_KNOWN)
        usable = temperatures.copy()
        usable[1:] &= flows[:-1]
        usable[: max(order_a, reach + (OF_KNOWN if self.known else 0))] = False
        if last is not None:
            usable[last:] = False
        usable &= _runs(usable, SHORTEST)
        self.rows = Rows(usable, _all_of_last(~missing, order_a + 1))

    def applied(self, gap: Gap) -> Array:
        """Return u_a for a dead zone within a gap."""
        inside = np.abs(self.command) <= gap.low
        result: Array = np.where(inside, 0.0, self.command)
        return np.where(np.isfinite(self.command), result, 0.0)  # of rows that are not used

    def fixed(self, orders: Orders, but: int = -1) -> tuple[Array, Array]:
        """Return the target y(k), and all regressors but the flow, and but one disturbance."""
        rows = self.rows
        known = [
            rows.lagged(np.nan_to_num(each), range(lag + 1, lag + 1 + OF_KNOWN))
            for i, (each, lag) in enumerate(zip(self.known, self.lags, strict=True))
            if i != but
        ]
        past = -rows.lagged(self.filled, range(1, orders.a + 1))
        return self.filled[rows.index], np.hstack([past, *known, rows.levels(orders)])

    def regressors(self, place: Place, orders: Orders) -> tuple[Array, Array]:
        """Return y(k), and -y(k-1) ..., u_a(k-d-1) ..., disturbances and levels."""
        target, columns = self.fixed(orders)
        lags = range(place.delay + 1, place.delay + 1 + orders.b)
        flow = self.rows.lagged(self.applied(place.gap), lags)
        return target, np.hstack([columns[:, : orders.a], flow, columns[:, orders.a :]])

    def fit(self, place: Place, orders: Orders, start: Array | None = None) -> Candidate:
        """Return the fit of maximum likelihood."""
        target, columns = self.regressors(place, orders)
        solution = self.rows.solve(target, columns, orders.noise, start, walk=orders.walk)
        return self._candidate(orders, place, solution)

    def best_fit(self, place: Place, orders: Orders, start: Array) -> Candidate:
        """Return the better of two fits: there may be a peak with a slow C and one without."""
        slow = np.asarray(np.poly([0.8, 0.95][: 1 + orders.walk]), float)[1 : orders.noise + 1]
        starts = [start, slow] if orders.a > 1 and orders.noise else [start]
        fits = [self.fit(place, orders, each) for each in starts]
        return min(fits, key=lambda fit: fit.deviance)

    def white(self, columns: Array, c: Array, orders: Orders) -> Array:
        """Return columns whitened by C, in the rows that count."""
        return self.rows.whitened(columns, c, walk=orders.walk)[self.rows.counts]

    def linear(self, place: Place, orders: Orders, c: Array) -> Candidate:
        """Return the fit with a given C."""
        target, columns = self.regressors(place, orders)
        white = self.white(np.column_stack([target, columns]), c, orders)
        found, *_ = np.linalg.lstsq(white[:, 1:], white[:, 0], rcond=None)
        linear = found.astype(np.float64)
        errors = white[:, 0] - white[:, 1:] @ linear
        return self._candidate(orders, place, Solution(linear, c, errors))

    def _candidate(self, orders: Orders, place: Place, solution: Solution) -> Candidate:
        found = Place(self.deviance(solution.square), place.delay, place.gap)
        return Candidate(orders, found, solution)

    def deviance(self, square: float) -> float:
        """Return twice the negative log likelihood, but for a constant."""
        count = len(self.rows)
        return count * math.log(max(square, count * self.resolution, 1e-300))

    def criterion(self, orders: Orders, deviance: float, *, mild: bool = False) -> float:
        """Return the Bayesian information criterion, or the milder one of Akaike.

        A coefficient of B beyond the first counts twice: it is chosen, as the delay is, from
        several places, and one before or behind the right ones gains by chance.
        """
        price = 2.0 if mild else math.log(len(self.rows))
        return deviance + (orders.count + orders.b - 1) * price

    def gaps(self) -> list[Gap]:
        """Return places of the dead zone to begin with."""
        if self.options.applied:
            return [Gap(0.0, 0.0)]
        edges = np.concatenate([[0.0], self.magnitudes])
        places = np.linspace(0, len(edges) - 1, min(len(edges), COARSE)).round().astype(int)
        return [Gap(low, high) for low, high in itertools.pairwise(edges[places].tolist())]

    def halves(self, gap: Gap) -> list[Gap]:
        """Return a gap in two, if there are magnitudes in between."""
        low, high = np.searchsorted(self.magnitudes, [gap.low, gap.high], "left")
        low += gap.low > 0.0
        if high <= low:
            return [gap]
        middle = float(self.magnitudes[(low + high) // 2])
        if not gap.low < middle < gap.high:
            return [gap]
        return [Gap(gap.low, middle), Gap(middle, gap.high)]

    def scan(
        self, orders: Orders, c: Array, gaps: list[Gap], delays: range | None = None
    ) -> list[Place]:
        """Return the deviance of every delay and gap with a given C, the best first."""
        delays = delays or range(self.longest_delay + 1)
        others = self._projection(*self.fixed(orders), orders, c)
        found = []
        for gap in gaps:
            deviances = self._deviances(self.applied(gap), delays, orders.b, others)
            found += [
                Place(float(deviance), delay, gap)
                for delay, deviance in zip(delays, deviances, strict=True)
            ]
        return sorted(found, key=lambda place: place.deviance)

    def place_known(self, place: Place, orders: Orders, c: Array) -> None:
        """Find the delay of each known disturbance, with all else as it is."""
        lags = range(place.delay + 1, place.delay + 1 + orders.b)
        for i, known in enumerate(self.known):
            target, columns = self.fixed(orders, but=i)
            columns = np.hstack([columns, self.rows.lagged(self.applied(place.gap), lags)])
            others = self._projection(target, columns, orders, c)
            deviances = self._deviances(
                np.nan_to_num(known), range(self.longest_delay + 1), OF_KNOWN, others
            )
            self.lags[i] = int(np.argmin(deviances))

    def _projection(
        self, target: Array, columns: Array, orders: Orders, c: Array
    ) -> tuple[Array, Whiten]:
        """Return what columns leave of the target, whitened, and how to treat others alike."""
        white = self.white(np.column_stack([target, columns]), c, orders)
        basis, _ = np.linalg.qr(white[:, 1:])

        def left(values: Array) -> Array:
            result: Array = values - basis @ (basis.T @ values)
            return result

        return left(white[:, 0]), lambda values: left(self.white(values, c, orders))

    def _deviances(
        self, signal: Array, delays: range, length: int, others: tuple[Array, Whiten]
    ) -> Array:
        """Return the deviance with `length` coefficients of a signal, for every delay."""
        left, treated = others
        lags = range(delays[0] + 1, delays[-1] + 1 + length)
        inputs = treated(self.rows.lagged(signal, lags))
        gram, moments = inputs.T @ inputs, inputs.T @ left
        ridge = 1e-10 * max(float(np.trace(gram)) / len(gram), 1e-300)
        places = np.arange(len(delays))[:, np.newaxis] + np.arange(length)
        blocks = gram[places[:, :, np.newaxis], places[:, np.newaxis, :]]
        blocks = blocks + ridge * np.eye(length)
        shares = sliding_window_view(moments, length)
        solved = np.linalg.solve(blocks, shares[:, :, np.newaxis])[:, :, 0]
        squares = float(left @ left) - np.sum(shares * solved, axis=1)
        count = len(self.rows)
        least = max(count * self.resolution, 1e-300)
        deviances: Array = count * np.log(np.maximum(squares, least))
        return deviances

    def parts(self, fit: Candidate) -> tuple[Array, Array, Array]:
        """Return A with its 1, B, and the B of each known disturbance."""
        a, b, linear = fit.orders.a, fit.orders.b, fit.solution.linear
        end = a + b + OF_KNOWN * len(self.known)
        known = linear[a + b : end].reshape(-1, OF_KNOWN)
        return np.concatenate([[1.0], linear[:a]]), linear[a : a + b], known

    def errors(self, fit: Candidate) -> Array:
        """Return the prediction errors of all rows, of the bridged ones too; NaN elsewhere."""
        target, columns = self.regressors(fit.place, fit.orders)
        left = target - columns @ fit.solution.linear
        result = np.full(len(self.output), np.nan)
        result[self.rows.index] = self.rows.whitened(left, fit.solution.c, walk=fit.orders.walk)
        return result

    def simulated(self, fit: Candidate) -> Array:
        """Return what flow and known disturbances do to the temperature, degC."""
        a, b, of_known = self.parts(fit)
        flow = held(np.where(np.isfinite(self.command), self.applied(fit.place.gap), np.nan))
        total = response(a.tolist(), b.tolist(), fit.place.delay, flow)
        for values, lag, each in zip(self.known, self.lags, of_known, strict=True):
            total = total + response(a.tolist(), each.tolist(), lag, held(values))
        return total

    def gained(self, best: Candidate) -> float:
        """Return what the flow adds to twice the log likelihood."""
        orders = best.orders
        target, columns = self.fixed(orders)
        none = self.rows.solve(target, columns, orders.noise, best.solution.c, walk=orders.walk)
        return self.deviance(none.square) - best.deviance


def _operating_flow(flow: Array, options: Options) -> float:
    known = flow[np.isfinite(flow)]
    if options.operating_flow is not None:
        low, high = known.min(initial=np.inf), known.max(initial=-np.inf)
        if not 11.0 * low - 10.0 * high <= options.operating_flow <= 11.0 * high - 10.0 * low:
            raise ValueError(
                f"operating_flow must be near the flows of the log, {low:g} to {high:g} t/h, "
                f"got {options.operating_flow:g}"
            )
        return options.operating_flow
    if not len(known) or known.min() < 0.0 < known.max():
        return 0.0
    return float(known[0])


def _limits(command: Array, options: Options) -> tuple[float, float]:
    known = command[np.isfinite(command)]
    low = float(known.min(initial=0.0)) if options.u_min is None else options.u_min
    high = float(known.max(initial=0.0)) if options.u_max is None else options.u_max
    if not low < high and len(known) and np.ptp(known):
        raise ValueError(f"u_min must be below u_max, got {low:g} and {high:g}")
    return low, high


def _all_of_last(flags: Flags, count: int) -> Flags:
    """Return where the last `count` flags, its own included, are all true."""
    return np.asarray(pd.Series(flags).rolling(count, min_periods=1).min(), np.bool_)


def _runs(flags: Flags, least: int) -> Flags:
    """Return where flags are true in runs of at least this length."""
    return np.asarray(ndimage.binary_opening(flags, np.ones(least)))
