"""Compute the likelihood of a log given a delay, a dead zone and orders of A, B and C."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy import ndimage

from agents.actuator import applied_flow
from benchmarks.identify.__main__ import Knowledge
from benchmarks.identify.armax import Array, Flags, Orders, Rows
from benchmarks.identify.log import LEAST_SAMPLES, Log
from benchmarks.identify.model import CannotTellError
from benchmarks.identify.simulation import from_rest, held
from benchmarks.loop.linear import LinearModel

LONGEST = Orders(3, 12, 3)  # orders that are tried
OF_KNOWN = 4  # coefficients of B for a known disturbance


class Gap(NamedTuple):
    """Two magnitudes of commands, t/h, between which the dead zone may end."""

    low: float
    high: float


class Place(NamedTuple):
    """A delay and a gap in which the dead zone ends, with the deviance there.

    The deviance is twice the negative log likelihood, up to a constant.
    """

    delay: int
    gap: Gap
    deviance: float = math.nan


@dataclass(frozen=True, eq=False)
class Fit:
    """A fit of some orders at a place."""

    orders: Orders
    place: Place
    linear: Array
    """Coefficients of the regressors."""
    c: Array
    """C, or C' with a walk, from z^-1 on."""
    errors: Array
    """Prediction errors xi, one for each predicted row."""
    square: float
    """Sum of their squares over the counted rows."""

    @property
    def walks_nowhere(self) -> bool:
        """Whether the variance of the random walk is (nearly) 0: a root of C' cancels it."""
        roots = np.roots([1.0, *self.c])
        return self.orders.walk and bool(np.max(roots.real, initial=0.0) > 0.99)


