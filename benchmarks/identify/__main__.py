"""From a log to a plant and its controllers: `python -m benchmarks.identify --help`."""

from __future__ import annotations

import argparse
import sys
import time
from datetime import datetime, timezone
from pathlib import Path

from rich.console import Console

from benchmarks.identify.armax import Orders
from benchmarks.identify.fit import identify
from benchmarks.identify.log import (
    FLOW_UNITS,
    MOST_ROWS,
    TEMPERATURE_UNITS,
    TIME_UNITS,
    Columns,
    read_log,
)
from benchmarks.identify.model import Options
from benchmarks.identify.plant import plant_arguments, plant_ranges
from benchmarks.identify.report import report
from benchmarks.lib import command_line
from benchmarks.lib.command_line import UsageError
from benchmarks.lib.report import provenance_line, write_report
from benchmarks.lib.storage import commit, versions, write_json
from benchmarks.lib.tables import on_screen


def _add_options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    columns, options = Columns(), Options()
    add(
        "log",
        type=Path,
        metavar="LOG.csv",
        help="table with a heading; a row holds the temperature at its time and the flow that "
        "is commanded from that time on",
    )
    command_line.add_out(parser, "results/identify")
    add(
        "--time",
        default=columns.time,
        metavar="COLUMN",
        help="column of the times: numbers, or dates as ISO 8601",
    )
    add("--flow", default=columns.flow, metavar="COLUMN", help="column of the flow")
    add(
        "--temperature",
        default=columns.temperature,
        metavar="COLUMN",
        help="column of the temperature",
    )
    add(
        "--disturbance",
        action="append",
        default=[],
        metavar="COLUMN",
        help="column of a measured disturbance: it may be given more than once",
    )
    add(
        "--sampling-interval",
        type=command_line.positive,
        metavar="S",
        help="s from one row to the next; the column of the times is not read then",
    )
    for what, units, default in (
        ("time", TIME_UNITS, "s"),
        ("flow", FLOW_UNITS, "t/h"),
        ("temperature", TEMPERATURE_UNITS, "degC"),
    ):
        add(
            f"--{what}-unit",
            choices=units,
            metavar="UNIT",
            help=f"unit of the {what}: {', '.join(units)} (default: what the heading has in "
            f"brackets, else {default})".replace("%", "%%"),
        )
    add(
        "--rows",
        type=command_line.number,
        default=MOST_ROWS,
        metavar="N",
        help="of a longer log, the last N rows are fitted",
    )
    add(
        "--longest-delay",
        type=command_line.number,
        default=options.longest_delay,
        metavar="SAMPLES",
        help="longest delay to look for",
    )
    add(
        "--orders",
        type=command_line.seed,
        nargs=3,
        metavar=("A", "B", "C"),
        help="how many coefficients the polynomials A, B and C have, without the leading 1 of "
        "A and C (default: chosen by a criterion)",
    )
    add(
        "--applied",
        action="store_true",
        help="the flow was measured behind the actuator, so that no dead zone is looked for",
    )
    for option, extreme in (("--u-min", "least"), ("--u-max", "largest")):
        add(
            option,
            type=command_line.finite,
            metavar="FLOW",
            help=f"{extreme} flow that the actuator can apply, t/h from the operating point "
            f"(default: the log's {extreme})",
        )
    add(
        "--operating-flow",
        type=command_line.finite,
        metavar="FLOW",
        help="flow of the operating point, t/h (default: 0 if the log has flows of both signs, "
        "else its first flow)",
    )


@command_line.command(
    "identify",
    "Fit the plant's equations to a recorded log, and tune controllers for it.",
    _add_options,
    interrupted="nothing is written.",
)
def main(options: argparse.Namespace, console: Console) -> str:
    """Identify a plant and write what was found."""
    started = datetime.now(timezone.utc).isoformat(timespec="seconds")
    began = time.process_time()
    out = command_line.out_folder(options.out)
    if options.orders and min(options.orders[:2]) < 1:
        raise UsageError(
            f"--orders: A and B must have at least 1 coefficient, got {options.orders[:2]}"
        )
    columns = Columns(
        options.time, options.flow, options.temperature, options.sampling_interval,
        options.time_unit, options.flow_unit, options.temperature_unit,
        tuple(options.disturbance),
    )  # fmt: skip
    try:
        log = read_log(options.log, columns, options.rows)
        model = identify(
            log,
            Options(
                longest_delay=options.longest_delay,
                orders=Orders(*options.orders) if options.orders else None,
                find_dead_zone=not options.applied,
                u_min=options.u_min,
                u_max=options.u_max,
                operating_flow=options.operating_flow,
            ),
        )
        plant, ranges = plant_arguments(model), plant_ranges(model)
        sections = report(log, model, out)
    except ValueError as error:
        raise UsageError(str(error)) from error
    write_json(out / "plant.json", plant)
    write_json(out / "ranges.json", ranges)
    origin = {"started": started, "commit": commit(), "versions": versions()}
    write_report(out, f"The plant of {options.log.name}", sections,
                 provenance_line("identify", origin))  # fmt: skip
    for section in sections:
        console.print(section.title, *section.text, sep="\n")
        if section.table is not None:
            console.print(on_screen(section.table))
    seconds = time.process_time() - began
    return (
        f"{seconds:.1f} s of processor time. The plant, the ranges and the report are in {out}/"
    )


if __name__ == "__main__":
    sys.exit(main(None))
