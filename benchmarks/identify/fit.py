"""Fits (28) and the dead zone of (29) to a log, with intervals."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, optimize, stats

from benchmarks.identify.armax import Array, Orders, Rows, Solution
from benchmarks.identify.log import Log

CONFIDENCE = 0.95
THRESHOLD = float(stats.chi2.ppf(CONFIDENCE, 1))  # of twice a difference of log likelihoods
FIRST_ORDERS = Orders(2, 1, 2)  # to look for the delay with, before the orders are known
ALL_ORDERS = tuple(Orders(a, b, c) for a in (1, 2, 3) for b in (1, 2, 3) for c in (0, 1, 2, 3))
WORTH_A_FIT = 16.0  # candidates that the search leaves this far behind get no fit of their own
MOST_FITS = 60
MAGNITUDES = 40  # most dead zones that are tried at once
LEAST_SAMPLES = 100  # beside those that the longest delay takes
FINEST = 1e-6  # of the temperature's deviation, what its numbers tell
WEAK = 100.0  # twice the log likelihood, below which a log may be the wrong way round
CHANCE = 0.01  # that a flow without effect is taken for one with effect
FOLLOWS = 0.98  # share of the flow's moves that, explained by the temperature, is feedback


class CannotTellError(ValueError):
    """The log does not hold what is asked of it; the message says why."""


@dataclass(frozen=True)
class Options:
    """What is known beforehand, and what to look for.

    Attributes
    ----------
    longest_delay
        d up to which to look, samples.
    orders
        Of A, B and C; None to choose them by the Bayesian information criterion.
    find_dead_zone
        Whether the flow is the command, so that a dead zone may lie between it and the plant.
    u_min, u_max
        Limits of the flow as a deviation, t/h; None for the extremes of the log.
    operating_flow
        The flow of the operating point, t/h; None for the log's own: 0 if it has flows of both
        signs, otherwise the first.
    """

    longest_delay: int = 60
    orders: Orders | None = None
    find_dead_zone: bool = True
    u_min: float | None = None
    u_max: float | None = None
    operating_flow: float | None = None


@dataclass(frozen=True)
class Interval:
    """An estimate with its 95 % confidence interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Model:
    """A plant that a log has shown. Deviations from the operating point, as in (28) and (29).

    Attributes
    ----------
    a, b, c
        The polynomials of (28), with their leading 1.
    estimates
        With their intervals: `delay` (samples), `dead_zone` (t/h), `gain` (degC per t/h),
        `time_constant` (s, of the slowest pole), `noise_variance` (degC^2), and the
        coefficients `a1`, `b1`, `c1` and so on.
    u_min, u_max
        Limits of the flow, t/h.
    operating_flow, operating_temperature
        t/h and degC: where u and y are 0.
    orders
        Of A, B and C.
    criteria
        The criterion of each choice of orders that was tried, the lower the better.
    errors
        The prediction errors xi, one a row of the log, NaN where they are not known, degC.
    covariance
        Of the coefficients of A, B and C, in this order, without the leading 1s.
    profile
        Twice the log likelihood that each delay falls short of the best one.
    notes
        What the user should know about the fit.
    """

    a: tuple[float, ...]
    b: tuple[float, ...]
    c: tuple[float, ...]
    estimates: dict[str, Interval]
    u_min: float
    u_max: float
    operating_flow: float
    operating_temperature: float
    orders: Orders
    sampling_interval: float
    criteria: dict[Orders, float]
    errors: Array
    covariance: Array
    profile: dict[int, float]
    notes: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class _Gap:
    """Two neighbours among the magnitudes of the commands, with the dead zone between them."""

    low: float
    high: float

    @property
    def width(self) -> float:
        return self.high - self.low


@dataclass(frozen=True)
class _Candidate:
    """A delay and a place of the dead zone, with what the log says to them."""

    delay: int
    gap: _Gap
    solution: Solution
    deviance: float  # twice the negative log likelihood, but for a constant


