"""Fit a plant with a dead zone, a delay and one or two lags to a log, with 95 % intervals.

A log is a table of flows and temperatures, with one row for each sample. The fitted model (a
Box-Jenkins model) describes the temperature as the sum of three parts:

- the flow response: the output of a dead zone, a delay, one or two lags and a gain in series,
  whose input is the flow;
- the background: a constant, the decay of the plant's state at the first fitted row, the
  responses to measured disturbances, and the responses to steps of unmeasured loads;
- coloured noise C(z^-1) / D(z^-1) xi, with two polynomials C and D and the white noise xi.

The fit minimises the sum of the squared prediction errors, which are estimates of the white
noise xi.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.linalg import lstsq, qr
from scipy.optimize import least_squares
from scipy.signal import lfilter

Array = NDArray[np.float64]

# Smallest values of `Fit.improvement` for which the model gets a second lag, a dead zone or a
# load step. The values are not 0, because every added part improves a fit a little by chance.
IMPROVEMENT_BY_SECOND_LAG = 10.0
IMPROVEMENT_BY_DEAD_ZONE = 9.0
# A load step needs the largest improvement, as its row is chosen among hundreds of rows.
IMPROVEMENT_BY_LOAD_STEP = 25.0
MOST_LOAD_STEPS = 4  # largest number in a model: many load steps could fit any temperature
# Distance from an estimate to either end of its 95 % interval, in standard errors. Two standard
# errors would be enough if the model could describe a plant exactly. With three, the intervals
# of the gain contained the true gain in at least 95 % of the logs of simulated plants.
INTERVAL = 3.0
GRID_POINTS = 31  # number of centres, and number of half widths, of the dead zones in a fit
# The lags between a measured disturbance and the temperature are unknown. A weighted sum of the
# step responses of three pairs of lags is close to nearly any smooth step response. Each pair
# has the plant's larger time constant, and this time constant times one of the ratios.
DISTURBANCE_RATIOS = 0.3, 0.9, 3.0
# Smallest singular value in the least squares for `Fit.coefficients`, as a share of the largest
# singular value. Columns of `Fit.background` can be nearly equal, such as the responses of
# three pairs of lags to a slow disturbance.
SMALLEST_COMBINATION = 1e-8
MOST_BLOCKS = 2000  # largest number of blocks of rows in a fit; more blocks only take longer
# Number and weight of the first blocks. The filter that whitens the noise has not settled in
# the first blocks, so the prediction errors are as large as the noise, and get a small
# weight. With the weight 0, the fit would not determine the plant's state at the first fitted
# row.
SETTLING_BLOCKS = 10
SETTLING_WEIGHT = 0.1
TINY = 1e-30  # prevents divisions by zero


@dataclass(frozen=True)
class Log:
    """A log of a plant, with one row for each sample and without missing values."""

    flow: Array  # the flow commanded from the time of each row on, t/h, shape (rows,)
    temperature: Array  # the temperature at the time of each row, degC, shape (rows,)
    disturbances: Array  # measured disturbances, in any units, shape (rows, disturbances)
    sampling_interval: float  # the time between two rows, s
    missing_flows: float = 0.0  # share of the rows whose flow was missing and was filled in


class DeadZone(NamedTuple):
    """Dead zone of a valve: all flows in an interval act like the flow in the middle."""

    centre: float  # the middle of the interval, t/h
    half_width: float = 0.0  # half of the length of the interval, t/h; 0 for no dead zone

    def passed(self, flow: Array) -> Array:
        """Return the flows that act on the plant, t/h, if the flows `flow`, t/h, are commanded.

        A flow inside the dead zone is replaced by the centre of the dead zone, as in equation
        (29) of the paper.
        """
        is_inside = np.abs(flow - self.centre) < self.half_width
        return np.where(is_inside, self.centre, flow)


def respond(inputs: Array, delay: float, slow: float, fast: float = 0.0) -> Array:
    """Return the output of a delay and one or two first-order lags in series, with gain 1.

    The result is exact for inputs that are constant from one row to the next and were 0 before
    the first row.

    Parameters
    ----------
    inputs : array of shape (rows, ...)
        Flows or other input signals, in any unit.
    delay : float
        Delay in samples, not necessarily an integer.
    slow, fast : float
        Time constants of the two lags, in samples. `fast` must differ from `slow`, and is 0 for
        a single lag.

    Returns
    -------
    array of shape (rows, ...)
        Output signals, in the unit of `inputs`.
    """
    if fast > 0.0:  # partial fractions
        slow_part = slow * respond(inputs, delay, slow)
        fast_part = fast * respond(inputs, delay, fast)
        return np.asarray((slow_part - fast_part) / (slow - fast))
    whole_delay = int(delay)
    decay = np.exp(-1.0 / slow)
    state = lfilter([0.0, 1.0 - decay], [1.0, -decay], inputs, axis=0)
    # If the delay is not an integer, the delayed input changes between two rows. From the
    # change to the next row, the state decays for a part of a sample.
    decay_to_row = np.exp(-(1.0 - (delay - whole_delay)) / slow)
    state_at_rows = decay_to_row * state + (1.0 - decay_to_row) * inputs
    response = np.zeros_like(inputs)
    response[whole_delay + 1 :] = state_at_rows[: max(len(inputs) - whole_delay - 1, 0)]
    return response


def stable_polynomial(first: float, second: float) -> Array:
    """Return (1, p, q), the coefficients of a polynomial 1 + p z^-1 + q z^-2.

    `first` and `second` are the reflection coefficients of the polynomial. If both reflection
    coefficients are between -1 and 1, all roots z of the polynomial lie inside the unit circle.
    """
    return np.array([1.0, first * (1.0 + second), second])


class Unknowns(NamedTuple):
    """The parameters of a plant's model that are estimated by nonlinear least squares."""

    gain: float  # steady-state gain from flow to temperature, degC per t/h
    delay: float  # delay of the flow response, samples, not necessarily an integer
    log_slow: float  # logarithm of the larger time constant in samples
    # Reflection coefficients of the polynomials C and D of the noise model C / D.
    first_of_c: float = 0.0
    second_of_c: float = 0.0
    first_of_d: float = 0.0
    second_of_d: float = 0.0
    ratio: float = 0.0  # smaller time constant divided by the larger one; 0 for a single lag

    @property
    def slow(self) -> float:
        """The time constant of a single lag, or the larger one of two lags, samples."""
        return float(np.exp(self.log_slow))

    @property
    def fast(self) -> float:
        """The smaller time constant of two lags, samples; 0 for a single lag."""
        return self.ratio * self.slow

    def respond(self, flows: Array) -> Array:
        """Return the model's response to the input `flows - flows[0]`, with the gain 1.

        `flows` and the result are in t/h and have the shape (rows, ...).
        """
        return respond(flows - flows[0], self.delay, self.slow, self.fast)


