"""Record findings about the paper's claims, and derive the verdicts."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from benchmarks.claims.runs import Batch
from benchmarks.lib.statistics import Estimate, exact, median, quantile, share

OFTEN = 0.9  # "works", "converges": in at least this share of the draws


@dataclass(frozen=True)
class Claim:
    """A claim of the paper, its examination and the findings."""

    name: str
    """Short name, for options."""
    section: str
    """Place in the paper."""
    statement: str
    method: str
    """Description of the test."""
    examine: Callable[[Batch, Claim], None]
    """Performs the runs, and records the findings with `ask`."""
    findings: list[dict[str, Any]] = field(default_factory=list)
    """Rows of the table of numbers."""
    tables: dict[str, pd.DataFrame] = field(default_factory=dict)
    """Tables to draw, by name."""

    def examined(self, batch: Batch) -> Claim:
        """Return the claim with its findings."""
        claim = replace(self, findings=[], tables={})
        self.examine(batch, claim)
        return claim

    @property
    def verdict(self) -> str:
        """The verdict in words; an undecided finding counts as not shown."""
        shown = [row["shown"] == "yes" for row in self.findings if row["shown"]]
        if not shown:
            return "cannot be tested from the text"
        if all(shown):
            return "holds"
        return "holds in part" if any(shown) else "does not hold"

    def ask(
        self,
        quantity: str,
        found: Estimate | ArrayLike,
        unit: str = "",
        *,
        at_least: float = -math.inf,
        at_most: float = math.inf,
    ) -> None:
        """Record a number: an estimate, the median of one value per run, or an exact value.

        A bound makes the number part of the verdict. It is shown if the whole interval keeps
        the bound, and not shown if no part of the interval does.
        """
        if not isinstance(found, Estimate):
            found = median(found) if np.ndim(found) else exact(float(np.asarray(found)))
        bounds = {"at least": at_least, "at most": at_most}
        asked = [f"{name} {bound:g}" for name, bound in bounds.items() if math.isfinite(bound)]
        if not asked:
            shown = ""
        elif at_least <= found.low and found.high <= at_most:
            shown = "yes"
        else:
            out = found.high < at_least or found.low > at_most
            shown = "no" if out else "undecided"
        criterion = {"criterion": " and ".join(asked), "shown": shown}
        self.findings.append({"quantity": quantity, "unit": unit, **vars(found), **criterion})

    def ask_share(
        self, quantity: str, found: NDArray[np.bool_], *, often: bool = False
    ) -> None:
        """Record the share of draws in which `found` is true; `often` requires `OFTEN`."""
        of = share(found)
        in_percent = Estimate(100 * of.value, 100 * of.low, 100 * of.high, of.runs)
        at_least = 100 * OFTEN if often else -math.inf
        self.ask(quantity, in_percent, "% of draws", at_least=at_least)

    def ask_time(self, quantity: str, samples: ArrayLike) -> None:
        """Record the 10th, 50th and 90th percentiles of a time; infinite means never."""
        for p in (0.1, 0.5, 0.9):
            self.ask(f"{quantity}, {p:.0%} of draws", quantile(samples, p), "samples")


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
    rows = [(claim.statement, claim.verdict) for claim in claims]
    return pd.DataFrame(rows, columns=["claim", "verdict"])


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
