"""Judge numbers by criteria, and write what is found about the claims as a report."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from math import inf, isfinite, isinf
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from benchmarks.lib.report import Section
from benchmarks.lib.statistics import Estimate, quantile, share

Finding = dict[str, Any]  # a row of the table of numbers, as `judge` returns it

NOTE = (
    "Each case is run with independent initial weights and noise. A mean error is the mean of "
    "|e| over the samples of one run. A mean error in the table is the median over the runs, "
    "and so is a ratio of mean errors. A criterion counts as met only if the entire 95 % "
    "confidence interval satisfies it. A claim holds if all its criteria are met, and it holds "
    "in part if some of its criteria are met."
)
OFTEN = 0.9  # "works", "converges": in at least this share of the runs


def judge(
    quantity: str, value: Any, unit: str = "", *, at_least: float = -inf, at_most: float = inf
) -> Finding:
    """Return a finding: a number, and whether it meets a criterion.

    Parameters
    ----------
    quantity
        What the number is, in words.
    value
        An `Estimate`; an array with a value for each run, of which the median is estimated; or
        an exact number.
    unit
        Unit of the number.
    at_least, at_most
        Bounds that a claim asks for. Without a bound, the number is information, and no part of
        the verdict.

    Returns
    -------
    dict
        `quantity`, `unit`, the fields of the `Estimate`, `criterion` in words ("" without a
        bound), and `shown`: "yes" if the entire interval satisfies the bounds, "no" if no part
        of it does, otherwise "undecided"; "" without a bound.
    """
    if isinstance(value, Estimate):
        estimate = value
    elif np.ndim(value):
        estimate = quantile(value, 0.5)
    else:
        number = float(value)
        estimate = Estimate(number, number, number, 1)
    bounds = {"at least": at_least, "at most": at_most}
    criteria = [f"{name} {bound:g}" for name, bound in bounds.items() if isfinite(bound)]
    answer = ""
    if criteria:
        answer = "undecided"
        if at_least <= estimate.low and estimate.high <= at_most:
            answer = "yes"
        elif estimate.high < at_least or estimate.low > at_most:
            answer = "no"
    return {
        "quantity": quantity,
        "unit": unit,
        **vars(estimate),
        "criterion": " and ".join(criteria),
        "shown": answer,
    }


def judge_share(quantity: str, happened: NDArray[np.bool_], *, often: bool = False) -> Finding:
    """Judge the share of runs in which something happened, shape (runs,).

    `often` asks for a share of at least `OFTEN`.
    """
    at_least = 100 * OFTEN if often else -inf
    return judge(quantity, share(happened).scaled(100), "% of runs", at_least=at_least)


def judge_times(quantity: str, samples: ArrayLike) -> Iterator[Finding]:
    """Yield the 10th, 50th and 90th percentile of times of the runs, as information.

    `samples` has the shape (runs,); an infinite time means never.
    """
    for probability in (0.1, 0.5, 0.9):
        estimate = quantile(samples, probability)
        yield judge(f"{quantity}, {probability:.0%} of runs", estimate, "samples")


def verdict(findings: Iterable[Finding]) -> str:
    """Return the verdict in words; an undecided finding counts as not shown."""
    is_met = [finding["shown"] == "yes" for finding in findings if finding["shown"]]
    if not is_met:
        return "cannot be tested from the text"
    if all(is_met):
        return "holds"
    if any(is_met):
        return "holds in part"
    return "does not hold"


def table(claims: Mapping[str, Any], findings: Mapping[str, Sequence[Finding]]) -> pd.DataFrame:
    """Return one row for each finding about a claim, and one for a claim without findings.

    Both arguments are by the names of the claims.
    """
    rows: list[dict[str, Any]] = []
    for name, findings_of_claim in findings.items():
        claim_columns = {
            "claim": name,
            "section": claims[name].section,
            "statement": claims[name].statement,
            "verdict": verdict(findings_of_claim),
        }
        numbers = findings_of_claim or [{"runs": None}]
        rows.extend({**claim_columns, **finding} for finding in numbers)
    # Nullable integers, as a claim without findings has no runs.
    return pd.DataFrame(rows).astype({"runs": "Int64"})


def sections(claims: Mapping[str, Any], numbers: pd.DataFrame) -> list[Section]:
    """Return the sections of the report: the verdicts, then the numbers of each claim.

    `claims` are the claims by name; `numbers` is what `table` returns.
    """
    verdicts = numbers.drop_duplicates("claim")[["statement", "verdict"]]
    report = [Section("", [NOTE], verdicts.rename(columns={"statement": "claim"}))]
    for name, rows in numbers.groupby("claim", sort=False):
        claim = claims[str(name)]
        measured = rows.dropna(subset="runs")
        title = f"{claim.statement}: {rows['verdict'].iloc[0]}"
        formatted = _formatted(measured) if len(measured) else None
        text = f"{claim.section}. {claim.method}"
        report.append(Section(title, [text], formatted, bold=["no"]))
    return report


def _formatted(rows: pd.DataFrame) -> pd.DataFrame:
    """Return rows of `table` as text, with the columns of the report."""
    low = rows["low"].map(_three_digits)
    high = rows["high"].map(_three_digits)
    columns = {
        "measured": rows["quantity"] + rows["unit"].map(lambda unit: unit and f" ({unit})"),
        "value": rows["value"].map(_three_digits),
        "95 % interval": (low + " to " + high).where(rows["runs"] != 1, "exact"),
        "asked": rows["criterion"],
        "shown": rows["shown"],
    }
    return pd.DataFrame(columns)


def _three_digits(value: float) -> str:
    """Return a number with about three digits; an infinite time is "never"."""
    if isinf(value):
        return "never" if value > 0 else "?"
    if abs(value) >= 100:
        return f"{value:,.0f}"
    if abs(value) >= 10:
        return f"{value:.1f}"
    return f"{value:.3f}"