# Lower and upper limits of the parameters in `Fit.refined`, which sets the upper limits of the
# delay and of the larger time constant from the length of the log.
LOWEST = Unknowns(-np.inf, 0.0, np.log(0.25), -0.98, -0.98, -0.999, -0.999, 0.02)
HIGHEST = Unknowns(np.inf, np.inf, np.inf, 0.98, 0.98, 0.999, 0.999, 0.97)


@dataclass(frozen=True)
class Fit:
    """A model of a plant, fitted to a log.

    The rows from `first_row` to `end_row` are divided into blocks of successive rows, and the
    model is fitted to the mean of each block. In a log of fewer than `MOST_BLOCKS` rows, each
    row is a block.
    """

    log: Log
    zones: list[DeadZone]  # the dead zones to choose from, those of half width 0 first
    unknowns: Unknowns  # the values of gain, delay, time constants and noise model
    zone: DeadZone  # the dead zone of the model
    load_steps: tuple[int, ...] = ()  # the rows in which an unmeasured load has a step
    # The first row that is fitted. The temperatures in the rows before `first_row` depend on
    # flows from before the log.
    first_row: int = 0
    end_row: int | None = None  # the row after the last fitted row; None for all rows
    # Standard error of each parameter in `unknowns`; None if `refined` was not called.
    standard_errors: Unknowns | None = None

    def whiten(self, signals: Array) -> Array:
        """Return means of signals over blocks of rows, filtered so that noise becomes white.

        The filter is D / C, where C / D is the filter of the noise model, which turns white
        noise into coloured noise. The result is multiplied by `SETTLING_WEIGHT` in the first
        `SETTLING_BLOCKS` blocks. `signals` has the shape (rows, ...), and the result has the
        shape (blocks, ...).
        """
        unknowns = self.unknowns
        c = stable_polynomial(unknowns.first_of_c, unknowns.second_of_c)
        d = stable_polynomial(unknowns.first_of_d, unknowns.second_of_d)
        fitted = signals[self.first_row : self.end_row]
        size = 1 + len(signals) // MOST_BLOCKS
        blocks = len(fitted) // size
        shape = (blocks, size, *signals.shape[1:])
        means = fitted[: blocks * size].reshape(shape).mean(axis=1)
        whitened = np.asarray(lfilter(d, c, means, axis=0), np.float64)
        whitened[:SETTLING_BLOCKS] *= SETTLING_WEIGHT
        return whitened

    @cached_property
    def flow_response(self) -> Array:
        """The temperature change caused by all changes of the flow since the first row, degC.

        The returned array has the shape (rows,).
        """
        return self.unknowns.gain * self.unknowns.respond(self.zone.passed(self.log.flow))

    @cached_property
    def background(self) -> Array:
        """Signals whose weighted sum is the temperature without noise and response to the flow.

        The weights are `coefficients`. The returned array has a signal in each column, shape
        (rows, terms), and the first column is 1 in all rows.
        """
        slow, fast = self.unknowns.slow, self.unknowns.fast
        rows = np.arange(len(self.log.flow), dtype=np.float64)
        elapsed = np.maximum(rows - self.first_row, 0.0)
        terms = [np.ones(len(rows)), np.exp(-elapsed / slow)]
        if fast > 0.0:
            terms.append(np.exp(-elapsed / fast))
        for step_row in self.load_steps:
            step = (rows >= step_row).astype(np.float64)
            terms.append(respond(step, 0.0, slow))
        changes = self.log.disturbances - self.log.disturbances[0]
        for ratio in DISTURBANCE_RATIOS:
            responses = respond(changes, 0.0, slow, ratio * slow)
            terms.extend(responses.T)  # a term for each disturbance
        return np.column_stack(terms)

    @cached_property
    def coefficients(self) -> Array:
        """Weights of the signals in `background`, fitted by least squares, shape (terms,)."""
        terms = self.whiten(self.background)
        target = self.whiten(self.log.temperature - self.flow_response)
        lengths = np.linalg.norm(terms, axis=0) + TINY
        factors, *_ = lstsq(terms / lengths, target, cond=SMALLEST_COMBINATION)
        return np.asarray(factors / lengths)

    @cached_property
    def simulated(self) -> Array:
        """The temperature that the model simulates without noise, degC, shape (rows,)."""
        return np.asarray(self.background @ self.coefficients + self.flow_response)

    @cached_property
    def errors(self) -> Array:
        """The prediction error of each block of rows, degC, shape (blocks,)."""
        return self.whiten(self.log.temperature - self.simulated)

    @property
    def operating_temperature(self) -> float:
        """The steady temperature of the model if the flow is the centre of the dead zone, degC.

        The loads and the measured disturbances are assumed to have the values of the first row
        of the log.
        """
        first_flow = self.zone.passed(self.log.flow[:1])[0]
        change = self.unknowns.gain * (self.zone.centre - first_flow)
        return float(self.coefficients[0] + change)

    @property
    def squares(self) -> float:
        """The sum of the squared prediction errors, degC^2."""
        return float(self.errors @ self.errors + TINY)

    def improvement(self, squares: Array | float) -> Array:
        """Return twice the log-likelihood ratio of other fits to this fit: above 0 if better.

        `squares` has the sums of squared prediction errors of the other fits, degC^2, and the
        result has the shape of `squares`.
        """
        return np.asarray(len(self.errors) * np.log(self.squares / (squares + TINY)))

    def try_candidates(self, target: Array, candidates: Array) -> tuple[Array, Array]:
        """Fit a signal by the signals in `background` and one further signal, a candidate.

        There is a fit for each candidate: a weighted sum of the candidate and of all signals in
        `background` is fitted to `target`, the signal, degC, shape (rows,). `candidates` has a
        candidate in each column, in any unit, shape (rows, candidates). Two arrays of shape
        (candidates,) are returned: the sum of the squared prediction errors of each fit,
        degC^2, and the weight of the candidate in each fit, degC per unit of the candidate.
        """
        # Regress the target and the candidates on the columns of `background`. The residual of
        # the target is then fitted by the residual of one candidate.
        base = self.whiten(self.background)
        orthonormal = qr(base / (np.linalg.norm(base, axis=0) + TINY), mode="economic")[0]
        whitened = self.whiten(np.column_stack([target, candidates]))
        unexplained = whitened - orthonormal @ (orthonormal.T @ whitened)
        errors, terms = unexplained[:, 0], unexplained[:, 1:]
        powers = np.sum(terms**2, axis=0)
        # A candidate that is a weighted sum of columns of `background` cannot improve the fit.
        powers[powers <= 1e-10 * np.sum(whitened[:, 1:] ** 2, axis=0)] = np.inf
        products = terms.T @ errors
        return errors @ errors - products**2 / powers, products / powers

    def refined(self, evaluations: int = 25) -> "Fit":
        """Return this fit with its parameters `unknowns` improved by nonlinear least squares.

        The search starts from the values in `unknowns`, and descends towards a local minimum of
        the sum of squared prediction errors. The returned fit has `standard_errors`.
        `evaluations` is the largest number of steps of the search.
        """
        longest_delay = len(self.log.flow) / 6.0
        highest = HIGHEST._replace(delay=longest_delay, log_slow=np.log(2.0 * longest_delay))
        limits = np.array([LOWEST, highest])
        start = np.array(self.unknowns)
        if self.unknowns.ratio == 0.0:  # A single lag has no ratio, the last parameter.
            limits, start = limits[:, :-1], start[:-1]

        def errors(values: Array) -> Array:
            return replace(self, unknowns=Unknowns(*values)).errors

        result = least_squares(
            errors,
            start.clip(limits[0] + 1e-6, limits[1] - 1e-6),
            bounds=limits,
            x_scale="jac",
            diff_step=1e-4,
            ftol=1e-6,
            xtol=1e-5,
            max_nfev=evaluations,
        )
        # With the Jacobian J, the covariance of the estimates is the inverse of J' J times the
        # variance of the errors. The lengths of the rows of the pseudo-inverse of J are the
        # square roots of the diagonal of the inverse of J' J.
        lengths = np.linalg.norm(np.linalg.pinv(result.jac), axis=1)
        deviation = np.sqrt(np.mean(result.fun**2))
        standard_errors = Unknowns(*(deviation * lengths).tolist())
        unknowns = Unknowns(*result.x.tolist())
        return replace(self, unknowns=unknowns, standard_errors=standard_errors)


