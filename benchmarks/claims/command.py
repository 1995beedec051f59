"""Test claims as the options say, and write the verdicts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import pandas as pd
from rich.console import Console

from benchmarks.claims import verdicts
from benchmarks.claims.claims import CLAIMS
from benchmarks.claims.options import Options
from benchmarks.claims.plots import PLOTS
from benchmarks.claims.runs import Batch
from benchmarks.lib.command_line import known, out_folder
from benchmarks.lib.report import provenance_line
from benchmarks.lib.storage import origin, write_text
from benchmarks.lib.tables import on_screen, write_csv

LONGEST = "direction-only"  # to examine: it begins first
SEED = 0  # run i starts from the weights, and meets the noise, of seed SEED + i


def execute(options: Options, console: Console) -> str:
    """Examine the claims and write the verdicts."""
    chosen = known("CLAIM", options.claims or list(CLAIMS), list(CLAIMS))
    made = provenance_line("claims", origin())
    out_folder(options.out)
    batch = Batch(options.runs, SEED)
    first = sorted(chosen, key=lambda name: name != LONGEST)
    tasks = {name: partial(CLAIMS[name].examine, batch) for name in first}
    examined: dict[str, verdicts.Claim] = {}
    claims: list[verdicts.Claim] = []
    try:
        for name, results in options.fan_out.open().stream(tasks, "claims"):
            examined[name] = replace(CLAIMS[name], findings=results.findings)
            claims = [examined[n] for n in chosen if n in examined]
            write(options.out, claims, results.tables, made)
    finally:
        if claims:
            overview = verdicts.overview(claims)
            console.print(on_screen(overview[["claim", "verdict"]]))
    return f"All numbers are in {options.out}/claims.md and claims.csv"


def write(
    out: Path, claims: Sequence[verdicts.Claim], tables: dict[str, pd.DataFrame], made: str
) -> None:
    """Write the verdicts so far, and the tables and pictures of the latest claim."""
    write_csv(out / "claims.csv", verdicts.table(claims))
    write_text(out / "claims.md", verdicts.markdown(claims, made))
    for name, table in tables.items():
        write_csv(out / f"{name}.csv", table)
        PLOTS[name](table, out / f"{name}.png")
