"""Test claims as the options say, and write the verdicts."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

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
    out = out_folder(options.out)
    batch = Batch(options.runs, SEED)
    first = sorted(chosen, key=lambda name: name != LONGEST)
    tasks = {name: partial(examined, CLAIMS[name], batch) for name in first}
    done: dict[str, verdicts.Claim] = {}
    try:
        for name, results in options.fan_out.open().stream(tasks, "claims"):
            done[name] = replace(CLAIMS[name], findings=results.findings)
            claims = [done[each] for each in chosen if each in done]
            write_csv(out / "claims.csv", verdicts.table(claims))
            write_text(out / "claims.md", verdicts.markdown(claims, made))
            for picture, table in results.tables.items():
                write_csv(out / f"{picture}.csv", table)
                PLOTS[picture](table, out / f"{picture}.png")
    finally:
        if done:
            console.print(on_screen(verdicts.overview(claims)))
    return f"All numbers are in {out}/claims.md and claims.csv"


def examined(claim: verdicts.Claim, batch: Batch) -> verdicts.Results:
    """Return what comes out when a claim is examined."""
    results = verdicts.Results()
    claim.examine(batch, results)
    return results
