"""What a log answers: estimates and the model."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

from benchmarks.identify.armax import Array, Orders
from benchmarks.identify.log import Log
from benchmarks.loop.linear import LinearModel


class CannotTellError(ValueError):
    """The log does not hold what is asked of it; the message says why."""


class Interval(NamedTuple):
    """An estimate with its 95 % interval."""

    value: float
    low: float
    high: float


class HeldOut(NamedTuple):
    """How much of the last third of a log models explain that were fitted to the rest.

    Shares of the temperature's variance, in simulation: the models are given the flow and the
    known disturbances, but no temperature. A straight line is taken from their errors, for the
    slow disturbance that no flow explains.
    """

    model: float
    impulse_response: float


@dataclass(frozen=True)
class Model:
    """A plant that a log has shown. Deviations from the operating point, as in (28) and (29).

    Attributes
    ----------
    plant
        The likeliest A, B, C and delay.
    noise
        `noise_variance`, `measurement_noise_variance` and `disturbance_walk_variance` of the
        environment, degC^2.
    known
        What each known disturbance does, by its column of the log.
    estimates
        With their intervals: `delay` (samples), `dead_zone` (t/h), `gain` (degC per t/h),
        `time_constant` (s, of the slowest pole), `noise_variance` (degC^2, of the prediction
        errors), and the coefficients `a1`, `b1` and so on.
    possible
        Plants drawn from what the log leaves open.
    u_min, u_max
        Limits of the flow, t/h.
    operating_flow, operating_temperature
        t/h and degC: where u and y are 0.
    orders
        Of A, B and C.
    errors
        The prediction errors xi, one a row of the log, NaN where they are not known, degC.
    held_out
        How good simulations are.
    log
        What was fitted: the log, mended.
    simulated
        What the model makes of flow and known disturbances alone, degC.
    notes
        What the user should know about the fit.
    """

    plant: LinearModel
    noise: dict[str, float]
    known: dict[str, LinearModel]
    estimates: dict[str, Interval]
    possible: list[LinearModel]
    u_min: float
    u_max: float
    operating_flow: float
    operating_temperature: float
    orders: Orders
    errors: Array
    held_out: HeldOut
    log: Log
    simulated: Array
    notes: list[str] = field(default_factory=list)