def identify(log: Log, options: Options | None = None) -> Model:
    """Fit (28), and the dead zone of (29), to a log.

    The delay and the dead zone are searched: every delay, and every gap between two neighbours
    among the magnitudes of the commands, since the likelihood is the same all over a gap.
    For each pair that is any good, A, B and C are those of maximum likelihood.

    The delay is then the one with most of the posterior within one sample, with no preference
    beforehand, and the dead zone is the median of its posterior. Their intervals hold 95 % of
    it; that of the dead zone takes gaps as a whole. The intervals of gain and time constant are
    where the likelihood, at its maximum over all else, is within what chance would explain.

    Parameters
    ----------
    log
        What was recorded.
    options
        What is known.

    Raises
    ------
    CannotTellError
        If the log cannot tell; the message says why.
    ValueError
        If the options do not fit to the log.
    """
    return _Search(log, options or Options()).model()


def _gained_when_swapped(log: Log, options: Options) -> float:
    """Return what the temperature adds to the likelihood of the flow."""
    swapped = Log(log.temperature, log.flow, log.sampling_interval)
    plain = Options(longest_delay=options.longest_delay)
    try:
        search = _Search(swapped, plain)
    except ValueError:
        return 0.0
    _, delay, gap = search.scan(FIRST_ORDERS, np.zeros(0), search.gaps())[0]
    return search.gained(search.fit(delay, gap, FIRST_ORDERS), FIRST_ORDERS)


