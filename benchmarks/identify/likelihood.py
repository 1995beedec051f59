"""The likelihood of a log for a delay, a dead zone and orders of A, B and C."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable
from copy import copy
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.lib.stride_tricks import sliding_window_view
from scipy import ndimage

from benchmarks.identify.armax import Array, Flags, Orders, Rows
from benchmarks.identify.excitation import LEAST_SAMPLES, check_excitation
from benchmarks.identify.log import Log
from benchmarks.identify.model import CannotTellError
from benchmarks.identify.options import Knowledge
from benchmarks.identify.simulation import from_rest, held
from benchmarks.loop.linear import LinearModel

COARSE = 40  # dead zones that are tried first
FINEST = 1e-6  # of the temperature's deviation, what its numbers tell
BRIDGE = 10  # missing temperatures in a row that are filled in, for the noise to go on
SHORTEST = 30  # rows of a stretch without a gap
OWN_LAG = -0.3  # the C of first order, below which it cancels a time constant
STILL = 0.99  # the root of C', above which it cancels the random walk
OF_KNOWN = 4  # coefficients of a known disturbance


class Gap(NamedTuple):
    """Neighbours among the magnitudes of the commands that are tried, and the zone between."""

    low: float
    high: float


class Place(NamedTuple):
    """A delay and a place of the dead zone, with the deviance there.

    The deviance is twice the negative log likelihood, but for a constant.
    """

    delay: int
    gap: Gap
    deviance: float = math.nan


@dataclass(frozen=True, eq=False)
class Fit:
    """What is likeliest for some orders at a place.

    Attributes
    ----------
    orders, place
        Of what is fitted.
    linear
        Coefficients of the regressors.
    c
        C, or C' with a walk, from z^-1 on.
    errors
        The prediction errors xi of the rows that are predicted.
    square
        The sum of their squares, in the rows that count.
    """

    orders: Orders
    place: Place
    linear: Array
    c: Array
    errors: Array
    square: float

    @property
    def has_own_lag(self) -> bool:
        """Whether the plant has a second time constant that is not one of the noise."""
        return self.orders == Orders(2, self.orders.b, 1) and float(self.c[0]) < OWN_LAG

    @property
    def walks_nowhere(self) -> bool:
        """Whether the random walk is one of (nearly) no variance."""
        roots = np.roots([1.0, *self.c])
        return self.orders.walk and bool(np.max(roots.real, initial=0.0) > STILL)


class Likelihood:
    """A log in deviations from its operating point, and how well models explain it.

    Parameters
    ----------
    log
        What was recorded.
    knowledge
        What is known.
    longest
        Orders with the longest A and B that are tried.

    Attributes
    ----------
    operating_flow : float
        What is subtracted from the flow, t/h.
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
        If what is known does not fit to the log.
    """

    def __init__(self, log: Log, knowledge: Knowledge, longest: Orders) -> None:
        self.log, self.knowledge = log, knowledge
        self.operating_flow = _operating_flow(log.flow, knowledge)
        command = log.flow - self.operating_flow
        self.u_min, self.u_max = _limits(command, knowledge)
        self.command = np.clip(command, self.u_min, self.u_max)
        level = float(np.nanmean(log.temperature)) if len(log.temperature) else 0.0
        self.output = log.temperature - level
        self.known = [each - each[np.isfinite(each)][0] for each in log.disturbances.values()]
        self.lags = [0] * len(self.known)
        # Smaller errors than this are rounding, and no reason for higher orders.
        self.resolution = FINEST**2 * float(np.nanvar(self.output)) if len(self.output) else 0.0
        check_excitation(self.command, self.output)
        magnitudes = np.unique(np.abs(self.command[np.isfinite(self.command)]))
        self.magnitudes = magnitudes[magnitudes > 0.0]
        self._find_rows(longest)
        if len(self.rows) < LEAST_SAMPLES:
            raise CannotTellError(
                f"the log is too short: {len(self.output)} rows leave {len(self.rows)} without "
                f"a gap in the {knowledge.longest_delay} samples before them, and at least "
                f"{LEAST_SAMPLES} are needed. A shorter --longest-delay needs less; where "
                "many temperatures are missing, resample the log to longer steps"
            )

    def _find_rows(self, longest: Orders) -> None:
        reach = self.knowledge.longest_delay + longest.b
        missing = ~np.isfinite(self.output)
        filled = pd.Series(self.output).interpolate(limit_direction="both").fillna(0.0)
        self._filled = np.asarray(filled, np.float64)
        bridged = missing & ~_runs(missing, BRIDGE + 1)
        flows = _all_of_last(np.isfinite(self.command), reach)
        for known in self.known:
            flows &= _all_of_last(np.isfinite(known), reach + OF_KNOWN)
        self._usable = _all_of_last(~missing | bridged, longest.a + 1)
        self._usable[1:] &= flows[:-1]
        self._usable[: max(longest.a, reach + (OF_KNOWN if self.known else 0))] = False
        self._counted = _all_of_last(~missing, longest.a + 1)
        self.rows = Rows(_runs(self._usable, SHORTEST), self._counted)

    def first(self, samples: int) -> Likelihood:
        """Return the likelihood of the first samples."""
        part, usable = copy(self), self._usable & (np.arange(len(self.output)) < samples)
        part.rows = Rows(_runs(usable, SHORTEST), self._counted)
        return part

    def applied(self, gap: Gap) -> Array:
        """Return u_a for a dead zone within a gap."""
        applied = np.where(np.abs(self.command) <= gap.low, 0.0, self.command)
        return np.asarray(np.nan_to_num(applied))  # what is not known is in no row

    def table(self, orders: Orders, place: Place | None = None, but: int = -1) -> Array:
        """Return y(k), and its regressors: -y(k-1) ..., u_a(k-d-1) ..., disturbances, levels.

        Without a place, there are none of the flow. One disturbance may be left out.
        """
        inputs = [] if place is None else [(self.applied(place.gap), place.delay, orders.b)]
        inputs += [
            (np.nan_to_num(known), lag, OF_KNOWN)
            for i, (known, lag) in enumerate(zip(self.known, self.lags, strict=True))
            if i != but
        ]
        return np.hstack([
            self._filled[self.rows.index, np.newaxis],
            -self.rows.lagged(self._filled, range(1, orders.a + 1)),
            *(self.rows.lagged(u, range(d + 1, d + 1 + count)) for u, d, count in inputs),
            self.rows.levels(orders),
        ])  # fmt: skip

    def fit(self, place: Place, orders: Orders, start: Array | None = None) -> Fit:
        """Return the fit of maximum likelihood."""
        return self._fit(
            place, orders, *self.rows.solve(self.table(orders, place), orders, start)
        )

    def with_c(self, place: Place, orders: Orders, c: Array) -> Fit:
        """Return the fit with a given C."""
        white = self.rows.whitened(self.table(orders, place), c, orders.walk)
        counted = white[self.rows.counts]
        found, *_ = np.linalg.lstsq(counted[:, 1:], counted[:, 0], rcond=None)
        linear = found.astype(np.float64)
        return self._fit(place, orders, linear, c, white[:, 0] - white[:, 1:] @ linear)

    def _fit(self, place: Place, orders: Orders, linear: Array, c: Array, errors: Array) -> Fit:
        square = self._square(errors)
        there = place._replace(deviance=float(self.deviance(square)))
        return Fit(orders, there, linear, c, errors, square)

    def best_fit(self, place: Place, orders: Orders, start: Array) -> Fit:
        """Return the better of two fits: there may be a peak with a slow C and one without."""
        slow = np.asarray(np.poly([0.8, 0.95][: 1 + orders.walk]), float)[1 : orders.noise + 1]
        starts = [start, slow] if orders.a > 1 and orders.noise else [start]
        fits = [self.fit(place, orders, each) for each in starts]
        return min(fits, key=lambda fit: fit.place.deviance)

    def first_fits(self, tried: list[Orders]) -> list[Fit]:
        """Return fits of orders, the best first, and find the delays of known disturbances."""
        place = self.scan(replace(tried[0], c=0), np.zeros(0), self.gaps())[0]
        if self.known:
            self._place_known(place, tried[0], self.fit(place, tried[0]).c)
        fits = []
        for orders in tried:
            c = self.fit(place, orders).c
            fits.append(self.fit(self.scan(orders, c, self.gaps())[0], orders, c))
        return self.ranked(fits)

    def white(self, table: Array, c: Array, orders: Orders) -> Array:
        """Return columns whitened by C, in the rows that count."""
        return self.rows.whitened(table, c, orders.walk)[self.rows.counts]

    def _square(self, errors: Array) -> float:
        counted = errors[self.rows.counts]
        return float(counted @ counted)

    def deviance(self, squares: Array | float) -> Array:
        """Return twice the negative log likelihood, but for a constant."""
        count = len(self.rows)
        least = max(count * self.resolution, 1e-300)
        return np.asarray(count * np.log(np.maximum(squares, least)))

    def criterion(self, orders: Orders, deviance: float, *, mild: bool = False) -> float:
        """Return the Bayesian information criterion, or the milder one of Akaike.

        A coefficient of B beyond the first counts twice: it is chosen, as the delay is, from
        several places, and one before or behind the right ones gains by chance.
        """
        price = 2.0 if mild else math.log(len(self.rows))
        return deviance + (orders.count + orders.b - 1) * price

    def ranked(self, fits: Iterable[Fit], *, mild: bool = False) -> list[Fit]:
        """Return fits by their criterion, the best first."""
        return sorted(
            fits, key=lambda fit: self.criterion(fit.orders, fit.place.deviance, mild=mild)
        )

    def gaps(self) -> list[Gap]:
        """Return places of the dead zone to begin with."""
        if self.knowledge.applied:
            return [Gap(0.0, 0.0)]
        edges = np.concatenate([[0.0], self.magnitudes])
        places = np.linspace(0, len(edges) - 1, min(len(edges), COARSE)).round().astype(int)
        return [Gap(*ends) for ends in itertools.pairwise(edges[places].tolist())]

    def scan(
        self, orders: Orders, c: Array, gaps: list[Gap], delays: range | None = None
    ) -> list[Place]:
        """Return the deviance of every delay and gap with a given C, the best first."""
        delays = delays or range(self.knowledge.longest_delay + 1)
        profile = self._profile(self.table(orders), orders, c)
        found = [
            Place(delay, gap, deviance)
            for gap in gaps
            for delay, deviance in zip(
                delays, profile(self.applied(gap), delays, orders.b).tolist(), strict=True
            )
        ]
        return sorted(found, key=lambda place: place.deviance)

    def _place_known(self, place: Place, orders: Orders, c: Array) -> None:
        """Find the delay of each known disturbance, with all else as it is."""
        delays = range(self.knowledge.longest_delay + 1)
        for i, known in enumerate(self.known):
            profile = self._profile(self.table(orders, place, but=i), orders, c)
            self.lags[i] = int(np.argmin(profile(np.nan_to_num(known), delays, OF_KNOWN)))

    def _profile(
        self, table: Array, orders: Orders, c: Array
    ) -> Callable[[Array, range, int], Array]:
        """Return what gives, for every delay, the deviance with one more input.

        It takes the input, the delays and the number of its coefficients.
        """
        white = self.white(table, c, orders)
        basis, _ = np.linalg.qr(white[:, 1:])

        def left(values: Array) -> Array:
            result: Array = values - basis @ (basis.T @ values)
            return result

        target = left(white[:, 0])

        def deviances(signal: Array, delays: range, length: int) -> Array:
            lagged = self.rows.lagged(signal, range(delays[0] + 1, delays[-1] + 1 + length))
            inputs = left(self.white(lagged, c, orders))
            gram, moments = inputs.T @ inputs, inputs.T @ target
            ridge = 1e-10 * max(float(np.trace(gram)) / len(gram), 1e-300)
            places = np.arange(len(delays))[:, np.newaxis] + np.arange(length)
            blocks = gram[places[:, :, np.newaxis], places[:, np.newaxis, :]]
            shares = sliding_window_view(moments, length)
            solved = np.linalg.solve(blocks + ridge * np.eye(length), shares[:, :, np.newaxis])
            return self.deviance(
                float(target @ target) - np.sum(shares * solved[:, :, 0], axis=1)
            )

        return deviances

    def covariance(self, fit: Fit) -> Array:
        """Return the covariance of the linear coefficients and C."""
        table = self.table(fit.orders, fit.place)
        return self.rows.covariance(table, fit.linear, fit.c, fit.square, fit.orders.walk)

    def models(self, fit: Fit) -> list[LinearModel]:
        """Return what the flow does by (28), and what each known disturbance does."""
        a, b, count = fit.orders.a, fit.orders.b, OF_KNOWN * len(self.known)
        of_known = fit.linear[a + b : a + b + count].reshape(-1, OF_KNOWN)
        return [
            LinearModel(
                [1.0, *fit.linear[:a].tolist()], each.tolist(),
                delay=delay, sampling_interval=self.log.sampling_interval,
            )
            for each, delay in zip(
                [fit.linear[a : a + b], *of_known], [fit.place.delay, *self.lags], strict=True
            )
        ]  # fmt: skip

    def errors(self, fit: Fit, *, bridged: bool = True) -> Array:
        """Return the prediction errors, one a row of the log, NaN where there is none."""
        result, kept = np.full(len(self.output), np.nan), self.rows.counts | bridged
        result[self.rows.index[kept]] = fit.errors[kept]
        return result

    def simulated(self, fit: Fit) -> Array:
        """Return what flow and known disturbances do to the temperature, degC."""
        flow = np.where(np.isfinite(self.command), self.applied(fit.place.gap), np.nan)
        parts = [
            from_rest(model, held(each))
            for model, each in zip(self.models(fit), [flow, *self.known], strict=True)
        ]
        return np.asarray(np.sum(parts, axis=0))

    def gained(self, best: Fit) -> float:
        """Return what the flow adds to twice the log likelihood."""
        *_, errors = self.rows.solve(self.table(best.orders), best.orders, best.c)
        return float(self.deviance(self._square(errors))) - best.place.deviance


def _operating_flow(flow: Array, knowledge: Knowledge) -> float:
    known = flow[np.isfinite(flow)]
    if knowledge.operating_flow is not None:
        low, high = known.min(initial=np.inf), known.max(initial=-np.inf)
        if not 11.0 * low - 10.0 * high <= knowledge.operating_flow <= 11.0 * high - 10.0 * low:
            raise ValueError(
                f"operating_flow must be near the flows of the log, {low:g} to {high:g} t/h, "
                f"got {knowledge.operating_flow:g}"
            )
        return knowledge.operating_flow
    if not len(known) or known.min() < 0.0 < known.max():
        return 0.0
    return float(known[0])


def _limits(command: Array, knowledge: Knowledge) -> tuple[float, float]:
    known = command[np.isfinite(command)]
    low = float(known.min(initial=0.0)) if knowledge.u_min is None else knowledge.u_min
    high = float(known.max(initial=0.0)) if knowledge.u_max is None else knowledge.u_max
    if not low < high and len(known) and np.ptp(known):
        raise ValueError(f"u_min must be below u_max, got {low:g} and {high:g}")
    return low, high


def _all_of_last(flags: Flags, count: int) -> Flags:
    """Return where the last `count` flags, its own included, are all true."""
    return np.asarray(pd.Series(flags).rolling(count, min_periods=1).min(), np.bool_)


def _runs(flags: Flags, least: int) -> Flags:
    """Return where flags are true in runs of at least this length."""
    return np.asarray(ndimage.binary_opening(flags, np.ones(least)))
