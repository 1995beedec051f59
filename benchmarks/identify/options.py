"""Declare the options of `python -m benchmarks.identify`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from benchmarks.lib.options import (
    Count,
    Finite,
    Folder,
    Orders,
    Positive,
    Repeated,
    choice,
    options,
)

# Conversion to the units of the plant, s, t/h and degC: factor, then offset, by quantity and
# unit. The default unit comes first.
UNITS: dict[str, dict[str, tuple[float, float]]] = {
    "time": {"s": (1.0, 0.0), "ms": (1e-3, 0.0), "min": (60.0, 0.0), "h": (3600.0, 0.0)},
    "flow": {"t/h": (1.0, 0.0), "kg/s": (3.6, 0.0), "kg/h": (1e-3, 0.0), "%": (1.0, 0.0)},
    "temperature": {
        **dict.fromkeys(("degC", "°C", "C"), (1.0, 0.0)),
        "K": (1.0, -273.15),
        **dict.fromkeys(("degF", "°F", "F"), (5 / 9, -160 / 9)),
    },
}


def _unit(quantity: str) -> Parameter:
    names = list(UNITS[quantity])
    return choice(
        names, f"Unit of the {quantity} (default: that in the heading, else {names[0]})"
    )


@options
@dataclass(frozen=True, kw_only=True)
class Columns:
    """The columns of a log and their units."""

    time: str = "time"
    """Column of the times, numbers or dates."""
    flow: str = "flow"
    """Column of the flow."""
    temperature: str = "temperature"
    """Column of the temperature."""
    disturbance: Repeated = ()
    """Column of a measured disturbance (repeatable)."""
    sampling_interval: Positive | None = None
    """Time from one row to the next, s; the column of the times is then not read."""
    time_unit: Annotated[str | None, _unit("time")] = None
    flow_unit: Annotated[str | None, _unit("flow")] = None
    temperature_unit: Annotated[str | None, _unit("temperature")] = None


@options
@dataclass(frozen=True, kw_only=True)
class Knowledge:
    """Prior knowledge of the plant, and what to look for."""

    longest_delay: Count = 60
    """Longest delay to look for, samples."""
    applied: bool = False
    """The flow was measured after the actuator, so no dead zone is looked for."""
    u_min: Finite | None = None
    """Smallest flow that the actuator can apply, t/h from the operating point (default: the
    log's smallest)."""
    u_max: Finite | None = None
    """Largest flow that the actuator can apply, t/h from the operating point (default: the
    log's largest)."""
    operating_flow: Finite | None = None
    """Flow at the operating point, t/h (default: 0 if the log has flows of both signs, else its
    first flow)."""
    orders: Orders | None = None
    """Number of coefficients of the polynomials A, B and C, without the leading 1 of A and C
    (default: chosen by a criterion)."""


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Fit the plant's equations to a recorded log, and tune controllers for it.

    The log is a table with a heading; each row holds the temperature at its time and the flow
    commanded from that time on.
    """

    log: Path = field(kw_only=False)
    """The log, a CSV file."""
    out: Folder = Path("results/identify")
    columns: Columns = field(default_factory=Columns)
    rows: Count = 20_000
    """Largest number of rows to fit; of a longer log, the last ones are used."""
    knowledge: Knowledge = field(default_factory=Knowledge)