class Likelihood:
    """The likelihood of a log, in deviations from its operating point.

    Raises
    ------
    CannotTellError
        If the log is too short, or does not excite the plant.
    ValueError
        If the knowledge does not fit the log.
    """

    def __init__(self, log: Log, knowledge: Knowledge) -> None:
        self.log, self.knowledge = log, knowledge
        self.operating_flow = _operating_flow(log.flow, knowledge)
        command = log.flow - self.operating_flow
        self.u_min, self.u_max = _limits(command, knowledge)
        # u(k), y(k) and the known disturbances, as deviations; NaN where unknown.
        self.command = np.clip(command, self.u_min, self.u_max)
        _check_excitation(self.command, log.temperature)
        self.output = log.temperature - float(np.nanmean(log.temperature))
        self.known = [each - each[np.isfinite(each)][0] for each in log.disturbances.values()]
        self.lags = [0] * len(self.known)  # samples
        self.delays = range(knowledge.longest_delay + 1)
        # A smaller mean square of the errors is rounding, and no reason for higher orders.
        self.resolution = 1e-12 * float(np.nanvar(self.output))
        magnitudes = np.unique(np.abs(self.command[np.isfinite(self.command)]))
        self.magnitudes = magnitudes[magnitudes > 0.0]
        self._find_rows()
        if len(self.rows) < LEAST_SAMPLES:
            raise CannotTellError(
                f"the log is too short: {len(self.output)} rows leave {len(self.rows)} without "
                f"a gap in the {knowledge.longest_delay} samples before them, and at least "
                f"{LEAST_SAMPLES} are needed. A shorter --longest-delay needs less; where "
                "many temperatures are missing, resample the log to longer steps"
            )

    def _find_rows(self) -> None:
        """Find the rows in which every term of (28) is known, for all delays and orders."""
        reach = self.knowledge.longest_delay + LONGEST.b
        missing = ~np.isfinite(self.output)
        filled = pd.Series(self.output).interpolate(limit_direction="both")
        self._filled = np.asarray(filled, np.float64)
        bridged = missing & ~_runs(missing, 11)  # a short gap is filled in, for xi to go on
        self._usable = _all_of_last(~missing | bridged, LONGEST.a + 1)
        for each, lags in [(self.command, reach), *((d, reach + OF_KNOWN) for d in self.known)]:
            self._usable[1:] &= _all_of_last(np.isfinite(each), lags)[:-1]
            self._usable[:lags] = False
        self._usable[: LONGEST.a] = False
        self._counted = _all_of_last(~missing, LONGEST.a + 1)
        self.rows = self._rows(self._usable)

    def _rows(self, usable: Flags) -> Rows:
        """Return rows in stretches of at least 30: in shorter ones xi does not settle."""
        return Rows(_runs(usable, 30), self._counted)

    def smooth(self, output: Array) -> None:
        """Put a simulated output in the place of the temperature."""
        self._filled = output

    @cached_property
    def last(self) -> Flags:
        """Where models are judged that were fitted before: from two thirds of the log on.

        If less than a ninth of the moves is there, it is from two thirds of the moves on; and
        it ends four longest delays after the last move, when the response has been seen.
        """
        rows, flow = self.rows.index, held(self.command)
        moves = np.abs(np.diff(flow, prepend=flow[:1]))
        shares = np.cumsum(moves[rows]) / max(float(moves[rows].sum()), 1e-300)
        place = 2 * len(rows) // 3
        if shares[place] > 8 / 9:
            place = max(int(np.searchsorted(shares, 2.0 / 3.0)), LEAST_SAMPLES)
        end = np.flatnonzero(moves)[-1] + 4 * len(self.delays)
        samples = np.arange(len(flow))
        return np.asarray((samples >= rows[min(place, len(rows) - 1)]) & (samples <= end))

    def first(self) -> Likelihood:
        """Return the likelihood of what is before the last part alone."""
        samples = np.arange(len(self.output))
        part, usable = copy(self), self._usable & (samples < np.argmax(self.last))
        part.rows = self._rows(usable)
        return part

    def applied(self, gap: Gap) -> Array:
        """Return u_a for a dead zone that ends within a gap."""
        return dead_within(gap, self.command, self.u_min, self.u_max)

    def table(self, orders: Orders, place: Place | None = None, but: int = -1) -> Array:
        """Return y(k) and its regressors: -y(k-1) ..., u_a(k-d-1) ..., disturbances, levels.

        Without a place, the flow is left out. `but` is the index of a disturbance to leave out.
        """
        inputs = [] if place is None else [(self.applied(place.gap), place.delay, orders.b)]
        inputs += [
            (known, lag, OF_KNOWN)
            for i, (known, lag) in enumerate(zip(self.known, self.lags, strict=True))
            if i != but
        ]
        return np.hstack([
            self.rows.lagged(self._filled, [0]),
            -self.rows.lagged(self._filled, range(1, orders.a + 1)),
            *(self.rows.lagged(u, range(d + 1, d + 1 + count)) for u, d, count in inputs),
            self.rows.levels(orders),
        ])  # fmt: skip

    def white(self, table: Array, c: Array, orders: Orders) -> Array:
        """Return the columns whitened by C, in the counted rows."""
        return self.rows.whitened(table, c, orders.walk)[self.rows.counts]

    def fit(self, place: Place, orders: Orders, start: Array | None = None) -> Fit:
        """Return the maximum-likelihood fit."""
        table = self.table(orders, place)
        return self._fit(place, orders, *self.rows.solve(table, orders, start))

    def with_c(self, place: Place, orders: Orders, c: Array) -> Fit:
        """Return the fit with a given C."""
        white = self.rows.whitened(self.table(orders, place), c, orders.walk)
        counted = white[self.rows.counts]
        found, *_ = np.linalg.lstsq(counted[:, 1:], counted[:, 0], rcond=None)
        linear = found.astype(np.float64)
        return self._fit(place, orders, linear, c, white[:, 0] - white[:, 1:] @ linear)

    def _fit(self, place: Place, orders: Orders, linear: Array, c: Array, errors: Array) -> Fit:
        square = self.rows.square(errors)
        there = place._replace(deviance=float(self.deviance(square)))
        return Fit(orders, there, linear, c, errors, square)

    def best_fit(self, place: Place, orders: Orders, start: Array) -> Fit:
        """Return the better of two fits: the likelihood may peak with a slow C and without."""
        slow = np.asarray(np.poly([0.8, 0.95][: 1 + orders.walk]), float)[1 : orders.noise + 1]
        starts = [start, slow] if orders.a > 1 and orders.noise else [start]
        fits = [self.fit(place, orders, each) for each in starts]
        return min(fits, key=lambda fit: fit.place.deviance)

    def first_fits(self, tried: list[Orders]) -> list[Fit]:
        """Find the delays of the known disturbances, and return fits of orders, best first."""
        place = self.scan(replace(tried[0], c=0), np.zeros(0), self.gaps())[0]
        if self.known:
            c, orders = self.fit(place, tried[0]).c, replace(tried[0], b=OF_KNOWN)
            for i, known in enumerate(self.known):
                table = self.table(tried[0], place, but=i)
                [deviances] = self._profile(table, orders, c, [known], self.delays)
                self.lags[i] = int(np.argmin(deviances))
        fits = []
        for orders in tried:
            c = self.fit(place, orders).c
            fits.append(self.fit(self.scan(orders, c, self.gaps())[0], orders, c))
        return self.ranked(fits)

    def deviance(self, squares: Array | float) -> Array:
        """Return twice the negative log likelihood, up to a constant."""
        count = len(self.rows)
        least = max(count * self.resolution, 1e-300)
        return np.asarray(count * np.log(np.maximum(squares, least)))

    def criterion(self, orders: Orders, deviance: float, *, mild: bool = False) -> float:
        """Return the Bayesian information criterion, or the milder one of Akaike.

        A coefficient of B beyond the first counts twice: like the delay, its place is chosen
        among several, and one before or after the right ones gains by chance.
        """
        price = 2.0 if mild else math.log(len(self.rows))
        return deviance + (orders.count + orders.b - 1) * price

    def ranked(self, fits: Iterable[Fit], *, mild: bool = False) -> list[Fit]:
        """Return fits sorted by their criterion, the best first."""
        return sorted(
            fits, key=lambda fit: self.criterion(fit.orders, fit.place.deviance, mild=mild)
        )

    def gaps(self, within: Gap | None = None) -> list[Gap]:
        """Return up to 39 gaps between commands, or between those within a gap."""
        if self.knowledge.applied:
            return [Gap(0.0, 0.0)]
        edges = np.concatenate([[0.0], self.magnitudes])
        if within:
            edges = edges[(edges >= within.low) & (edges <= within.high)]
        places = np.linspace(0, len(edges) - 1, min(len(edges), 40)).round().astype(int)
        return [Gap(*ends) for ends in itertools.pairwise(edges[places].tolist())]

    def scan(
        self, orders: Orders, c: Array, gaps: list[Gap], delays: range | None = None
    ) -> list[Place]:
        """Return every delay and gap with its deviance for a given C, the best first."""
        delays = delays or self.delays
        applied = [self.applied(gap) for gap in gaps]
        found = self._profile(self.table(orders), orders, c, applied, delays)
        return sorted(
            (
                Place(delay, gap, deviance)
                for gap, deviances in zip(gaps, found, strict=True)
                for delay, deviance in zip(delays, deviances.tolist(), strict=True)
            ),
            key=lambda place: place.deviance,
        )

    def of_flows(self, flows: list[Array], fit: Fit) -> float:
        """Return the least deviance with flows in place of the command, near a fit's delay."""
        delays = self.delays[max(fit.place.delay - 8, 0) : fit.place.delay + 9]
        table = self.table(fit.orders)
        found = self._profile(table, fit.orders, fit.c, flows, delays)
        return min(float(np.min(deviances)) for deviances in found)

    def _profile(
        self, table: Array, orders: Orders, c: Array, inputs: list[Array], delays: range
    ) -> Iterator[Array]:
        """Yield, for each input added with B's length, the deviances of all delays."""
        white = self.white(table, c, orders)
        basis, _ = np.linalg.qr(white[:, 1:])

        def left(values: Array) -> Array:
            result: Array = values - basis @ (basis.T @ values)
            return result

        target = left(white[:, 0])
        length = orders.b
        places = np.arange(len(delays))[:, np.newaxis] + np.arange(length)
        for each in inputs:
            lagged = self.rows.lagged(each, range(delays[0] + 1, delays[-1] + 1 + length))
            columns = left(self.white(lagged, c, orders))
            gram, moments = columns.T @ columns, columns.T @ target
            ridge = 1e-10 * max(float(np.trace(gram)) / len(gram), 1e-300)
            blocks = gram[places[:, :, np.newaxis], places[:, np.newaxis, :]]
            shares = moments[places]
            solved = np.linalg.solve(blocks + ridge * np.eye(length), shares[:, :, np.newaxis])
            yield self.deviance(
                float(target @ target) - np.sum(shares * solved[:, :, 0], axis=1)
            )

    def models(self, fit: Fit) -> list[LinearModel]:
        """Return the models of the responses to the flow and to each known disturbance."""
        poles, rest = np.split(fit.linear, [fit.orders.a])
        lengths = [fit.orders.b, *[OF_KNOWN] * len(self.known)]
        parts, delays = np.split(rest, np.cumsum(lengths))[:-1], [fit.place.delay, *self.lags]
        a, interval = [1.0, *poles.tolist()], self.log.sampling_interval
        return [
            LinearModel(a, b.tolist(), delay=delay, sampling_interval=interval)
            for b, delay in zip(parts, delays, strict=True)
        ]

    def errors(self, fit: Fit, *, bridged: bool = True) -> Array:
        """Return the prediction errors, one per row of the log, NaN where there is none."""
        result, kept = np.full(len(self.output), np.nan), self.rows.counts | bridged
        result[self.rows.index[kept]] = fit.errors[kept]
        return result

    def simulated(self, fit: Fit) -> Array:
        """Return the simulated response of the temperature to all inputs, degC."""
        inputs = [self.applied(fit.place.gap), *self.known]
        parts = [from_rest(*each) for each in zip(self.models(fit), inputs, strict=True)]
        return np.asarray(np.sum(parts, axis=0))

    def gained(self, best: Fit) -> float:
        """Return how much the flow adds to twice the log likelihood."""
        *_, errors = self.rows.solve(self.table(best.orders), best.orders, best.c)
        return float(self.deviance(self.rows.square(errors))) - best.place.deviance


