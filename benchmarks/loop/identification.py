"""Fit a plant with a delay, one or two lags and a dead zone to a log, with 95 % intervals."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.signal import lfilter

Array = NDArray[np.float64]

BLOCKS = 30  # means of the temperature within a delay and a lag: more take time, and add little
NOISE_LAGS = 8  # order of the autoregressive model of the noise
TWO_LAGS, DEAD_ZONE, LOAD = 6.0, 12.0, 25.0  # deviance that each must explain to be believed
MOST_LOADS = 4
EDGES = 25  # places that are tried for each edge of the dead zone, in a grid that is refined
# Intervals are wider than the likelihood says, since no plant is quite of the model's form.
SPREAD = 1.7
DRAWS = 2_000
TINY = 1e-30  # against a division by 0
LEVELS = 5  # distinct flows from which on a dead zone with an unknown centre can be told


@dataclass(frozen=True)
class Log:
    """A recorded log with one row a sample."""

    flow: Array  # commanded from the time of its row on, (rows,)
    temperature: Array  # at the time of its row, NaN where it is missing, (rows,)
    sampling_interval: float  # s
    disturbances: Array  # measured disturbances, (rows, disturbances)

    @property
    def times(self) -> Array:
        """Times from the first row on, s."""
        return self.sampling_interval * np.arange(len(self.flow), dtype=np.float64)


class Dynamics(NamedTuple):
    """A transport delay, and one or two lags in series behind it, of gain 1."""

    delay: float  # s
    slow: float  # time constant of the slower lag, s
    fast: float = 0.0  # time constant of the faster lag, s; 0 if there is none

    def step_response(self, times: Array) -> Array:
        """Return the response at times (s) after a unit step of the flow."""
        elapsed = np.maximum(times - self.delay, 0.0)
        remaining = self.slow * np.exp(-elapsed / self.slow)
        if self.fast > 0.0:
            remaining -= self.fast * np.exp(-elapsed / self.fast)
        return np.asarray(1.0 - remaining / (self.slow - self.fast), np.float64)

    def sampled(self, interval: float, samples: int) -> tuple[Array, Array]:
        """Return B and A of (28), for a flow that is held for the interval (s).

        They are exact if the delay is between `samples` and `samples + 1`. If it is shorter, B
        leaves out what shows before the sample `samples + 1`.
        """
        lags = [self.slow, self.fast] if self.fast > 0.0 else [self.slow]
        a = np.asarray(np.poly(np.exp(-interval / np.array(lags))), np.float64)
        times = interval * (samples + 1.0 + np.arange(len(a), dtype=np.float64))
        impulse_response = np.diff(self.step_response(times), prepend=0.0)
        b = np.convolve(a, impulse_response)[: len(a)]
        return np.asarray(b, np.float64), a

    def respond(self, flows: Array, interval: float) -> Array:
        """Return the response to flows that have been 0 before, of the same shape."""
        samples = int(self.delay / interval)
        b, a = self.sampled(interval, samples)
        response = np.zeros_like(flows)
        late = lfilter([0.0, *b], a, flows, axis=0)
        response[samples:] = late[: max(len(flows) - samples, 0)]
        return response


class DeadZone(NamedTuple):
    """Flows nearer to the centre than half the width have the effect of the centre."""

    centre: float = 0.0  # t/h
    half_width: float = 0.0  # t/h

    def passed(self, flow: Array) -> Array:
        """Return the flow that the valve passes, (29)."""
        inside = np.abs(flow - self.centre) < self.half_width
        return np.where(inside, self.centre, flow)


class Posterior(NamedTuple):
    """Dead zones on a grid, the likeliest first, with the gain that belongs to each."""

    zones: list[DeadZone]
    gains: Array  # degC per t/h, (zones,)
    probabilities: Array  # (zones,)


class Solution(NamedTuple):
    """Coefficients of the columns of a fit, and what they leave of the temperature."""

    coefficients: Array  # (columns,)
    errors: Array  # whitened, (blocks,)
    columns: Array  # whitened, (blocks, columns)


@dataclass(frozen=True)
class Fit:
    """A log, and what has been found of its plant, its loads and its noise.

    The temperature is a sum of columns: the response to the flow, whose coefficient is the
    gain, what remains of the time before the log, the steps of unmeasured loads, the responses
    to measured disturbances, and a constant. The state of the plant at the first row is free,
    and so is the flow before it.
    """

    log: Log
    dynamics: Dynamics
    rows: int = 1  # in a block; the fit is to means of blocks
    scale: float = 1.0  # delay and time constant together, roughly, s
    zone: DeadZone = field(default_factory=DeadZone)
    loads: tuple[float, ...] = ()  # times of their steps, s
    powers: int = 1  # of the flow that act on the plant, in place of a dead zone
    # Coefficients of the filter that makes the noise of the blocks white.
    whitening: Array = field(default_factory=lambda: np.array([1.0, -0.8]))
    start_weight: float = 0.1  # of each block before the filter starts

    def means(self, columns: Array) -> Array:
        """Return the means of blocks of rows, with the shape (blocks, ...)."""
        blocks = len(columns) // self.rows
        shape = (blocks, self.rows, *columns.shape[1:])
        return np.asarray(columns[: blocks * self.rows].reshape(shape).mean(axis=1))

    @cached_property
    def temperature(self) -> Array:
        """Mean temperatures of the blocks; NaN where a row is missing."""
        return self.means(self.log.temperature)

    def whitened(self, blocks: Array) -> Array:
        """Return columns of blocks, filtered, where no temperature is missing."""
        order = len(self.whitening) - 1
        filtered = np.zeros_like(blocks[order:])
        for lag, weight in enumerate(self.whitening):
            filtered += weight * blocks[order - lag : len(blocks) - lag]
        return np.asarray(filtered[self.is_complete])

    @cached_property
    def is_complete(self) -> NDArray[np.bool_]:
        """Whether a block and those that the whitening filter adds to it are complete."""
        missing = np.convolve(np.isnan(self.temperature), np.ones(len(self.whitening)), "valid")
        return np.asarray(missing < 0.5)

    @cached_property
    def target(self) -> Array:
        """The whitened temperature."""
        return self.whitened(np.nan_to_num(self.temperature))

    def responses(self, flows: Array) -> Array:
        """Return the whitened responses to flows, (rows, flows) to (blocks, flows)."""
        response = self.dynamics.respond(flows, self.log.sampling_interval)
        return self.whitened(self.means(response))

    @cached_property
    def flows(self) -> Array:
        """The flow that acts on the plant, and its powers, (rows, powers)."""
        passed = self.zone.passed(self.log.flow)
        if self.powers == 1:
            return np.asarray((passed - passed[0])[:, np.newaxis])
        scaled = (passed - passed.mean()) / np.ptp(passed)
        table = scaled[:, np.newaxis] ** np.arange(1, self.powers + 1)
        return np.asarray(table - table[0])

    @cached_property
    def backdrop(self) -> Array:
        """All columns but those of the flow, in rows of the log."""
        log, dynamics, times = self.log, self.dynamics, self.log.times
        columns = [dynamics.step_response(times), np.exp(-times / dynamics.slow)]
        if dynamics.fast > 0.0:
            columns.append(np.exp(-times / dynamics.fast))
        columns += [self.load_response(start) for start in self.loads]
        # A disturbance passes the slower lag and another one. The other one is not known, but a
        # sum of three resembles any.
        for disturbance in (log.disturbances - log.disturbances[0]).T:
            for ratio in (0.3, 0.9, 3.0):
                path = Dynamics(0.0, dynamics.slow, ratio * dynamics.slow)
                columns.append(path.respond(disturbance, log.sampling_interval))
        columns.append(np.ones(len(times)))
        return np.column_stack(columns)

    def load_response(self, start: float) -> Array:
        """Return the response to the step of a load at a time in seconds."""
        return Dynamics(start, self.dynamics.slow).step_response(self.log.times)

    @cached_property
    def solution(self) -> Solution:
        """The coefficients of least squares; those of the flow come first."""
        response = self.dynamics.respond(self.flows, self.log.sampling_interval)
        blocks = self.means(np.column_stack([response, self.backdrop]))
        columns = self.whitened(blocks)
        # The filter starts behind the first blocks. These count a little, by the variance of
        # the noise, or what remains of the time before the log would be arbitrary.
        first = slice(len(self.whitening) - 1)
        weights = self.start_weight * np.isfinite(self.temperature[first])
        first_columns = weights[:, np.newaxis] * blocks[first]
        first_target = weights * np.nan_to_num(self.temperature[first])
        table = np.vstack([columns, first_columns])
        sizes = np.linalg.norm(table, axis=0) + TINY
        target = np.concatenate([self.target, first_target])
        coefficients = np.linalg.lstsq(table / sizes, target, rcond=1e-8)[0] / sizes
        return Solution(coefficients, self.target - columns @ coefficients, columns)

    @property
    def gain(self) -> float:
        """Steady-state gain, degC per t/h."""
        return float(self.solution.coefficients[0])

    def deviance(self, squares: Array | float | None = None) -> Array:
        """Return minus twice the log likelihood, of the fit or of other sums of squares."""
        errors = self.solution.errors
        squares = errors @ errors if squares is None else squares
        return np.asarray(len(errors) * np.log(np.maximum(squares / len(errors), 1e-14)))

    @cached_property
    def simulated(self) -> Array:
        """Temperatures as the plant alone makes them, without noise, (rows,)."""
        response = self.dynamics.respond(self.flows, self.log.sampling_interval)
        table = np.column_stack([response, self.backdrop])
        return np.asarray(table @ self.solution.coefficients)

    @property
    def parameters(self) -> Array:
        """The dynamics as numbers of about 1: delay, and logarithms of the time constants."""
        lags = [lag for lag in self.dynamics[1:] if lag > 0.0]
        return np.array([self.dynamics.delay, *(self.scale * np.log(lags))]) / self.scale

    def with_parameters(self, parameters: Array) -> "Fit":
        """Return the fit with other dynamics."""
        lags = np.exp(parameters[1:]).tolist()
        if len(lags) == 2:  # equal lags would divide by zero
            lags[1] = min(lags[1], 0.97 * lags[0])
        return replace(self, dynamics=Dynamics(self.scale * float(parameters[0]), *lags))

    def jacobian(self, parameters: Array) -> Array:
        """Return the derivatives of the errors by the parameters, (blocks, parameters)."""
        step = 0.01
        columns = []
        for direction in step * np.eye(len(parameters)):
            # The delay is at least 0.
            low = np.maximum(parameters - direction, [0.0, *parameters[1:] - 1.0])
            high = parameters + direction
            change = (
                self.with_parameters(high).solution.errors
                - self.with_parameters(low).solution.errors
            )
            columns.append(change / np.sum(high - low))
        return np.column_stack(columns)

    def refined(self, evaluations: int = 20) -> "Fit":
        """Return the fit of the least deviance nearby."""
        interval, duration = self.log.sampling_interval, self.log.times[-1]
        start = self.parameters
        lowest = np.array([0.0, *np.full(len(start) - 1, np.log(interval / 4.0))])
        highest = np.array(
            [duration / self.scale, *np.full(len(start) - 1, np.log(duration / 3.0))]
        )
        result = least_squares(
            lambda parameters: self.with_parameters(parameters).solution.errors,
            np.clip(start, lowest + 1e-6, highest - 1e-6), jac=self.jacobian,
            bounds=(lowest, highest), ftol=1e-5, xtol=1e-4, max_nfev=evaluations,
        )  # fmt: skip
        return self.with_parameters(result.x)

    def reweighted(self) -> "Fit":
        """Return the fit with a whitening filter for the noise that this one leaves."""
        noise = self.temperature - self.means(self.simulated)
        order = min(NOISE_LAGS, len(noise) // 15)
        columns = [noise[order - lag : len(noise) - lag] for lag in range(order + 1)]
        table = np.column_stack([*columns, np.ones(len(columns[0]))])
        table = table[np.isfinite(table).all(axis=1)]
        coefficients = np.linalg.lstsq(table[:, 1:], table[:, 0], rcond=None)[0]
        innovations = table[:, 0] - table[:, 1:] @ coefficients
        return replace(
            self,
            whitening=np.array([1.0, *-coefficients[:-1]]),
            start_weight=float(innovations.std() / (table[:, 0].std() + TINY) / order),
        )


def fit_candidates(base: Array, target: Array, candidates: Array) -> tuple[Array, Array]:
    """Fit a base (n, columns) and one of the candidates (n, candidates) to a target (n,).

    Return, for each candidate, the sum of squared errors and its coefficient.
    """
    orthonormal = np.linalg.qr(base / (np.linalg.norm(base, axis=0) + TINY))[0]
    errors = target - orthonormal @ (orthonormal.T @ target)
    independent = candidates - orthonormal @ (orthonormal.T @ candidates)
    powers = np.sum(independent**2, axis=0)
    # A candidate that the base contains adds nothing.
    powers[powers < 1e-10 * np.sum(candidates**2, axis=0) + TINY] = np.inf
    products = independent.T @ errors
    return errors @ errors - products**2 / powers, products / powers


def dead_zones(fit: Fit, operating_flow: float | None) -> Posterior:
    """Return the dead zones that a log leaves possible, the likeliest first.

    If the operating flow is not known, the centre of the dead zone is looked for, too.
    """
    flow, span = fit.log.flow, float(np.ptp(fit.log.flow))
    backdrop = fit.whitened(fit.means(fit.backdrop))
    lows = highs = np.linspace(flow.min() - span / 4.0, flow.max() + span / 4.0, EDGES)
    if operating_flow is not None:
        reach = float(np.abs(flow - operating_flow).max())
        lows = np.linspace(operating_flow - reach, operating_flow, EDGES**2 // 4)
    for _ in range(4):
        if operating_flow is None:
            pairs = [(low, high) for low in lows for high in highs if low <= high]
        else:
            pairs = [(low, 2.0 * operating_flow - low) for low in lows]
        zones = [DeadZone((low + high) / 2.0, (high - low) / 2.0) for low, high in pairs]
        flows = np.column_stack([zone.passed(flow) for zone in zones])
        responses = fit.responses(flows - flows[0])
        squares, gains = fit_candidates(backdrop, fit.target, responses)
        deviances = fit.deviance(squares) / SPREAD**2
        likely = np.array(pairs)[deviances < deviances.min() + 15.0]
        lows, highs = finer(lows, likely[:, 0]), finer(highs, likely[:, 1])
    order = np.argsort(deviances)
    probabilities = np.exp((deviances.min() - deviances[order]) / 2.0)
    probabilities /= probabilities.sum()
    return Posterior([zones[i] for i in order], gains[order], probabilities)


def finer(places: Array, likely: Array) -> Array:
    """Return a grid of as many places that reaches one step beyond the likely ones."""
    step = places[1] - places[0]
    return np.linspace(likely.min() - step, likely.max() + step, len(places))


def with_zone(fit: Fit, posterior: Posterior, centre: float) -> Fit:
    """Return the fit with the mean of the likeliest dead zones, if the log asks for one.

    If it does not, the fit has no dead zone, and its operating flow is `centre`.
    """
    likely = posterior.probabilities > np.exp(-1.0) * posterior.probabilities[0]
    weights = posterior.probabilities[likely]
    mean = np.average(np.array(posterior.zones)[likely], axis=0, weights=weights)
    plain = replace(fit, zone=DeadZone(centre, 0.0))
    bounded = replace(fit, zone=DeadZone(*mean.tolist()))
    return bounded if plain.deviance() - bounded.deviance() > DEAD_ZONE else plain


def with_lags(fit: Fit) -> Fit:
    """Return the best fit with two lags, or with one if the second explains little."""
    delay, slow, _ = fit.dynamics
    single = replace(fit, dynamics=Dynamics(delay, slow)).refined()
    delay, slow, _ = single.dynamics
    starts = [(0.8, 0.35), (0.4, 0.6)]  # shares of the delay, and the faster lag of the slower
    doubles = [
        replace(fit, dynamics=Dynamics(share * delay, slow, ratio * slow)).refined()
        for share, ratio in starts
    ]
    double = min(doubles, key=Fit.deviance)
    return double if single.deviance() - double.deviance() > TWO_LAGS else single


def with_loads(fit: Fit) -> Fit:
    """Return the fit with the steps of unmeasured loads that its errors ask for."""
    times = fit.log.times
    spacing = max(fit.scale / 4.0, times[-1] / 300.0)
    starts = np.arange(spacing, times[-1], spacing)
    responses = fit.means(np.column_stack([fit.load_response(start) for start in starts]))
    candidates = fit.whitened(responses)
    while len(fit.loads) < MOST_LOADS:
        squares, _ = fit_candidates(fit.solution.columns, fit.target, candidates)
        best = int(np.argmin(squares))
        if fit.deviance() - fit.deviance(squares[best]) < LOAD:
            break
        fit = replace(fit, loads=(*fit.loads, float(starts[best])))
    return fit


def coarse(log: Log) -> Fit:
    """Return a rough fit of one lag to a smooth function of the flow."""
    interval, duration = log.sampling_interval, len(log.flow) * log.sampling_interval
    delays = [0.0, *np.geomspace(interval, duration / 6.0, 30)]
    lags = np.geomspace(max(interval, duration / 2_000.0), duration / 8.0, 8)
    # The powers stand for a dead zone that is not known yet.
    powers = 3 if distinct_flows(log.flow) >= LEVELS else 1
    rough = Fit(
        log,
        Dynamics(0.0, lags[0]),
        max(1, len(log.flow) // 800),
        duration / 50.0,
        powers=powers,
    )
    fits = [
        replace(rough, dynamics=Dynamics(delay, lag))
        for lag in lags.tolist()
        for delay in delays
    ]
    fits.sort(key=Fit.deviance)
    best = min((fits[rank].refined() for rank in (0, 5)), key=Fit.deviance)
    scale = best.dynamics.delay + best.dynamics.slow
    rows = max(1, int(scale / interval / BLOCKS))
    return replace(best, scale=scale, rows=rows)


def distinct_flows(flow: Array) -> int:
    """Return how many flows there are that differ by more than noise, 2 % of their range."""
    return len(np.unique(np.round((flow - flow.min()) / (0.02 * np.ptp(flow)))))


class Interval(NamedTuple):
    """An estimate with its 95 % interval."""

    value: float
    low: float
    high: float


def intervals(fit: Fit, posterior: Posterior) -> dict[str, Interval]:
    """Return delay (samples), dead zone (t/h), gain (degC per t/h) and time constant (s).

    The intervals are quantiles of a sample from the likely dead zones and, for each, from the
    normal distribution of the other parameters.
    """
    generator = np.random.default_rng(0)
    slopes = np.column_stack([fit.jacobian(fit.parameters), -fit.solution.columns])
    sizes = np.linalg.norm(slopes, axis=0) + TINY
    variance = SPREAD**2 * np.mean(fit.solution.errors**2)
    covariance = variance * np.linalg.pinv((slopes / sizes).T @ (slopes / sizes), rcond=1e-12)
    covariance /= np.outer(sizes, sizes)
    count = len(fit.parameters)
    # The errors of the gain come after those of the dynamics.
    mean = [*fit.parameters, 0.0]
    shares = covariance[: count + 1, : count + 1]
    draws = generator.multivariate_normal(mean, shares, DRAWS, method="eigh")
    picks = generator.choice(len(posterior.zones), DRAWS, p=posterior.probabilities)
    samples_of_delay = draws[:, 0].clip(0.0) * fit.scale / fit.log.sampling_interval
    widths = np.array([zone.half_width for zone in posterior.zones])[picks]

    def interval(value: float, values: Array, margin: float = 0.0) -> Interval:
        low, high = np.quantile(values, (0.025, 0.975))
        return Interval(value, min(low - margin, value), max(high + margin, value))

    delay = fit.dynamics.delay / fit.log.sampling_interval
    delays = interval(delay, samples_of_delay, 0.5)  # half a sample for how a log is written
    estimates = {
        "delay": delays._replace(low=max(delays.low, 0.0)),
        "dead_zone": interval(fit.zone.half_width, widths.clip(0.0)),
        "gain": interval(fit.gain, posterior.gains[picks] + draws[:, count]),
        "time_constant": interval(fit.dynamics.slow, np.exp(draws[:, 1])),
    }
    if fit.dynamics.fast > 0.0:
        estimates["second_time_constant"] = interval(fit.dynamics.fast, np.exp(draws[:, 2]))
    return estimates


@dataclass(frozen=True)
class Identified:
    """The plant of a log, and how well it explains the log."""

    fit: Fit
    estimates: dict[str, Interval]
    explained: float  # share of the variance of the last third, by a fit to the first two
    may_show_zone: bool  # whether a dead zone was looked for

    @property
    def operating_flow(self) -> float:
        """The centre of the dead zone, t/h."""
        return self.fit.zone.centre

    @property
    def operating_temperature(self) -> float:
        """The temperature at the operating flow, degC."""
        fit = self.fit
        first = fit.zone.passed(fit.log.flow)[0]
        base = fit.solution.coefficients[-1] + fit.solution.coefficients[1]
        return float(base + fit.gain * (self.operating_flow - first))

    @property
    def is_white(self) -> bool:
        """Whether the prediction errors are hardly correlated with each other."""
        errors = self.fit.solution.errors
        products = np.correlate(errors, errors, "full")[len(errors) :][:30]
        largest = max(0.1, 2.5 / np.sqrt(len(errors))) * (errors @ errors)
        return bool(np.mean(np.abs(products) > largest) < 0.25)

    def noise(self, a: Array) -> tuple[Array, float]:
        """Return C of (28) and the variance of xi such that C xi / A resembles the errors."""
        errors = np.nan_to_num(self.fit.log.temperature - self.fit.simulated)

        def innovations(parameters: Array) -> Array:
            return np.asarray(lfilter(a, np.poly(np.tanh(parameters)), errors))

        # The roots of C stay inside the unit circle. C begins as A: then the noise is white.
        roots = np.clip([*np.roots(a).real, 0.1], 0.1, 0.98)
        result = least_squares(innovations, np.arctanh(roots), method="lm", max_nfev=60)
        return np.asarray(np.poly(np.tanh(result.x)), np.float64), float(
            np.mean(innovations(result.x) ** 2)
        )


def operating_flow_of(flow: Array) -> float:
    """Return 0 if it is well inside the range of the flows, and else the middle of it."""
    middle = (flow.min() + flow.max()) / 2.0
    return 0.0 if abs(middle) <= np.ptp(flow) / 4.0 else float(middle)


def identify(
    log: Log, operating_flow: float | None = None, *, applied: bool = False
) -> Identified:
    """Return the plant of a log.

    Parameters
    ----------
    log : Log
        The log. Its first row may be in the middle of an operation.
    operating_flow : float, optional
        Flow at the centre of the dead zone, t/h. By default, the fit finds it.
    applied : bool
        Whether the flow was measured behind the valve, so that there is no dead zone.
    """
    centre = operating_flow_of(log.flow) if operating_flow is None else operating_flow
    fit = replace(coarse(log), zone=DeadZone(centre, 0.0))
    levels = LEVELS if operating_flow is None else 3
    may_show_zone = not applied and distinct_flows(log.flow) >= levels
    for _ in range(3):
        fit = replace(fit.reweighted(), powers=1)
        if may_show_zone:
            fit = with_zone(fit, dead_zones(fit, operating_flow), centre)
        fit = with_lags(with_loads(replace(fit, loads=())))
    if may_show_zone:
        posterior = dead_zones(fit, operating_flow)
        fit = with_zone(fit, posterior, centre)
    else:
        # A dead zone that the log does not show may reach to the outermost flow.
        widest = 0.0 if applied else float(np.abs(log.flow - centre).max())
        zones = [DeadZone(centre, 0.0), DeadZone(centre, widest)]
        posterior = Posterior(zones, np.full(2, fit.gain), np.full(2, 0.5))
    return Identified(fit, intervals(fit, posterior), held_out(fit), may_show_zone)


def held_out(fit: Fit) -> float:
    """Return the share of the last third's variance that a fit to the first two explains."""
    cut = 2 * len(fit.log.flow) // 3
    known = np.where(np.arange(len(fit.log.flow)) < cut, fit.log.temperature, np.nan)
    loads = tuple(start for start in fit.loads if start < fit.log.times[cut])
    first = replace(fit, log=replace(fit.log, temperature=known), loads=loads).refined()
    errors = (fit.log.temperature - first.simulated)[cut:]
    return float(1.0 - np.nanvar(errors) / np.nanvar(fit.log.temperature[cut:]))
