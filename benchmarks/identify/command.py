"""Identify a plant from a log, and write the plant, its ranges and a report."""

from __future__ import annotations

import time

from rich.console import Console

from benchmarks.identify.__main__ import Options
from benchmarks.identify.fit import identify
from benchmarks.identify.log import read_log
from benchmarks.identify.plant import plant_arguments, plant_ranges
from benchmarks.identify.report import recommendations, report
from benchmarks.identify.tuning import recommended
from benchmarks.lib.command import UsageError, out_folder
from benchmarks.lib.report import provenance_line, show, write_report
from benchmarks.lib.storage import origin, write_json


def execute(options: Options, console: Console) -> str:
    """Identify a plant from a log and write the results."""
    made = origin()
    began = time.process_time()
    out = out_folder(options.out)
    try:
        log = read_log(options.log, options.columns, options.rows)
        model = identify(log, options.knowledge)
        plant, ranges = plant_arguments(model), plant_ranges(model)
        found = recommended(model)
        if not found and not model.warnings:
            model.warnings.append(
                "However slow a controller is made, Ms is above 2 with one in twenty of the "
                "plants that the log leaves possible. Record a longer log, with larger steps."
            )
        sections = report(model, found, out)
    except ValueError as error:
        raise UsageError(str(error)) from error
    write_json(out / "plant.json", plant)
    write_json(out / "ranges.json", ranges)
    write_json(out / "controllers.json", recommendations(model, found))
    write_report(out, f"The plant of {options.log.name}", sections,
                 provenance_line("identify", made))  # fmt: skip
    show(sections, console)
    seconds = time.process_time() - began
    return (
        f"{seconds:.1f} s of processor time. The plant, the ranges and the report are in {out}/"
    )
