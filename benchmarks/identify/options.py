"""Declare the options of `python -m benchmarks.identify`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from benchmarks.lib.command import Finite, Folder, Repeated, options


@options
@dataclass(frozen=True, kw_only=True)
class Columns:
    """The columns of a log, and their units."""

    time: str = "time"
    """Column of the times, numbers or dates."""
    flow: str = "flow"
    """Column of the flow."""
    temperature: str = "temperature"
    """Column of the temperature."""
    disturbance: Repeated = ()
    """Column of a measured disturbance (repeatable)."""
    time_unit: Literal["ms", "s", "min", "h", "D"] = "s"
    """Unit of the times, unless these are dates; D are days."""
    flow_unit: str = "t/h"
    """Unit of the flow, for the report."""
    temperature_unit: str = "°C"
    """Unit of the temperature, for the report."""


@options
@dataclass(frozen=True, kw_only=True)
class Knowledge:
    """Prior knowledge of the plant and its valve."""

    applied: bool = False
    """The flow was measured behind the valve, so that nothing is asked about the valve."""
    operating_flow: Finite | None = None
    """Flow at the operating point, around which a dead zone lies (default: 0 or the first flow
    if it is well inside the range of the flows, else the middle of the range)."""
    u_min: Finite | None = None
    """Smallest flow, from the operating point (default: the log's)."""
    u_max: Finite | None = None
    """Largest flow, from the operating point (default: the log's)."""


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Fit a plant to a recorded log, and tune a PI controller for it.

    The log is a table with a heading; each row holds the temperature at its time and the flow
    commanded from that time on.
    """

    log: Path = field(kw_only=False)
    """The log, a CSV file."""
    out: Folder = Path("results/identify")
    smith: bool = False
    """Tune a Smith predictor, too. Its delay margin must be a fifth of the delay."""
    columns: Columns = field(default_factory=Columns)
    knowledge: Knowledge = field(default_factory=Knowledge)
