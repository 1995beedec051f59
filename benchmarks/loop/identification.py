"""Fit a plant with a dead zone, a delay and one or two lags to a log, with 95 % intervals.

The model of the temperature is a sum of terms: the gain times the response to the flow behind
the dead zone, and the background. The background is a constant, the decay of the plant's state
at the first row, the responses to measured disturbances and the responses to steps of
unmeasured loads. What remains is noise C(z) / D(z) xi with white xi. The fit minimises the sum
of the squared prediction errors, which are estimates of xi (a Box-Jenkins model).
"""

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.linalg import lstsq, qr
from scipy.optimize import least_squares
from scipy.signal import lfilter

Array = NDArray[np.float64]

# A part of the model must improve the fit by this much (see `Fit.improvement`), because any
# part improves it a little by chance.
SECOND_LAG = 10.0
DEAD_ZONE = 9.0
LOAD_STEP = 25.0  # the largest, because the time of the step is chosen among hundreds
MOST_LOAD_STEPS = 4
# Standard errors are multiplied by this factor, because no plant is quite of the model's form.
# With this factor, 95 % intervals held the gain in 19 of 20 logs of simulated plants or more.
SPREAD = 1.5
GRID = 31  # values of the centre and of the half width of a dead zone that are tried
DISTURBANCE_LAGS = 0.3, 0.9, 3.0  # multiples of the plant's larger time constant
MOST_BLOCKS = 2000  # a fit to more means of rows takes longer and is not better
# The noise filter starts from zero. Until it has settled, the prediction errors are as large as
# the noise. They count little, but without them the state at the first row would be arbitrary.
SETTLING_BLOCKS = 10
SETTLING_WEIGHT = 0.1
TINY = 1e-30  # prevents divisions by zero


@dataclass(frozen=True)
class Log:
    """A recorded log with one row a sample and without missing numbers."""

    flow: Array  # commanded from the time of the row on, t/h, (rows,)
    temperature: Array  # at the time of the row, degC, (rows,)
    disturbances: Array  # measured disturbances in any unit, (rows, disturbances)
    sampling_interval: float  # s


class DeadZone(NamedTuple):
    """Flows nearer to the centre than the half width act on the plant as the centre does."""

    centre: float  # t/h
    half_width: float = 0.0  # t/h

    def passed(self, flow: Array) -> Array:
        """Return the flow behind the valve, (29), for the flow in front of it; both in t/h."""
        is_inside = np.abs(flow - self.centre) < self.half_width
        return np.where(is_inside, self.centre, flow)


def respond(flows: Array, delay: float, slow: float, fast: float = 0.0) -> Array:
    """Return the response of a delay and one or two lags in series, with gain 1.

    The response is exact for a flow that is held from row to row and was 0 before the first.

    Parameters
    ----------
    flows : array of shape (rows, ...)
        Flows.
    delay : float
        Delay in samples, which need not be an integer.
    slow, fast : float
        Time constants of the lags in samples; `fast` is below `slow`, and 0 for a single lag.
    """
    if fast > 0.0:  # partial fractions
        slow_part = slow * respond(flows, delay, slow)
        fast_part = fast * respond(flows, delay, fast)
        return np.asarray((slow_part - fast_part) / (slow - fast))
    whole = int(delay)
    decay = np.exp(-1.0 / slow)
    state = lfilter([0.0, 1.0 - decay], [1.0, -decay], flows, axis=0)
    # A row lies a part of a sample behind the time at which the delayed flow changes.
    decay_of_part = np.exp(-(1.0 - (delay - whole)) / slow)
    state_at_rows = decay_of_part * state + (1.0 - decay_of_part) * flows
    response = np.zeros_like(flows)
    response[whole + 1 :] = state_at_rows[: max(len(flows) - whole - 1, 0)]
    return response


def stable_polynomial(first: float, second: float) -> Array:
    """Return 1 + p z^-1 + q z^-2 for two reflection coefficients.

    The roots are inside the unit circle if both coefficients are between -1 and 1.
    """
    return np.array([1.0, first * (1.0 + second), second])