def dead_within(gap: Gap, flow: Array, low: float = -np.inf, high: float = np.inf) -> Array:
    """Return the flow past limits and a dead zone that ends within a gap, (29)."""
    return applied_flow(flow, np.nextafter(gap.low, np.inf), low, high)


def _operating_flow(flow: Array, knowledge: Knowledge) -> float:
    known = flow[np.isfinite(flow)]
    if not len(known):
        return 0.0
    low, high = float(known.min()), float(known.max())
    given = knowledge.operating_flow
    if given is not None:
        if not 2.0 * low - high <= given <= 2.0 * high - low:
            raise ValueError(
                f"operating_flow must be near the flows of the log, {low:g} to {high:g} t/h, "
                f"got {given:g}"
            )
        return given
    # 0 or the first flow, with room on both sides: a quarter of the range and more.
    for guess in (0.0, float(known[0])):
        if abs(guess - (low + high) / 2.0) <= 0.25 * (high - low):
            return guess
    return float(f"{(low + high) / 2.0:.4g}")


def _limits(command: Array, knowledge: Knowledge) -> tuple[float, float]:
    known = command[np.isfinite(command)]
    low = float(known.min(initial=0.0)) if knowledge.u_min is None else knowledge.u_min
    high = float(known.max(initial=0.0)) if knowledge.u_max is None else knowledge.u_max
    if not low < high and len(known) and np.ptp(known):
        raise ValueError(f"u_min must be below u_max, got {low:g} and {high:g}")
    return low, high


