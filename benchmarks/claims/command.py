"""Test the chosen claims, and write the verdicts."""

from __future__ import annotations

from functools import partial

from rich.console import Console

from benchmarks.claims.__main__ import Options
from benchmarks.claims.claims import CLAIMS
from benchmarks.claims.plots import PLOTS
from benchmarks.claims.runs import Batch
from benchmarks.claims.verdicts import Claim, markdown, overview, table
from benchmarks.lib.command import known, out_folder
from benchmarks.lib.report import provenance_line
from benchmarks.lib.storage import origin, write_text
from benchmarks.lib.tables import on_screen, write_csv


def execute(options: Options, console: Console) -> str:
    """Examine the claims and write the verdicts."""
    chosen = known("CLAIM", options.claims or list(CLAIMS), list(CLAIMS))
    made = provenance_line("claims", origin())
    out = out_folder(options.out)
    # The last claims take longest, and start first.
    tasks = {
        name: partial(CLAIMS[name].examined, Batch(options.runs)) for name in reversed(chosen)
    }
    done: dict[str, Claim] = {}
    try:
        for name, claim in options.fan_out.stream(tasks, "claims"):
            done[name] = claim
            claims = [done[each] for each in chosen if each in done]
            write_csv(out / "claims.csv", table(claims))
            write_text(out / "claims.md", markdown(claims, made))
            for picture, drawn in claim.tables.items():
                write_csv(out / f"{picture}.csv", drawn)
                PLOTS[picture](drawn, out / f"{picture}.png")
    finally:
        if done:
            console.print(on_screen(overview(claims)))
    return f"All numbers are in {out}/claims.md and claims.csv"