class Unknowns(NamedTuple):
    """The numbers that nonlinear least squares finds."""

    gain: float  # degC per t/h
    delay: float  # samples
    log_slow: float  # logarithm of the larger time constant in samples
    # Reflection coefficients of the noise model C(z) / D(z).
    first_of_c: float = 0.0
    second_of_c: float = 0.0
    first_of_d: float = 0.0
    second_of_d: float = 0.0
    ratio: float = 0.0  # smaller time constant divided by the larger one; 0 for a single lag

    @property
    def slow(self) -> float:
        """The larger time constant, samples."""
        return float(np.exp(self.log_slow))

    @property
    def fast(self) -> float:
        """The smaller time constant, samples; 0 for a single lag."""
        return self.ratio * self.slow

    def respond(self, flows: Array) -> Array:
        """Return the response of delay and lags, with gain 1, to flows of shape (rows, ...).

        The flows had the values of the first row since long before the log.
        """
        return respond(flows - flows[0], self.delay, self.slow, self.fast)


# Limits of a search; `Fit.refined` adds upper limits of delay and time constant.
LOWEST = Unknowns(-np.inf, 0.0, np.log(0.25), -0.98, -0.98, -0.999, -0.999, 0.02)
HIGHEST = Unknowns(np.inf, np.inf, np.inf, 0.98, 0.98, 0.999, 0.999, 0.97)