class _Search:
    """The data of a log, and the steps of the search."""

    def __init__(self, log: Log, options: Options) -> None:
        self.log, self.options = log, options
        self.notes: list[str] = []
        self.interval = log.sampling_interval
        self.operating_flow = _operating_flow(log.flow, options)
        command = log.flow - self.operating_flow
        self.u_min, self.u_max = _limits(command, options)
        self.command = np.clip(command, self.u_min, self.u_max)
        self.level = float(np.nanmean(log.temperature)) if len(log.temperature) else 0.0
        self.output = log.temperature - self.level
        # Smaller errors than this are rounding, and no reason for higher orders.
        self.resolution = FINEST**2 * float(np.nanvar(self.output)) if len(self.output) else 0.0
        check_excitation(self.command, self.output, options)
        magnitudes = np.unique(np.abs(self.command[np.isfinite(self.command)]))
        self.magnitudes = magnitudes[magnitudes > 0.0]
        most = max(orders.b for orders in self._orders())
        self.most_b = most
        self.longest_delay = self.options.longest_delay
        self.rows = self._rows()
        if len(self.rows) < LEAST_SAMPLES:
            raise CannotTellError(
                f"the log is too short: {len(self.output)} rows leave {len(self.rows)} without "
                f"a gap in the {options.longest_delay} samples before them, and at least "
                f"{LEAST_SAMPLES} are needed. A shorter --longest-delay needs less"
            )

    def _orders(self) -> tuple[Orders, ...]:
        return (self.options.orders,) if self.options.orders else ALL_ORDERS

    def _rows(self) -> Rows:
        """Return the rows that have all that (28) takes, for every delay that is tried."""
        order_a = max(orders.a for orders in self._orders())
        reach = self.longest_delay + self.most_b
        flow, temperature = np.isfinite(self.command), np.isfinite(self.output)
        known = _all_of_last(temperature, order_a + 1)
        flows = _all_of_last(flow, reach)
        known[1:] &= flows[:-1]
        known[: max(order_a, reach)] = False
        return Rows(known)

    # Regressors ---------------------------------------------------------------------------

    def applied(self, gap: _Gap) -> Array:
        """Return u_a for a dead zone within a gap."""
        inside = np.abs(self.command) <= gap.low
        result: Array = np.where(inside, 0.0, self.command)
        return np.where(np.isfinite(self.command), result, 0.0)  # of rows that are not used

    def regressors(self, delay: int, gap: _Gap, orders: Orders) -> tuple[Array, Array]:
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
        self, delay: int, gap: _Gap, orders: Orders, start: Array | None = None
    ) -> _Candidate:
        """Return the fit of maximum likelihood."""
        target, columns = self.regressors(delay, gap, orders)
        solution = self.rows.solve(target, columns, orders.c, start)
        return _Candidate(delay, gap, solution, self.deviance(solution.square))

    def deviance(self, square: float) -> float:
        """Return twice the negative log likelihood, but for a constant."""
        count = len(self.rows)
        return count * math.log(max(square, count * self.resolution))

    # The search ---------------------------------------------------------------------------

    def gaps(self, around: _Gap | None = None) -> list[_Gap]:
        """Return the places of the dead zone to try: all, or in detail around one of them."""
        m = self.magnitudes
        if not self.options.find_dead_zone:
            return [_Gap(0.0, 0.0)]
        edges = np.concatenate([[0.0], m])
        if around is not None:
            width = around.width
            low, high = around.low - width, around.high + width
            edges = edges[(edges >= low) & (edges <= high)]
        if len(edges) > MAGNITUDES:
            places = np.linspace(0, len(edges) - 1, MAGNITUDES).round().astype(int)
            edges = edges[places]
        return [_Gap(low, high) for low, high in itertools.pairwise(edges.tolist())]

    def scan(self, orders: Orders, c: Array, gaps: list[_Gap]) -> list[tuple[float, int, _Gap]]:
        """Return the deviance of every delay and gap with a given C, the best first."""
        rows, count = self.rows, self.longest_delay + 1
        target, columns = self.regressors(0, _Gap(0.0, 0.0), Orders(orders.a, 0, orders.c))
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

    def choose_orders(
        self, best: list[tuple[float, int, _Gap]], c: Array
    ) -> dict[Orders, float]:
        """Return the Bayesian information criterion of all orders, the best first.

        A coefficient of B beyond the first counts twice: it is chosen, as the delay is, from
        several places, and one before or behind the right ones gains by chance.
        """
        places = {(delay, gap) for _, delay, gap in best[:3]}
        criteria = {}
        for orders in self._orders():
            # More coefficients of B can stand for a longer delay.
            tried = places | {
                (delay - 1, gap) for delay, gap in places if delay and orders.b > 1
            }
            least = min(self.fit(delay, gap, orders, c).deviance for delay, gap in tried)
            criteria[orders] = least + (orders.count + orders.b - 1) * math.log(len(self.rows))
        return dict(sorted(criteria.items(), key=lambda entry: entry[1]))

    def model(self) -> Model:
        """Return what the log shows."""
        first = self.options.orders or FIRST_ORDERS
        start = self.scan(first, np.zeros(0), self.gaps())
        _, delay, gap = start[0]
        c = self.fit(delay, gap, first).solution.c
        best = self.scan(first, c, self.gaps())
        criteria = self.choose_orders(best, c)
        orders = next(iter(criteria))
        c = self.fit(*best[0][1:], orders, c).solution.c
        gaps = self.gaps()
        best = self.scan(orders, c, gaps)
        if len(self.magnitudes) > MAGNITUDES and self.options.find_dead_zone:
            gaps = self.gaps(around=best[0][2])
            best = self.scan(orders, c, gaps)
        # Without the longest delays, rows at the beginning and after gaps are known, too.
        self.longest_delay = max(delay for _, delay, _ in _near(best))
        self.rows = self._rows()
        fits = [
            self.fit(delay, gap, orders, c)
            for _, delay, gap in _near(self.scan(orders, c, gaps))
        ]
        fits.sort(key=lambda fit: fit.deviance)
        self._check_answer(fits[0], orders)
        return self._summarise(fits, orders, criteria)

    def gained(self, best: _Candidate, orders: Orders) -> float:
        """Return what the flow adds to twice the log likelihood."""
        target, columns = self.regressors(best.delay, best.gap, orders)
        without = np.delete(columns, np.s_[orders.a : orders.a + orders.b], axis=1)
        none = self.rows.solve(target, without, orders.c, best.solution.c)
        return self.deviance(none.square) - best.deviance

    def _check_answer(self, best: _Candidate, orders: Orders) -> None:
        """Refuse a log in which the flow does nothing that can be told from noise."""
        gained = self.gained(best, orders)
        if gained < WEAK and _gained_when_swapped(self.log, self.options) > WEAK:
            raise CannotTellError(
                "the direction is unusual: the flow answers the temperature rather than the "
                "temperature the flow. The two columns seem to be swapped; name them with "
                "--flow and --temperature"
            )
        # As many delays and dead zones have been tried, the best of them gains by chance.
        tried = (self.options.longest_delay + 1) * len(self.gaps())
        least = float(stats.chi2.isf(CHANCE / tried, orders.b))
        if gained < least:
            raise CannotTellError(
                "the temperature does not answer the flow in this log: a model without the "
                f"flow explains it as well (twice the log likelihood differs by {gained:.1f}, "
                f"and {least:.1f} are asked for). Move the flow further or longer, or look for "
                "a longer delay with --longest-delay"
            )

    # What is made of it -------------------------------------------------------------------

    def _summarise(
        self, fits: list[_Candidate], orders: Orders, criteria: dict[Orders, float]
    ) -> Model:
        least = fits[0].deviance
        weights = np.array([math.exp((least - fit.deviance) / 2.0) for fit in fits])
        if self.options.find_dead_zone:
            weights *= [fit.gap.width for fit in fits]
        weights /= weights.sum()
        delay = _of_delay(fits, weights)
        dead_zone = _of_dead_zone(fits, weights)
        chosen = max(
            (fit for fit in fits if fit.delay == delay.value),
            key=lambda fit: (
                fit.gap.low <= dead_zone.value <= fit.gap.high,
                -fit.deviance,
            ),
        )
        a, b, c, constant = _polynomials(chosen.solution, orders)
        self._check_stable(a)
        within = [fit for fit in fits if fit.deviance - least < THRESHOLD]
        covariance = self._covariance(chosen, orders)
        estimates = {
            "delay": delay,
            "dead_zone": dead_zone,
            "gain": self._profile(within, chosen, least, orders, _gain, self._with_gain),
            "time_constant": self._time_constant(within, chosen, least, orders),
            "noise_variance": self._variance(chosen.solution, orders),
            **_coefficients(chosen.solution, orders, covariance),
        }
        errors = np.full(len(self.output), np.nan)
        errors[self.rows.index] = chosen.solution.errors
        profile: dict[int, float] = {}
        for fit in fits:
            short = fit.deviance - least
            profile[fit.delay] = min(short, profile.get(fit.delay, math.inf))
        self._note(chosen, estimates)
        return Model(
            a=a, b=b, c=c,
            estimates=estimates,
            u_min=self.u_min, u_max=self.u_max,
            operating_flow=self.operating_flow,
            operating_temperature=self.level + constant / sum(a),
            orders=orders,
            sampling_interval=self.interval,
            criteria=criteria,
            errors=errors,
            covariance=covariance,
            profile=dict(sorted(profile.items())),
            notes=self.notes,
        )  # fmt: skip

    def _check_stable(self, a: tuple[float, ...]) -> None:
        largest = float(np.max(np.abs(np.roots(a)), initial=0.0))
        if largest >= 1.0 - 1e-4:
            raise CannotTellError(
                "the log does not show where the temperature settles: the best model has a "
                f"pole at {largest:.4f}, and one below 1 is asked for. Hold the flow longer, "
                "and see whether the temperature drifts"
            )

    def _note(self, chosen: _Candidate, estimates: dict[str, Interval]) -> None:
        if estimates["gain"].value > 0:
            self.notes.append(
                "The direction is unusual for a boiler: the temperature rises with the flow. "
                "If it should not, see whether the columns are swapped."
            )
        if chosen.delay >= self.options.longest_delay - 1:
            self.notes.append(
                f"The delay is as long as was looked for, {self.options.longest_delay} "
                "samples: try a longer --longest-delay, or a longer sampling interval."
            )

    def _variance(self, solution: Solution, orders: Orders) -> Interval:
        freedom = len(self.rows) - orders.count
        low, high = stats.chi2.ppf([(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2], freedom)
        square = solution.square
        return Interval(square / freedom, square / float(high), square / float(low))

    def _covariance(self, chosen: _Candidate, orders: Orders) -> Array:
        """Return the covariance of the coefficients of A, B and C, without the constant."""
        _, columns = self.regressors(chosen.delay, chosen.gap, orders)
        solution = chosen.solution
        white = self.rows.whitened(columns, solution.c)
        slope = self.rows.whitened(solution.errors[:, np.newaxis], solution.c)[:, 0]
        lags = np.column_stack(
            [np.zeros((len(slope), 0))]
            + [np.concatenate([np.zeros(i), slope[:-i]]) for i in range(1, orders.c + 1)]
        )
        jacobian = np.hstack([white[:, :-1], lags, white[:, -1:]])
        information = jacobian.T @ jacobian
        variance = solution.square / (len(self.rows) - orders.count)
        return np.asarray(variance * linalg.pinvh(information))[:-1, :-1]

    # Profiles -----------------------------------------------------------------------------

    def _with_gain(
        self, gain: float, candidate: _Candidate, orders: Orders
    ) -> tuple[Array, Array]:
        """Return target and regressors that leave the steady-state gain no choice.

        The last coefficient of B is gain A(1) less the others.
        """
        target, columns = self.regressors(candidate.delay, candidate.gap, orders)
        last = columns[:, orders.a + orders.b - 1]
        reduced = np.delete(columns, orders.a + orders.b - 1, axis=1)
        reduced[:, : orders.a] += gain * last[:, np.newaxis]
        reduced[:, orders.a : orders.a + orders.b - 1] -= last[:, np.newaxis]
        return target - gain * last, reduced

    def _with_time_constant(
        self, samples: float, candidate: _Candidate, orders: Orders
    ) -> tuple[Array, Array]:
        """Return target and regressors that leave one pole no choice: the rest of A is free."""
        pole = math.exp(-1.0 / samples)
        target, columns = self.regressors(candidate.delay, candidate.gap, orders)
        lags = np.column_stack([target, -columns[:, : orders.a]])  # y(k), y(k-1), ...
        slow = lags[:, :-1] - pole * lags[:, 1:]
        return slow[:, 0], np.hstack([-slow[:, 1:], columns[:, orders.a :]])

    def _profile(
        self,
        within: list[_Candidate],
        chosen: _Candidate,
        least: float,
        orders: Orders,
        measure: Callable[[Solution, Orders], float],
        constrain: Callable[[float, _Candidate, Orders], tuple[Array, Array]],
    ) -> Interval:
        """Return where the likelihood, at its best in all else, is near its maximum."""
        value = measure(chosen.solution, orders)
        ends = [value]
        for candidate in within:
            centre = measure(candidate.solution, orders)
            shortfall = partial(self._shortfall, candidate, least, orders, constrain)
            ends += [_edge(shortfall, centre, direction) for direction in (-1.0, 1.0)]
        return Interval(value, min(ends), max(ends))

    def _shortfall(
        self,
        candidate: _Candidate,
        least: float,
        orders: Orders,
        constrain: Callable[[float, _Candidate, Orders], tuple[Array, Array]],
        value: float,
    ) -> float:
        target, columns = constrain(value, candidate, orders)
        solution = self.rows.solve(target, columns, orders.c, candidate.solution.c)
        short = max(self.deviance(solution.square) - least, 0.0)
        return math.sqrt(short) - math.sqrt(THRESHOLD)  # nearly straight, to be solved fast

    def _time_constant(
        self, within: list[_Candidate], chosen: _Candidate, least: float, orders: Orders
    ) -> Interval:
        """Return the time constant of the slowest pole, s."""
        real = [fit for fit in within if _slowest_is_real(fit.solution, orders)]
        value = _time_constant(chosen.solution, orders)
        if not real:
            return Interval(value * self.interval, math.nan, math.nan)
        found = self._profile(
            real, chosen, least, orders, _time_constant, self._with_time_constant
        )
        return Interval(*(self.interval * x for x in (found.value, found.low, found.high)))


def check_excitation(command: Array, output: Array, options: Options) -> None:
    """Refuse a log in which nothing moves, or nothing but the feedback.

    Raises
    ------
    CannotTellError
        The message says what is missing.
    """
    known = command[np.isfinite(command)]
    if len(known) < LEAST_SAMPLES:
        raise CannotTellError(
            f"the log is too short: {len(known)} rows with a flow, and at least "
            f"{LEAST_SAMPLES} are needed"
        )
    if np.ptp(known) == 0.0:
        raise CannotTellError(
            f"the flow is constant, {known[0]:g} t/h from its operating point: nothing moves "
            "that the temperature could answer"
        )
    temperatures = output[np.isfinite(output)]
    if not len(temperatures) or np.ptp(temperatures) == 0.0:
        raise CannotTellError("the temperature is constant: it answers nothing")
    share = _explained_by_feedback(command, output)
    if share > FOLLOWS:
        raise CannotTellError(
            f"the flow follows from the temperature alone ({100 * share:.1f} % of its moves): "
            "the loop is closed and nothing else moves, so that the plant cannot be told from "
            "its controller. Change the set point in steps, or move the flow by hand"
        )


def _explained_by_feedback(command: Array, output: Array) -> float:
    """Return which share of the flow's moves the temperature explains, linearly.

    It is a share of what the flow's own past leaves open.
    """
    lags = 3
    index = np.arange(lags, len(command))
    moves = command[index] - command[index - 1]
    own = [command[index - i] for i in (1, 2)] + [np.ones(len(index))]
    temperatures = [output[index - i] for i in range(lags)]
    table = np.column_stack([*own, *temperatures, moves])
    # Where a limit holds the flow, it does not follow anything.
    free = np.isfinite(table).all(axis=1)
    free &= (command[index] > np.nanmin(command)) & (command[index] < np.nanmax(command))
    table = table[free]
    if len(table) < LEAST_SAMPLES:
        return 0.0

    def left(columns: int) -> float:
        fitted, *_ = np.linalg.lstsq(table[:, :columns], table[:, -1], rcond=None)
        errors = table[:, -1] - table[:, :columns] @ fitted
        return float(errors @ errors)

    alone, total = left(len(own)), float(table[:, -1] @ table[:, -1])
    if alone <= 1e-9 * total:  # it goes on as it has gone, whatever the temperature does
        return 0.0
    return 1.0 - left(table.shape[1] - 1) / alone


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


def _near(found: list[tuple[float, int, _Gap]]) -> list[tuple[float, int, _Gap]]:
    """Return what is worth a fit of its own, out of what is sorted by its deviance."""
    return [entry for entry in found if entry[0] < found[0][0] + WORTH_A_FIT][:MOST_FITS]


def _polynomials(
    solution: Solution, orders: Orders
) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...], float]:
    linear = solution.linear.tolist()
    a = (1.0, *linear[: orders.a])
    b = tuple(linear[orders.a : orders.a + orders.b])
    return a, b, (1.0, *solution.c.tolist()), linear[-1]