def possible_zones(
    flow: Array, operating_flow: float | None = None, *, applied: bool = False
) -> list[DeadZone]:
    """Return the dead zones that a fit to a log tries, sorted by half width from 0 on.

    `flow` is the flow of the log, t/h, shape (rows,). `operating_flow` is the centre of all
    dead zones, t/h; if `operating_flow` is None, the centres lie in the whole range of the
    flow. If `applied` is true, the flow was measured behind the valve, and the only returned
    dead zone has the half width 0. If `flow` has only two different values, there are two dead
    zones: one with the half width 0, and one that contains all flows. In both of these cases,
    the centre is `operating_flow` or, if `operating_flow` is None, the middle of the range of
    the flow.
    """
    centres = np.linspace(flow.min(), flow.max(), GRID_POINTS)
    if operating_flow is not None:
        centres = np.array([operating_flow])
    widest = np.abs(flow - centres.mean()).max()
    half_widths = np.linspace(0.0, widest, GRID_POINTS)
    # Flows that differ by less than 2 % of their range count as equal.
    levels = np.unique(np.round(50.0 * (flow - flow.min()) / np.ptp(flow)))
    if len(levels) < 3:  # From two different flows, no fit can find the half width.
        half_widths = np.array([0.0, widest])
    if applied:
        half_widths = np.zeros(1)
    if len(half_widths) < GRID_POINTS:
        centres = centres.mean(keepdims=True)
    return [DeadZone(centre, width) for width in half_widths for centre in centres]