@dataclass(frozen=True)
class Fit:
    """A model of a log.

    The rows from `first_row` to `end_row` are divided into blocks of successive rows, and the
    model is fitted to the means of the blocks. In a short log, a block is a row.
    """

    log: Log
    zones: list[DeadZone]  # possible dead zones; the first ones have no width
    unknowns: Unknowns
    zone: DeadZone
    load_steps: tuple[int, ...] = ()  # rows at which an unmeasured load steps
    first_row: int = 0  # temperatures before it depend on flows from before the log
    end_row: int | None = None  # None: the end of the log
    standard_errors: Unknowns | None = None  # of refined unknowns

    def whiten(self, terms: Array) -> Array:
        """Return D / C times the block means of terms, (rows, ...) to (blocks, ...).

        The first blocks have a small weight, because the filter settles in them.
        """
        unknowns = self.unknowns
        c = stable_polynomial(unknowns.first_of_c, unknowns.second_of_c)
        d = stable_polynomial(unknowns.first_of_d, unknowns.second_of_d)
        used = terms[self.first_row : self.end_row]
        size = 1 + len(terms) // MOST_BLOCKS
        blocks = len(used) // size
        shape = (blocks, size, *terms.shape[1:])
        means = used[: blocks * size].reshape(shape).mean(axis=1)
        whitened = np.asarray(lfilter(d, c, means, axis=0), np.float64)
        whitened[:SETTLING_BLOCKS] *= SETTLING_WEIGHT
        return whitened

    @cached_property
    def flow_response(self) -> Array:
        """The response to the flow, degC, (rows,)."""
        return self.unknowns.gain * self.unknowns.respond(self.zone.passed(self.log.flow))

    @cached_property
    def background(self) -> Array:
        """The terms of the background without coefficients, (rows, terms); 1 comes first."""
        slow, fast = self.unknowns.slow, self.unknowns.fast
        rows = np.arange(len(self.log.flow), dtype=np.float64)
        elapsed = np.maximum(rows - self.first_row, 0.0)
        terms = [np.ones(len(rows)), np.exp(-elapsed / slow)]
        if fast > 0.0:
            terms.append(np.exp(-elapsed / fast))
        steps = [(rows >= row).astype(np.float64) for row in self.load_steps]
        terms += [respond(step, 0.0, slow) for step in steps]
        # The lags of a disturbance are unknown. The responses of three pairs of lags add up to
        # nearly any smooth response.
        changes = self.log.disturbances - self.log.disturbances[0]
        for multiple in DISTURBANCE_LAGS:
            terms += list(respond(changes, 0.0, slow, multiple * slow).T)
        return np.column_stack(terms)

    @cached_property
    def coefficients(self) -> Array:
        """The coefficients of the background by linear least squares, (terms,)."""
        terms = self.whiten(self.background)
        target = self.whiten(self.log.temperature - self.flow_response)
        sizes = np.linalg.norm(terms, axis=0) + TINY
        return np.asarray(lstsq(terms / sizes, target, cond=1e-8)[0] / sizes)

    @cached_property
    def simulated(self) -> Array:
        """The temperatures of the model without noise, degC, (rows,)."""
        return np.asarray(self.background @ self.coefficients + self.flow_response)

    @cached_property
    def errors(self) -> Array:
        """The prediction errors, degC, (blocks,)."""
        return self.whiten(self.log.temperature - self.simulated)

    @property
    def operating_temperature(self) -> float:
        """The steady temperature at the centre of the dead zone, degC.

        The loads and the measured disturbances are those of the first row.
        """
        first_flow = self.zone.passed(self.log.flow[:1])[0]
        change = self.unknowns.gain * (self.zone.centre - first_flow)
        return float(self.coefficients[0] + change)

    @property
    def squares(self) -> float:
        """The sum of the squared prediction errors, degC^2."""
        return float(self.errors @ self.errors + TINY)

    def improvement(self, squares: Array | float) -> Array:
        """Return how much better than this fit are fits with other sums of squared errors.

        The improvement is twice the logarithm of the ratio of the likelihoods. It has the shape
        of `squares`, which are in degC^2.
        """
        return np.asarray(len(self.errors) * np.log(self.squares / (squares + TINY)))

    def with_candidates(self, target: Array, candidates: Array) -> tuple[Array, Array]:
        """Fit the background and one candidate term to a target, for each of the candidates.

        Parameters
        ----------
        target : array of shape (rows,)
            What is fitted, degC.
        candidates : array of shape (rows, candidates)
            Candidate terms.

        Returns
        -------
        squares, coefficients : arrays of shape (candidates,)
            Sums of the squared prediction errors (degC^2), and coefficients of the candidates.
        """
        base = self.whiten(self.background)
        orthonormal = qr(base / (np.linalg.norm(base, axis=0) + TINY), mode="economic")[0]
        whitened = self.whiten(np.column_stack([target, candidates]))
        unexplained = whitened - orthonormal @ (orthonormal.T @ whitened)
        errors, terms = unexplained[:, 0], unexplained[:, 1:]
        powers = np.sum(terms**2, axis=0)
        # A candidate that is a sum of terms of the background explains nothing more.
        powers[powers <= 1e-10 * np.sum(whitened[:, 1:] ** 2, axis=0)] = np.inf
        products = terms.T @ errors
        return errors @ errors - products**2 / powers, products / powers

    def refined(self, evaluations: int = 25) -> "Fit":
        """Return the fit whose unknowns have the least squared errors nearby."""
        longest_delay = len(self.log.flow) / 6.0
        limit = HIGHEST._replace(delay=longest_delay, log_slow=np.log(2.0 * longest_delay))
        count = 8 if self.unknowns.ratio > 0.0 else 7  # a single lag has no ratio
        lowest, highest = np.array([LOWEST, limit])[:, :count]
        start = np.array(self.unknowns)[:count].clip(lowest + 1e-6, highest - 1e-6)
        result = least_squares(
            lambda values: replace(self, unknowns=Unknowns(*values)).errors,
            start,
            bounds=(lowest, highest),
            x_scale="jac",
            diff_step=1e-4,
            ftol=1e-6,
            xtol=1e-5,
            max_nfev=evaluations,
        )
        # The rows of the pseudo-inverse are as long as the roots of the inverse of J' J.
        lengths = np.linalg.norm(np.linalg.pinv(result.jac), axis=1)
        deviation = np.sqrt(np.mean(result.fun**2))
        standard_errors = Unknowns(*(deviation * lengths).tolist())
        unknowns = Unknowns(*result.x.tolist())
        return replace(self, unknowns=unknowns, standard_errors=standard_errors)


def possible_zones(
    flow: Array, operating_flow: float | None = None, *, applied: bool = False
) -> list[DeadZone]:
    """Return the dead zones that a flow (rows,) may have passed, those without width first.

    All numbers are in t/h. The centre is the operating flow or, if that is None, in the range
    of the flow. If the flow was measured behind the valve (`applied`), there is no dead zone.
    """
    centres = np.linspace(flow.min(), flow.max(), GRID)
    if operating_flow is not None:
        centres = np.array([operating_flow])
    widest = np.abs(flow - centres.mean()).max()
    half_widths = np.linspace(0.0, widest, GRID)
    # Flows that differ by less than 2 % of their range count as one level.
    levels = np.unique(np.round(50.0 * (flow - flow.min()) / np.ptp(flow)))
    if len(levels) < 3:  # They do not show the dead zone, which may have any width.
        half_widths = np.array([0.0, widest])
    if applied:
        half_widths = np.zeros(1)
    if len(half_widths) < GRID:
        centres = centres.mean(keepdims=True)
    return [DeadZone(centre, width) for width, centre in product(half_widths, centres)]


