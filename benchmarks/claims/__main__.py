"""Test the paper's claims: `python -m benchmarks.claims --help`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.lib.command import FanOut, Folder, Names, Runs, command, known, options
from benchmarks.lib.storage import origin, out_folder, write_csv

if TYPE_CHECKING:
    import pandas as pd

    from benchmarks.lib.report import Section

NOTE = (
    "Every number rests on independent draws of initial weights and noise. What a claim asks "
    "of a number counts as shown if the whole 95 % interval keeps it. A claim holds if all "
    "that it asks is shown, and in part if some is."
)


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Test the paper's claims, each on a thousand runs.

    The verdicts go to report.md, all numbers to claims.csv.
    """

    claims: Names = field(default=(), kw_only=False)
    """Claims to test (default: all)."""
    runs: Runs = 1000
    """Runs of each case."""
    fan_out: FanOut = field(default_factory=FanOut)
    out: Folder = Path("results/claims")


def work(options: Options) -> str:
    """Examine the claims and write the verdicts, also where some examinations have failed."""
    from benchmarks.claims.claims import CLAIMS, examined
    from benchmarks.claims.runs import Batch
    from benchmarks.lib.report import write_report

    chosen = known("CLAIM", options.claims or list(CLAIMS), list(CLAIMS))
    made, out = origin(), out_folder(options.out)
    # The last claims take longest, and start first.
    tasks = {name: partial(examined, name, Batch(options.runs)) for name in reversed(chosen)}
    found: dict[str, Any] = {}
    try:
        found.update(options.fan_out.stream(tasks, "claims"))
    finally:
        if found:
            numbers = table({name: found[name] for name in chosen if name in found})
            write_csv(out / "claims.csv", numbers)
            write_report(out, "The paper's claims", sections(numbers), "claims", made, 1)
    return f"All numbers are in {out}/report.md and claims.csv"


def table(found: Mapping[str, Sequence[Any]]) -> pd.DataFrame:
    """Return one row for each finding about a claim, and one for a claim without findings."""
    import pandas as pd

    from benchmarks.claims.claims import CLAIMS
    from benchmarks.claims.runs import verdict

    rows = []
    for name, findings in found.items():
        claim, judged = CLAIMS[name], verdict(findings)
        about = {"claim": name, "section": claim.section, "statement": claim.statement}
        rows += [{**about, "verdict": judged, **each} for each in findings or [{"runs": None}]]
    # Nullable integers, as a claim without findings has no runs.
    return pd.DataFrame(rows).astype({"runs": "Int64"})


def sections(numbers: pd.DataFrame) -> list[Section]:
    """Return the sections of the report: the verdicts, then the numbers of each claim."""
    from benchmarks.claims.claims import CLAIMS
    from benchmarks.lib.report import Section

    verdicts = numbers.drop_duplicates("claim")[["statement", "verdict"]]
    found = [Section("", [NOTE], verdicts.rename(columns={"statement": "claim"}))]
    for name, rows in numbers.groupby("claim", sort=False):
        claim, measured = CLAIMS[str(name)], rows.dropna()
        title = f"{claim.statement}: {rows['verdict'].iloc[0]}"
        shown = _formatted(measured) if len(measured) else None
        found.append(Section(title, [f"{claim.section}. {claim.method}"], shown))
    return found


def _formatted(rows: pd.DataFrame) -> pd.DataFrame:
    import pandas as pd

    value, low, high = (rows[name].map(_three_digits) for name in ("value", "low", "high"))
    columns = {
        "measured": rows["quantity"] + rows["unit"].map(lambda unit: unit and f" ({unit})"),
        "value": value,
        "95 % interval": (low + " to " + high).where(rows["runs"] != 1, "exact"),
        "asked": rows["criterion"],
        "shown": rows["shown"].replace("no", "**no**"),
    }
    return pd.DataFrame(columns)


def _three_digits(value: float) -> str:
    if math.isinf(value):
        return "never" if value > 0 else "?"
    digits = 0 if abs(value) >= 100 else 1 if abs(value) >= 10 else 3
    return f"{value:,.{digits}f}"


main = command("claims", Options, work)

if __name__ == "__main__":
    raise SystemExit(main(None))
