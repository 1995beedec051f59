"""Claims, what was found about each, and the verdict that follows."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from benchmarks.lib.statistics import Estimate, quantile, share

if TYPE_CHECKING:
    from benchmarks.claims.runs import Batch

OFTEN = 0.9  # "works", "converges": in at least this share of the draws


class Verdict(str, Enum):
    """What became of a claim."""

    HOLDS = "holds"
    IN_PART = "holds in part"
    FAILS = "does not hold"
    UNTESTABLE = "cannot be tested from the text"


@dataclass(frozen=True)
class Finding:
    """One number, and what a claim asks of it."""

    quantity: str
    estimate: Estimate
    unit: str = ""
    at_least: float = -math.inf
    at_most: float = math.inf
    """Bounds that the number must keep. Without one it is there to be read, and has no part in
    the verdict."""

    @property
    def criterion(self) -> str:
        """What is asked, in words; empty if nothing is."""
        bounds = {"at least": self.at_least, "at most": self.at_most}
        asked = [f"{name} {bound:g}" for name, bound in bounds.items() if math.isfinite(bound)]
        return " and ".join(asked)

    @property
    def shown(self) -> str:
        """Whether it keeps the criterion: "yes", "no", "undecided"; empty if nothing is asked.

        It does if the whole interval does, and does not if no part of the interval does.
        """
        low, high = self.estimate.low, self.estimate.high
        if not self.criterion:
            return ""
        if self.at_least <= low and high <= self.at_most:
            return "yes"
        return "no" if high < self.at_least or low > self.at_most else "undecided"


@dataclass
class Results:
    """What an examination found: numbers to judge by, and tables to draw and keep."""

    findings: list[Finding] = field(default_factory=list)
    tables: dict[str, pd.DataFrame] = field(default_factory=dict)

    def ask(
        self,
        quantity: str,
        estimate: Estimate,
        unit: str = "",
        *,
        at_least: float = -math.inf,
        at_most: float = math.inf,
    ) -> None:
        """Note a number; `at_least` or `at_most` make it part of the verdict."""
        self.findings.append(Finding(quantity, estimate, unit, at_least, at_most))

    def ask_share(
        self, quantity: str, found: NDArray[np.bool_] | Estimate, *, often: bool = False
    ) -> None:
        """Note in which share of the draws something is found; `often` asks for `OFTEN`."""
        of = found if isinstance(found, Estimate) else share(found)
        in_percent = Estimate(100 * of.value, 100 * of.low, 100 * of.high, of.runs)
        at_least = 100 * OFTEN if often else -math.inf
        self.ask(quantity, in_percent, "% of draws", at_least=at_least)

    def ask_time(self, quantity: str, samples: NDArray[np.float64]) -> None:
        """Note when something happens, in 10, 50 and 90 % of the draws; infinite for never."""
        for p in (0.1, 0.5, 0.9):
            self.ask(f"{quantity}, {p:.0%} of draws", quantile(samples, p), "samples")


def verdict(findings: Iterable[Finding]) -> Verdict:
    """Judge a claim by what was found.

    It holds if all that was asked is shown, in part if some of it is, and not at all if nothing
    is; what is undecided is not shown. A claim that asks for nothing cannot be tested.
    """
    shown = [finding.shown == "yes" for finding in findings if finding.shown]
    if not shown:
        return Verdict.UNTESTABLE
    if all(shown):
        return Verdict.HOLDS
    return Verdict.IN_PART if any(shown) else Verdict.FAILS


@dataclass(frozen=True)
class Claim:
    """A claim of the paper, how it is examined, and what came out."""

    name: str
    """Short, for options."""
    section: str
    """Where the paper makes it."""
    statement: str
    method: str
    """How it is tested."""
    examine: Callable[[Batch, Results], object]
    """Runs what must be run."""
    findings: Sequence[Finding] = ()
    """What came out, once it has been examined."""

    @property
    def verdict(self) -> Verdict:
        """What became of it."""
        return verdict(self.findings)


def table(claims: Sequence[Claim]) -> pd.DataFrame:
    """Return one row for each finding, and one for a claim without any."""
    rows: list[dict[str, object]] = []
    for claim in claims:
        about: dict[str, object] = {
            "claim": claim.name,
            "section": claim.section,
            "statement": claim.statement,
            "verdict": claim.verdict.value,
        }
        rows += [
            about
            | {"quantity": finding.quantity, "unit": finding.unit, **vars(finding.estimate)}
            | {"criterion": finding.criterion, "shown": finding.shown}
            for finding in claim.findings
        ] or [about]
    frame = pd.DataFrame(rows)
    # Whole numbers, though a claim without findings has none.
    return frame.astype({"runs": "Int64"}) if "runs" in frame else frame


def overview(claims: Sequence[Claim]) -> pd.DataFrame:
    """Return the verdicts: one row for each claim."""
    rows = [(claim.statement, claim.verdict.value) for claim in claims]
    return pd.DataFrame(rows, columns=["claim", "verdict"])


def write_number(value: float) -> str:
    """Write a number as people read it: three digits, or 'never'."""
    if math.isinf(value):
        return "never" if value > 0 else "?"
    digits = 0 if abs(value) >= 100 else 1 if abs(value) >= 10 else 3
    return f"{value:,.{digits}f}"


def markdown(claims: Sequence[Claim], made: str) -> str:
    """Return all verdicts as a Markdown page, with a line on how they were made."""
    parts = [
        "# The paper's claims",
        made,
        "Every number rests on independent draws of initial weights and "
        "noise. What a claim asks of a number counts as shown if the whole 95 % interval "
        "keeps it. A claim holds if all that it asks is shown, and in part if some is.",
        overview(claims).to_markdown(index=False),
    ]
    for claim in claims:
        parts.append(f"## {claim.statement}: {claim.verdict.value}")
        parts.append(f"{claim.section}. {claim.method}")
        if claim.findings:
            rows = pd.DataFrame(map(_row, claim.findings))
            parts.append(rows.to_markdown(index=False, disable_numparse=True))
    return "\n\n".join([*parts, ""])


def _row(finding: Finding) -> dict[str, str]:
    value, low, high, runs = vars(finding.estimate).values()
    return {
        "measured": finding.quantity + (f" ({finding.unit})" if finding.unit else ""),
        "value": write_number(value),
        "95 % interval": (
            "exact" if runs == 1 else f"{write_number(low)} to {write_number(high)}"
        ),
        "asked": finding.criterion,
        "shown": f"**{finding.shown}**" if finding.shown == "no" else finding.shown,
    }