def _check_excitation(command: Array, output: Array) -> None:
    """Refuse a log in which nothing moves, or in which feedback alone moves the flow."""
    flows, temperatures = command[np.isfinite(command)], output[np.isfinite(output)]
    if len(flows) < LEAST_SAMPLES:
        raise CannotTellError(
            f"the log is too short: {len(flows)} rows with a flow, and at least "
            f"{LEAST_SAMPLES} are needed"
        )
    if np.ptp(flows) == 0.0:
        raise CannotTellError(
            f"the flow is constant, {flows[0]:g} t/h from its operating point: nothing moves "
            "that the temperature could answer. Record it while the flow is moved in steps"
        )
    if not len(temperatures) or np.ptp(temperatures) == 0.0:
        raise CannotTellError(
            "the temperature is constant: it answers nothing. See whether the sensor works, or "
            "name another column"
        )
    share = _explained_by_feedback(pd.Series(command), pd.Series(output))
    if share > 0.98:
        raise CannotTellError(
            f"the flow follows from the temperature alone ({100 * share:.1f} % of its moves): "
            "the loop is closed and nothing else moves, so that the plant cannot be told from "
            "its controller. Change the set point in steps, or move the flow by hand"
        )


def _explained_by_feedback(u: pd.Series[float], y: pd.Series[float]) -> float:
    """Return the share of the flow's moves, beyond its past, that the temperature explains."""
    past, answered = (u.shift(1), u.shift(2), u.notna()), (y, y.shift(1), y.shift(2))
    table = np.column_stack([*past, *answered, u.diff()])
    # A flow held at a limit follows nothing.
    table = table[np.isfinite(table).all(axis=1) & (u > u.min()) & (u < u.max())]
    if len(table) < LEAST_SAMPLES:
        return 0.0
    # Sums of squares of the moves: what each column adds, and last what none explains.
    squares = np.asarray(np.linalg.qr(table, mode="r"))[:, -1] ** 2
    alone = float(squares[len(past) :].sum())
    # Some flows follow from their own past, whatever the temperature does.
    return 1.0 - float(squares[-1]) / alone if alone > 1e-9 * squares.sum() else 0.0


def _all_of_last(flags: Flags, count: int) -> Flags:
    """Return where the last `count` flags, the current one included, are all true."""
    return np.asarray(pd.Series(flags).rolling(count, min_periods=1).min(), np.bool_)


def _runs(flags: Flags, least: int) -> Flags:
    """Return where flags are true in runs of at least the given length."""
    return np.asarray(ndimage.binary_opening(flags, np.ones(least)))
