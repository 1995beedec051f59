"""Test the chosen claims, and write the verdicts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import pandas as pd
from rich.console import Console

from benchmarks.claims.__main__ import Options
from benchmarks.claims.claims import CLAIMS
from benchmarks.claims.plots import PLOTS
from benchmarks.claims.runs import Batch, Claim
from benchmarks.lib.command import known, out_folder
from benchmarks.lib.report import provenance_line
from benchmarks.lib.storage import origin, write_text
from benchmarks.lib.tables import ScreenTable, write_csv


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
            console.print(ScreenTable(overview(claims)))
    return f"All numbers are in {out}/claims.md and claims.csv"


def table(claims: Sequence[Claim]) -> pd.DataFrame:
    """Return one row for each finding, and one for each claim without findings."""
    rows: list[dict[str, Any]] = []
    for claim in claims:
        about = {name: getattr(claim, name) for name in ("section", "statement", "verdict")}
        about = {"claim": claim.name, **about}
        rows += [{**about, **finding} for finding in claim.findings] or [about]
    frame = pd.DataFrame(rows)
    # Nullable integers, as a claim without findings has no runs.
    return frame.astype({"runs": "Int64"}) if "runs" in frame else frame


def overview(claims: Sequence[Claim]) -> pd.DataFrame:
    """Return the verdicts, one row for each claim."""
    return pd.DataFrame([{"claim": each.statement, "verdict": each.verdict} for each in claims])


def markdown(claims: Sequence[Claim], made: str) -> str:
    """Return all verdicts as a Markdown page, with the line `made` on their provenance."""
    parts = [
        "# The paper's claims",
        made,
        "Every number rests on independent draws of initial weights and "
        "noise. What a claim asks of a number counts as shown if the whole 95 % interval "
        "keeps it. A claim holds if all that it asks is shown, and in part if some is.",
        overview(claims).to_markdown(index=False),
    ]
    for claim in claims:
        parts.append(f"## {claim.statement}: {claim.verdict}")
        parts.append(f"{claim.section}. {claim.method}")
        if claim.findings:
            rows = pd.DataFrame([_row(**finding) for finding in claim.findings])
            parts.append(rows.to_markdown(index=False, disable_numparse=True))
    return "\n\n".join([*parts, ""])


def _row(
    quantity: str, unit: str, runs: int, criterion: str, shown: str, **numbers: float
) -> dict[str, str]:
    value, low, high = (_three_digits(numbers[name]) for name in ("value", "low", "high"))
    return {
        "measured": quantity + (f" ({unit})" if unit else ""),
        "value": value,
        "95 % interval": "exact" if runs == 1 else f"{low} to {high}",
        "asked": criterion,
        "shown": f"**{shown}**" if shown == "no" else shown,
    }


def _three_digits(value: float) -> str:
    if math.isinf(value):
        return "never" if value > 0 else "?"
    digits = 0 if abs(value) >= 100 else 1 if abs(value) >= 10 else 3
    return f"{value:,.{digits}f}"
