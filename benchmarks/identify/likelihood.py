"""The likelihood of a log for a delay, a dead zone and orders of A, B and C."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.identify.armax import Array, Orders, Rows, Solution
from benchmarks.identify.excitation import LEAST_SAMPLES, check_excitation
from benchmarks.identify.log import Log
from benchmarks.identify.model import CannotTellError, Options

ALL_ORDERS = tuple(Orders(a, b, c) for a in (1, 2, 3) for b in (1, 2, 3) for c in (0, 1, 2, 3))
MAGNITUDES = 40  # most dead zones that are tried at once
FINEST = 1e-6  # of the temperature's deviation, what its numbers tell


@dataclass(frozen=True)
class Gap:
    """Two neighbours among the magnitudes of the commands, with the dead zone between them."""

    low: float
    high: float

    @property
    def width(self) -> float:
        """How far they are apart, t/h."""
        return self.high - self.low


@dataclass(frozen=True)
class Candidate:
    """A delay and a place of the dead zone, with what the log says to them."""

    delay: int
    gap: Gap
    solution: Solution
    deviance: float  # twice the negative log likelihood, but for a constant


Place = tuple[float, int, Gap]  # a deviance, and the delay and the gap that have it


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
    magnitudes
        Of the commands, ascending, without 0, t/h.
    orders : tuple of Orders
        Those that are tried.
    longest_delay : int
        The longest that is tried, samples.
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

    def __init__(self, log: Log, options: Options) -> None:
        self.options = options
        self.operating_flow = _operating_flow(log.flow, options)
        command = log.flow - self.operating_flow
        self.u_min, self.u_max = _limits(command, options)
        self.command = np.clip(command, self.u_min, self.u_max)
        self.level = float(np.nanmean(log.temperature)) if len(log.temperature) else 0.0
        self.output = log.temperature - self.level
        # Smaller errors than this are rounding, and no reason for higher orders.
        self.resolution = FINEST**2 * float(np.nanvar(self.output)) if len(self.output) else 0.0
        check_excitation(self.command, self.output)
        magnitudes = np.unique(np.abs(self.command[np.isfinite(self.command)]))
        self.magnitudes = magnitudes[magnitudes > 0.0]
        self.orders = (options.orders,) if options.orders else ALL_ORDERS
        self.narrow(options.longest_delay)
        if len(self.rows) < LEAST_SAMPLES:
            raise CannotTellError(
                f"the log is too short: {len(self.output)} rows leave {len(self.rows)} without "
                f"a gap in the {options.longest_delay} samples before them, and at least "
                f"{LEAST_SAMPLES} are needed. A shorter --longest-delay needs less"
            )

    def narrow(self, longest_delay: int) -> None:
        """Look at delays up to this one only, which may leave more rows to predict."""
        self.longest_delay = longest_delay
        order_a = max(orders.a for orders in self.orders)
        reach = longest_delay + max(orders.b for orders in self.orders)
        flow, temperature = np.isfinite(self.command), np.isfinite(self.output)
        known = _all_of_last(temperature, order_a + 1)
        flows = _all_of_last(flow, reach)
        known[1:] &= flows[:-1]
        known[: max(order_a, reach)] = False
        self.rows = Rows(known)

    def applied(self, gap: Gap) -> Array:
        """Return u_a for a dead zone within a gap."""
        inside = np.abs(self.command) <= gap.low
        result: Array = np.where(inside, 0.0, self.command)
        return np.where(np.isfinite(self.command), result, 0.0)  # of rows that are not used

    def regressors(self, delay: int, gap: Gap, orders: Orders) -> tuple[Array, Array]:
        """Return the target y(k), and -y(k-1) ..., u_a(k-d-1) ... and 1."""
        rows, lags = self.rows, range(1, orders.a + 1)
        inputs = range(delay + 1, delay + 1 + orders.b)
        columns = (
            -rows.lagged(self.output, lags),
            rows.lagged(self.applied(gap), inputs),
            np.ones((len(rows), 1)),
        )
        return self.output[rows.index], np.hstack(columns)

    def fit(
        self, delay: int, gap: Gap, orders: Orders, start: Array | None = None
    ) -> Candidate:
        """Return the fit of maximum likelihood."""
        target, columns = self.regressors(delay, gap, orders)
        solution = self.rows.solve(target, columns, orders.c, start)
        return Candidate(delay, gap, solution, self.deviance(solution.square))

    def deviance(self, square: float) -> float:
        """Return twice the negative log likelihood, but for a constant."""
        count = len(self.rows)
        return count * math.log(max(square, count * self.resolution))

    def gaps(self, around: Gap | None = None) -> list[Gap]:
        """Return the places of the dead zone to try: all, or in detail around one of them."""
        m = self.magnitudes
        if not self.options.find_dead_zone:
            return [Gap(0.0, 0.0)]
        edges = np.concatenate([[0.0], m])
        if around is not None:
            width = around.width
            low, high = around.low - width, around.high + width
            edges = edges[(edges >= low) & (edges <= high)]
        if len(edges) > MAGNITUDES:
            places = np.linspace(0, len(edges) - 1, MAGNITUDES).round().astype(int)
            edges = edges[places]
        return [Gap(low, high) for low, high in itertools.pairwise(edges.tolist())]

    def scan(self, orders: Orders, c: Array, gaps: list[Gap]) -> list[Place]:
        """Return the deviance of every delay and gap with a given C, the best first."""
        rows, count = self.rows, self.longest_delay + 1
        target, columns = self.regressors(0, Gap(0.0, 0.0), Orders(orders.a, 0, orders.c))
        basis, _ = np.linalg.qr(rows.whitened(columns, c))
        white = rows.whitened(target[:, np.newaxis], c)[:, 0]
        white = white - basis @ (basis.T @ white)
        total = float(white @ white)
        found = []
        for gap in gaps:
            inputs = rows.lagged(self.applied(gap), range(1, count + orders.b))
            inputs = rows.whitened(inputs, c)
            inputs = inputs - basis @ (basis.T @ inputs)
            gram, moments = inputs.T @ inputs, inputs.T @ white
            ridge = 1e-10 * max(float(np.trace(gram)) / len(gram), 1e-300)
            for delay in range(count):
                span = slice(delay, delay + orders.b)
                block = gram[span, span] + ridge * np.eye(orders.b)
                explained = moments[span] @ np.linalg.solve(block, moments[span])
                found.append((self.deviance(total - float(explained)), delay, gap))
        found.sort(key=lambda entry: entry[0])
        return found

    def gained(self, best: Candidate, orders: Orders) -> float:
        """Return what the flow adds to twice the log likelihood."""
        target, columns = self.regressors(best.delay, best.gap, orders)
        without = np.delete(columns, np.s_[orders.a : orders.a + orders.b], axis=1)
        none = self.rows.solve(target, without, orders.c, best.solution.c)
        return self.deviance(none.square) - best.deviance


def _operating_flow(flow: Array, options: Options) -> float:
    if options.operating_flow is not None:
        return options.operating_flow
    known = flow[np.isfinite(flow)]
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


def _all_of_last(flags: NDArray[np.bool_], count: int) -> NDArray[np.bool_]:
    """Return where the last `count` flags, its own included, are all true."""
    unset = np.concatenate([[0], np.cumsum(~flags)])
    ends = np.arange(1, len(flags) + 1)
    result: NDArray[np.bool_] = unset[ends] == unset[np.maximum(ends - count, 0)]
    return result
