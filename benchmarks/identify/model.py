"""What is asked of a log, and what it answers: options, estimates and the model."""

from __future__ import annotations

from dataclasses import dataclass, field

from benchmarks.identify.armax import Array, Orders

CONFIDENCE = 0.95  # of all intervals


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
