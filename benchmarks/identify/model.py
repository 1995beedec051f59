"""What a log answers: estimates and the model."""

from __future__ import annotations

from dataclasses import dataclass
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
    """A plant that a log has shown, in deviations from the operating point as in (28)."""

    plant: LinearModel
    """The likeliest A, B, C and delay."""
    noise: dict[str, float]
    """`noise_variance`, `measurement_noise_variance` and `disturbance_walk_variance` of the
    environment, degC^2."""
    known: dict[str, LinearModel]
    """What each known disturbance does, by its column of the log."""
    estimates: dict[str, Interval]
    """`delay` (samples), `dead_zone` (t/h), `gain` (degC per t/h), `time_constant` (s, of the
    slowest pole), `noise_variance` (degC^2, of the prediction errors), and the coefficients
    `a1`, `b1` and so on."""
    possible: list[LinearModel]
    """Plants drawn from what the log leaves open."""
    u_min: float
    u_max: float
    """t/h."""
    operating_flow: float
    operating_temperature: float
    """t/h and degC: where u and y are 0."""
    orders: Orders
    errors: Array
    """The prediction errors xi, one a row of the log, NaN where they are not known, degC."""
    held_out: HeldOut
    log: Log
    """What was fitted: the log, mended."""
    simulated: Array
    """What the model makes of flow and known disturbances alone, degC."""
    notes: list[str]
    """What the user should know about the fit."""