def first_fit(log: Log, zones: list[DeadZone], end_row: int | None) -> Fit:
    """Return a first fit of the model to a log, without a dead zone and with one lag.

    The result is the best of several searches, which start from different time constants.
    `log`, `zones` and `end_row` are the arguments of `identify`.
    """
    rows = len(log.flow)
    changes = log.flow - log.flow[0]
    delays = np.unique(np.geomspace(1.0, rows / 6.0, 30).round()) - 1.0
    fits = []
    time_constants = np.geomspace(max(1.0, rows / 2000.0), rows / 8.0, 6)  # samples
    for slow in time_constants:
        # The noise often has the time constant of the plant. The search therefore starts with
        # D = 1 - exp(-1 / slow) z^-1, which has the root exp(-1 / slow).
        start = Unknowns(0.0, 0.0, np.log(slow), first_of_d=-np.exp(-1.0 / slow))
        without_dead_zone = zones[0]  # The first dead zone has the half width 0.
        fit = Fit(log, zones, start, without_dead_zone, end_row=end_row)
        responses = [respond(changes, delay, slow) for delay in delays.tolist()]
        squares, gains = fit.try_candidates(log.temperature, np.column_stack(responses))
        best = int(np.argmin(squares))
        start = start._replace(gain=float(gains[best]), delay=float(delays[best]))
        fits.append(replace(fit, unknowns=start).refined(12))
    fit = min(fits, key=lambda fit: fit.squares)
    # Temperatures during the delay depend on flows from before the log. The first fitted row is
    # later than the delay by a margin, because the delay of the first fit is not exact. But at
    # most a sixth of the rows is left out.
    first_row = int(1.3 * fit.unknowns.delay + fit.unknowns.slow / 4.0) + 3
    return replace(fit, first_row=min(first_row, rows // 6))


def try_zones(fit: Fit) -> pd.DataFrame:
    """Return a table of fits with other dead zones than `fit`, a row for each of `fit.zones`.

    For each dead zone, only the gain and `Fit.coefficients` are fitted again. The columns of
    the table are `centre` and `half_width` of the dead zone (t/h), the new `gain` (degC per
    t/h), and `improvement`, which is the result of `fit.improvement` for the new fit.
    """
    passed = np.column_stack([zone.passed(fit.log.flow) for zone in fit.zones])
    responses_with_gain_1 = fit.unknowns.respond(passed)
    squares, gains = fit.try_candidates(fit.log.temperature, responses_with_gain_1)
    table = pd.DataFrame(fit.zones)
    return table.assign(gain=gains, improvement=fit.improvement(squares))


def with_zone(fit: Fit) -> Fit:
    """Return `fit` with a new dead zone: the mean of the likeliest dead zones in `fit.zones`.

    If no dead zone improves a fit without a dead zone by `IMPROVEMENT_BY_DEAD_ZONE`, the new
    dead zone has the half width 0 and the mean of all centres in `fit.zones`. The gain, the
    delay, the time constants and the noise model of `fit` are not changed.
    """
    table = try_zones(fit)
    most = table.improvement.max()
    most_without_zone = table.improvement[table.half_width == 0.0].max()
    if most - most_without_zone < IMPROVEMENT_BY_DEAD_ZONE:
        return replace(fit, zone=DeadZone(table.centre.mean()))
    # Dead zones with nearly the largest improvement are about as likely as the best one.
    likeliest = table[table.improvement > most - 2.0]
    return replace(fit, zone=DeadZone(likeliest.centre.mean(), likeliest.half_width.mean()))


def with_lags(fit: Fit) -> Fit:
    """Return `fit`, refined with one lag, or with two lags if two lags are clearly better.

    The second lag must improve the fit (`Fit.improvement`) by more than
    `IMPROVEMENT_BY_SECOND_LAG`.
    """
    single = replace(fit, unknowns=fit.unknowns._replace(ratio=0.0)).refined()
    # The second lag replaces a part of the delay of the model with one lag.
    start = single.unknowns._replace(delay=0.7 * single.unknowns.delay, ratio=0.4)
    double = replace(single, unknowns=start).refined()
    return double if single.improvement(double.squares) > IMPROVEMENT_BY_SECOND_LAG else single


def with_load_steps(fit: Fit) -> Fit:
    """Return `fit` with new steps of unmeasured loads, which replace the load steps of `fit`.

    Up to `MOST_LOAD_STEPS` load steps are added one by one, always the step that improves the
    fit most, among steps in evenly spaced rows. A load step is added only if it improves the
    fit by `IMPROVEMENT_BY_LOAD_STEP`.
    """
    fit = replace(fit, load_steps=())
    slow = fit.unknowns.slow
    rows = np.arange(len(fit.log.flow))
    spacing = max(int(slow / 4.0), len(rows) // 300, 1)
    step_rows = rows[spacing::spacing]
    steps = (rows[:, np.newaxis] >= step_rows).astype(np.float64)
    responses = respond(steps, 0.0, slow)
    without_flow = fit.log.temperature - fit.flow_response
    while len(fit.load_steps) < MOST_LOAD_STEPS:
        squares, _ = fit.try_candidates(without_flow, responses)
        best = int(np.argmin(squares))
        if fit.improvement(squares[best]) < IMPROVEMENT_BY_LOAD_STEP:
            break
        fit = replace(fit, load_steps=(*fit.load_steps, int(step_rows[best])))
    return fit


def identify(log: Log, zones: list[DeadZone], end_row: int | None = None) -> Fit:
    """Return the best fit of a plant model to a log.

    The plant need not be at rest in the first row of the log. `zones` is a list of dead zones
    to choose from, a result of `possible_zones`. The model is fitted to the rows before
    `end_row`, or to all rows if `end_row` is None.
    """
    fit = first_fit(log, zones, end_row)
    for _ in range(2):  # because the best dead zone depends on the lags and vice versa
        fit = with_load_steps(with_lags(with_zone(fit)))
    return fit.refined()


def estimates(fit: Fit) -> pd.DataFrame:
    """Return a table of the plant's estimated parameters with 95 % confidence intervals.

    The rows of the table are `delay` (samples), `dead_zone` (the half width, t/h), `gain` (degC
    per t/h) and `time_constant` (the larger time constant, s). The columns of the table are
    `value`, `low` and `high`, where `low` and `high` are the ends of the confidence interval.
    `fit` must be a result of `Fit.refined` or `identify`, which compute standard errors.
    """
    values = fit.unknowns
    margins = Unknowns(*(INTERVAL * np.array(fit.standard_errors)))
    delay_margin = margins.delay + 0.5  # Recorded times may be half a sample late.
    # An improvement that is smaller by z^2 corresponds to a distance of z standard errors.
    table = try_zones(fit)
    likely = table[table.improvement > table.improvement.max() - INTERVAL**2]
    step = table.half_width.max() / GRID_POINTS
    narrowest = min(fit.zone.half_width, likely.half_width.min() - step)
    widest = max(fit.zone.half_width, likely.half_width.max() + step)
    # The dead zones that are nearly as likely as the likeliest one widen the interval of the
    # gain, too.
    gain_below = np.hypot(margins.gain, min(likely.gain.min() - values.gain, 0.0))
    gain_above = np.hypot(margins.gain, max(likely.gain.max() - values.gain, 0.0))
    time_constant = values.slow * fit.log.sampling_interval
    factor = np.exp(margins.log_slow)
    shortest_delay = max(values.delay - delay_margin, 0.0)
    rows = {
        "delay": (values.delay, shortest_delay, values.delay + delay_margin),
        "dead_zone": (fit.zone.half_width, max(narrowest, 0.0), widest),
        "gain": (values.gain, values.gain - gain_below, values.gain + gain_above),
        "time_constant": (time_constant, time_constant / factor, time_constant * factor),
    }
    return pd.DataFrame(rows, index=["value", "low", "high"]).T


def explained_share(fit: Fit) -> float:
    """Return how well a model of the first two thirds of a log predicts the last third.

    A model that is fitted to the first two thirds of the log simulates the temperature in the
    last third from the flow and the measured disturbances. The result is the share of the
    variance of the temperature in the last third that the simulation explains: 1 if the
    simulation differs from the temperature by a constant or not at all, and below 0 for a
    simulation that is worse than a constant.
    """
    end_row = 2 * len(fit.log.flow) // 3
    earlier = identify(fit.log, fit.zones, end_row)
    temperature = fit.log.temperature[end_row:]
    return float(1.0 - np.var(temperature - earlier.simulated[end_row:]) / np.var(temperature))


def polynomials(fit: Fit, delay: int) -> tuple[Array, Array, Array, float]:
    """Return the polynomials A, B, C of a plant, and the variance of its noise xi, degC^2.

    The plant is equation (28) of the paper, A(z^-1) y(k) = B(z^-1) u_a(k - d) + C(z^-1) xi(k),
    with temperature y, applied flow u_a, delay d = `delay` (samples) and white noise xi. The
    returned arrays A and C begin with the coefficient of z^0. The returned array B begins with
    the coefficient of z^-1, in degC per t/h.

    If the delay of the fit is from `delay` to `delay + 1`, the polynomials A and B reproduce
    the fit's response to the flow exactly. If the delay of the fit is shorter than `delay`, the
    polynomial B leaves out the response before the sample `delay + 1`. The polynomial C and the
    variance of xi are fitted to the recorded temperature minus the simulated temperature.
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