def _coefficients(solution: Solution, orders: Orders, covariance: Array) -> dict[str, Interval]:
    """Return the intervals of A, B and C, from the curvature of the likelihood."""
    values = np.concatenate([solution.linear[:-1], solution.c])
    spreads = stats.norm.ppf((1 + CONFIDENCE) / 2) * np.sqrt(np.diag(covariance))
    names = [
        f"{letter}{i}"
        for letter, count in (("a", orders.a), ("b", orders.b), ("c", orders.c))
        for i in range(1, count + 1)
    ]
    return {
        name: Interval(float(value), float(value - spread), float(value + spread))
        for name, value, spread in zip(names, values, spreads, strict=True)
    }


def _gain(solution: Solution, orders: Orders) -> float:
    a, b, *_ = _polynomials(solution, orders)
    return sum(b) / sum(a)


def _slowest(solution: Solution, orders: Orders) -> complex:
    """Return the pole that a step response ends with: the largest real one above 0, if any.

    Poles below 0, whose responses change sign at every sample, tell how the noise is made.
    """
    poles = np.roots(_polynomials(solution, orders)[0])
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


def _of_delay(fits: list[_Candidate], weights: Array) -> Interval:
    """Return the delay that has most of the posterior within one sample, and its interval."""
    delays = np.array([fit.delay for fit in fits])
    tried = np.unique(delays)
    shares = np.array([weights[delays == delay].sum() for delay in tried])
    near = np.abs(tried[:, np.newaxis] - tried) <= 1
    # Of equal ones, the delay that is itself the likelier.
    value = tried[np.lexsort((shares, (near @ shares).round(6)))[-1]]
    sums = np.cumsum(shares)
    low, high = (
        float(tried[min(int(np.searchsorted(sums, share)), len(tried) - 1)])
        for share in ((1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2)
    )
    return Interval(float(value), min(low, float(value)), max(high, float(value)))


def _of_dead_zone(fits: list[_Candidate], weights: Array) -> Interval:
    """Return the dead zone: its posterior is spread evenly within each gap."""
    shares: dict[_Gap, float] = {}
    for fit, weight in zip(fits, weights, strict=True):
        shares[fit.gap] = shares.get(fit.gap, 0.0) + float(weight)
    gaps = sorted(shares, key=lambda gap: gap.low)

    def at(probability: float) -> tuple[_Gap, float]:
        below = 0.0
        for gap in gaps:
            if below + shares[gap] >= probability:
                inside = gap.width * (probability - below) / shares[gap]
                return gap, gap.low + inside
            below += shares[gap]
        return gaps[-1], gaps[-1].high

    # The likelihood is the same all over a gap: the interval takes gaps as a whole.
    low = at((1 - CONFIDENCE) / 2)[0].low
    high = at((1 + CONFIDENCE) / 2)[0].high
    if gaps[0].low == 0.0 and shares[gaps[0]] > 0.5:
        return Interval(0.0, 0.0, high)  # every command has had an effect
    return Interval(at(0.5)[1], low, high)
