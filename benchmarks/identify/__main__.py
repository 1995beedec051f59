"""Identify a plant from a log and tune a PI for it: `python -m benchmarks.identify --help`."""

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from benchmarks.lib.command import Finite, Folder, command, options
from benchmarks.lib.errors import UsageError
from benchmarks.lib.provenance import origin
from benchmarks.lib.storage import out_folder, write_json

# NumPy reads it when it is imported. Threads for small matrices only wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


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
    time: str = "time"
    """Column of the times, numbers or dates."""
    flow: str = "flow"
    """Column of the flow."""
    temperature: str = "temperature"
    """Column of the temperature."""
    disturbance: tuple[str, ...] = ()
    """Column of a measured disturbance (repeatable)."""
    time_unit: Literal["ms", "s", "min", "h", "D"] = "s"
    """Unit of the times, unless these are dates; D are days."""
    flow_unit: str = "t/h"
    """Unit of the flow, for the report."""
    temperature_unit: str = "°C"
    """Unit of the temperature, for the report."""
    applied: bool = False
    """The flow was measured behind the valve, so that nothing is asked about the valve."""
    operating_flow: Finite | None = None
    """Flow at the operating point, around which a dead zone lies (default: 0 or the first flow
    if it is well inside the range of the flows, else the middle of the range)."""
    u_min: Finite | None = None
    """Smallest flow, from the operating point (default: the log's)."""
    u_max: Finite | None = None
    """Largest flow, from the operating point (default: the log's)."""


def work(options: Options) -> str:
    """Identify a plant from a log and write the results."""
    from benchmarks.identify import advice, log, model, report  # slow to import
    from benchmarks.lib.report import write_report

    made, out = origin(), out_folder(options.out)
    try:
        found = model.identify(log.read_log(options))
        plant, ranges = advice.plants(found)
    except ValueError as error:
        raise UsageError(str(error)) from error
    advised = advice.controllers(found)
    report.draw(found, out / "identify.png")
    for name, content in {"plant": plant, "ranges": ranges, "controllers": advised}.items():
        write_json(out / f"{name}.json", content)
    sections = report.report(found, advised)
    write_report(out, f"The plant of {options.log.name}", sections, made)
    return f"The plant and the report are in {out}/"


main = command("identify", Options, work)

if __name__ == "__main__":
    raise SystemExit(main(None))