def first_fit(log: Log, zones: list[DeadZone], end_row: int | None) -> Fit:
    """Return a fit without a dead zone and with one lag, from a search over delays and lags.

    See `identify` for the arguments.
    """
    rows = len(log.flow)
    changes = log.flow - log.flow[0]
    delays = np.unique(np.geomspace(1.0, rows / 6.0, 30).round()) - 1.0
    fits = []
    for slow in np.geomspace(max(1.0, rows / 2000.0), rows / 8.0, 6):
        # The noise often has the lag of the plant, which is where the search begins.
        start = Unknowns(0.0, 0.0, np.log(slow), first_of_d=-np.exp(-1.0 / slow))
        fit = Fit(log, zones, start, zones[0], end_row=end_row)
        responses = [respond(changes, delay, slow) for delay in delays.tolist()]
        squares, gains = fit.with_candidates(log.temperature, np.column_stack(responses))
        best = int(np.argmin(squares))
        start = start._replace(gain=float(gains[best]), delay=float(delays[best]))
        fits.append(replace(fit, unknowns=start).refined(12))
    fit = min(fits, key=lambda fit: fit.squares)
    first_row = int(1.3 * fit.unknowns.delay + fit.unknowns.slow / 4.0) + 3
    return replace(fit, first_row=min(first_row, rows // 6))


def try_zones(fit: Fit) -> pd.DataFrame:
    """Return a table with a row for each possible dead zone of a fit.

    A row describes a new fit with this dead zone. The new fit has another gain and background;
    all else is as in the old fit. The columns are centre and half_width (t/h), gain
    (degC per t/h), and improvement (see `Fit.improvement`).
    """
    passed = np.column_stack([zone.passed(fit.log.flow) for zone in fit.zones])
    responses = fit.unknowns.respond(passed)
    squares, gains = fit.with_candidates(fit.log.temperature, responses)
    table = pd.DataFrame(fit.zones)
    return table.assign(gain=gains, improvement=fit.improvement(squares))


def with_zone(fit: Fit) -> Fit:
    """Return a fit whose dead zone is the mean of the likeliest dead zones.

    If the likeliest dead zones improve the fit too little, the dead zone has no width.
    """
    table = try_zones(fit)
    most = table.improvement.max()
    if most - table.improvement[table.half_width == 0.0].max() < DEAD_ZONE:
        return replace(fit, zone=DeadZone(table.centre.mean()))
    likeliest = table[table.improvement > most - 2.0]
    return replace(fit, zone=DeadZone(likeliest.centre.mean(), likeliest.half_width.mean()))


def with_lags(fit: Fit) -> Fit:
    """Return the fit, refined with two lags, or with one lag if two are hardly better."""
    single = replace(fit, unknowns=fit.unknowns._replace(ratio=0.0)).refined()
    # A second lag takes the place of a part of the delay.
    start = single.unknowns._replace(delay=0.7 * single.unknowns.delay, ratio=0.4)
    double = replace(single, unknowns=start).refined()
    return double if single.improvement(double.squares) > SECOND_LAG else single


def with_load_steps(fit: Fit) -> Fit:
    """Return a fit with the steps of unmeasured loads that improve the fit enough.

    Steps of loads that the old fit had are searched for anew.
    """
    fit = replace(fit, load_steps=())
    slow = fit.unknowns.slow
    rows = np.arange(len(fit.log.flow))
    spacing = max(int(slow / 4.0), len(rows) // 300, 1)
    step_rows = rows[spacing::spacing]
    steps = (rows[:, np.newaxis] >= step_rows).astype(np.float64)
    responses = respond(steps, 0.0, slow)
    while len(fit.load_steps) < MOST_LOAD_STEPS:
        without_flow = fit.log.temperature - fit.flow_response
        squares, _ = fit.with_candidates(without_flow, responses)
        best = int(np.argmin(squares))
        if fit.improvement(squares[best]) < LOAD_STEP:
            break
        fit = replace(fit, load_steps=(*fit.load_steps, int(step_rows[best])))
    return fit


def identify(log: Log, zones: list[DeadZone], end_row: int | None = None) -> Fit:
    """Return the refined fit of a log.

    Parameters
    ----------
    log : Log
        The log, which may begin at any time.
    zones : list of DeadZone
        The dead zones to choose from; see `possible_zones`.
    end_row : int, optional
        The fit leaves out the rows from this one on. By default, it leaves out none.
    """
    fit = first_fit(log, zones, end_row)
    for _ in range(2):  # because the best dead zone depends on the lags and vice versa
        fit = with_load_steps(with_lags(with_zone(fit)))
    return fit.refined()


def estimates(fit: Fit) -> pd.DataFrame:
    """Return the estimates of a refined fit with 95 % intervals, as a table of numbers.

    The rows are delay (samples), dead_zone (t/h), gain (degC per t/h) and time_constant (s);
    the columns are value, low and high.
    """
    values = fit.unknowns
    margins = Unknowns(*(2.0 * SPREAD * np.array(fit.standard_errors)))
    delay_margin = margins.delay + 0.5  # A log may be half a sample early or late.
    # The dead zones that are nearly as likely as the likeliest one widen the interval of the
    # gain, too.
    table = try_zones(fit)
    likely = table[table.improvement > table.improvement.max() - 4.0 * SPREAD**2]
    lower_gains = np.minimum(likely.gain - values.gain, 0.0)
    higher_gains = np.maximum(likely.gain - values.gain, 0.0)
    step = table.half_width.max() / GRID
    half_width = fit.zone.half_width
    slow = values.slow * fit.log.sampling_interval
    rows = {
        "delay": (
            values.delay,
            max(values.delay - delay_margin, 0.0),
            values.delay + delay_margin,
        ),
        "dead_zone": (
            half_width,
            max(min(half_width, likely.half_width.min() - step), 0.0),
            max(half_width, likely.half_width.max() + step),
        ),
        "gain": (
            values.gain,
            values.gain - np.hypot(margins.gain, lower_gains.min()),
            values.gain + np.hypot(margins.gain, higher_gains.max()),
        ),
        "time_constant": (
            slow,
            slow * np.exp(-margins.log_slow),
            slow * np.exp(margins.log_slow),
        ),
    }
    return pd.DataFrame(rows, index=["value", "low", "high"]).T


def explained_share(fit: Fit) -> float:
    """Return how much of the last third of a log a fit to the first two thirds explains.

    This is a share of the variance of the temperature. The second fit is made anew, and
    simulates the last third from the flow and the disturbances. The share is negative if a
    constant explains more.
    """
    end_row = 2 * len(fit.log.flow) // 3
    earlier = identify(fit.log, fit.zones, end_row)
    temperature = fit.log.temperature[end_row:]
    return float(1.0 - np.var(temperature - earlier.simulated[end_row:]) / np.var(temperature))


def polynomials(fit: Fit, delay: int) -> tuple[Array, Array, Array, float]:
    """Return A, B and C of (28), and the variance of xi (degC^2), for a delay in samples.

    A and B are exact if the delay of the fit is up to one sample longer. If it is shorter, B
    leaves out the response before the sample `delay + 1`. C and the variance give noise that
    resembles the noise of the log.
    """
    unknowns = fit.unknowns
    lags = np.array([unknowns.slow, unknowns.fast])
    a = np.asarray(np.poly(np.exp(-1.0 / lags[lags > 0.0])), np.float64)
    step = np.ones(delay + 1 + len(a))
    response = unknowns.gain * respond(step, unknowns.delay, unknowns.slow, unknowns.fast)
    impulse_response = np.diff(response[delay + 1 :], prepend=0.0)
    b = np.convolve(a, impulse_response)[: len(a)]
    noise = (fit.log.temperature - fit.simulated)[fit.first_row :]

    def innovations(reflections: Array) -> Array:
        return np.asarray(lfilter(a, stable_polynomial(*reflections), noise))

    result = least_squares(innovations, np.zeros(2), bounds=(-0.98, 0.98))
    c = stable_polynomial(*result.x)
    return a, b, c, float(np.mean(innovations(result.x) ** 2))
