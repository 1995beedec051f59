"""Define what an identification returns: the model and its estimates."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

from benchmarks.identify.armax import Array, Flags, Orders
from benchmarks.identify.log import Log
from benchmarks.loop.linear import LinearModel


class CannotTellError(ValueError):
    """No usable plant can be identified from the log; the message says why."""


class Interval(NamedTuple):
    """An estimate with its 95 % interval."""

    value: float
    low: float
    high: float


class Fault(NamedTuple):
    """A fault of a valve, as far as a log shows it."""

    what: str
    """Description, with its size."""
    advice: str
    """What to do."""
    passed: Array
    """The flow that such a valve passes, from the operating point."""


class HeldOut(NamedTuple):
    """Shares of variance in the last part of a log, explained by models fitted to the rest.

    The models simulate the temperature: they are given the flow and the known disturbances, but
    no temperature. A straight line is removed from their errors to account for the slow
    disturbance, which no flow explains.
    """

    model: float
    impulse_response: float


@dataclass(frozen=True)
class Model:
    """A plant identified from a log, in deviations from the operating point as in (28)."""

    plant: LinearModel
    """The most likely A, B, C and delay."""
    noise: dict[str, float]
    """`noise_variance`, `measurement_noise_variance` and `disturbance_walk_variance` of the
    environment, degC^2."""
    known: dict[str, LinearModel]
    """Model of the response to each known disturbance, by its column of the log."""
    estimates: dict[str, Interval]
    """`delay` (samples), `dead_zone` (t/h), `gain` (degC per t/h), `time_constant` (s, of the
    slowest pole) and `noise_variance` (degC^2, of the prediction errors)."""
    possible: list[LinearModel]
    """Stable plants drawn from the posterior."""
    u_min: float
    u_max: float
    """t/h."""
    operating_flow: float
    operating_temperature: float
    """t/h and degC, where u and y are 0."""
    orders: Orders
    errors: Array
    """Prediction errors xi, degC, one per row of the log, NaN where unknown."""
    held_out: HeldOut
    held_out_rows: Flags
    """The rows of the log on which models fitted to the rows before them are judged."""
    log: Log
    """The cleaned log that was fitted."""
    simulated: Array
    """Temperature simulated from the flow and the known disturbances alone, degC."""
    fault: Fault | None = None
    """The fault of the valve that explains the log; the flow of `log` is what it passes."""
    notes: list[str] = field(default_factory=list)
    """Remarks for the user about the log and the fit."""
    warnings: list[str] = field(default_factory=list)
    """Why no controller should be tuned on the model; empty if it may be used."""
