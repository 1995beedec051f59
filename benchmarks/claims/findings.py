"""Judge measured numbers by the criteria of the paper's claims, and lay out the report."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from math import inf, isfinite, isinf
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from benchmarks.lib.sections import Section
from benchmarks.lib.statistics import Estimate, quantile, share

Finding = dict[str, Any]  # a row of the table of numbers, as `judge` returns it

NOTE = (
    "The claims are those of the paper by Cui and Shin (1992). The NN is the paper's "
    "controller, a neural network that learns online. Each case is run many times, with "
    "different initial weights and noise. A mean error is the mean of |e| over the samples "
    "of a run, where e is the set point minus the temperature y. A value in the tables is "
    "the median over the runs, unless its unit is '% of runs', with a 95 % confidence "
    "interval. The column 'asked' has the criterion that a claim must meet. A criterion is "
    "met, and 'shown' is 'yes', only if the entire confidence interval satisfies the "
    "criterion. A claim holds if all its criteria are met, and it holds in part if some of "
    "its criteria are met. A claim is undecided if the intervals of all numbers are too wide "
    "to decide on any criterion; more runs make them narrower. A value without a criterion is "
    "for information only."
)
# Least share of runs for claims such as "the controller works" or "the weights converge".
MOST_RUNS = 0.9


def judge(
    quantity: str, value: Any, unit: str = "", *, at_least: float = -inf, at_most: float = inf
) -> Finding:
    """Return a finding: a measured number, and whether the number meets a criterion.

    Parameters
    ----------
    quantity
        What was measured, in words.
    value
        The measured number: an `Estimate`, or an exact number, or an array with a value for
        each run, shape (runs,). Of an array, the finding has the median over the runs.
    unit
        Unit of the number in the report; "" if the number has no unit.
    at_least, at_most
        Smallest and largest value of the measured number that meet the criterion of a claim. If
        `at_least` and `at_most` are infinite, the number is for information only, and does not
        count in the verdict on the claim.

    Returns
    -------
    dict
        The finding has the keys `quantity`, `unit`, `value`, `low`, `high` and `runs` (the
        attributes of an `Estimate`), `criterion` (`at_least` and `at_most` in words) and
        `shown`. The value of `shown` is "yes" if the entire 95 % interval of the number lies
        from `at_least` to `at_most`, "no" if the entire interval lies below `at_least` or above
        `at_most`, and otherwise "undecided". If `at_least` and `at_most` are infinite,
        `criterion` and `shown` are "".
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


def judge_share(
    quantity: str, happened: NDArray[np.bool_], *, is_criterion: bool = False
) -> Finding:
    """Return a finding about the share of runs in which an event happened, in percent.

    `quantity` names the event in words, and `happened` says for each run whether the event
    happened, shape (runs,). If `is_criterion` is true, the claim needs a share of at least
    `MOST_RUNS`; otherwise, the share is for information only.
    """
    at_least = 100 * MOST_RUNS if is_criterion else -inf
    return judge(quantity, share(happened).scaled(100), "% of runs", at_least=at_least)


def judge_times(quantity: str, samples: ArrayLike) -> Iterator[Finding]:
    """Yield the 10th, 50th and 90th percentile of a time as findings without a criterion.

    `quantity` says in words which time was measured. `samples` has the time of an event in each
    run, in samples, shape (runs,); the time is infinite in a run without the event.
    """
    for probability in (0.1, 0.5, 0.9):
        estimate = quantile(samples, probability)
        yield judge(f"{quantity}, {probability:.0%} of runs", estimate, "samples")


def verdict(findings: Iterable[Finding]) -> str:
    """Return the verdict on a claim in words, from all findings about the claim.

    Findings without a criterion do not count in the verdict. Beside other findings, an
    undecided finding counts as a criterion that is not met.
    """
    answers = {finding["shown"] for finding in findings} - {""}
    if not answers:
        return "cannot be tested from the text"
    if answers == {"yes"}:
        return "holds"
    if "yes" in answers:
        return "holds in part"
    return "does not hold" if "no" in answers else "undecided"


def table(claims: Mapping[str, Any], findings: Mapping[str, Sequence[Finding]]) -> pd.DataFrame:
    """Return a table of all findings (measured numbers), with the verdicts on the claims.

    The table has a row for each finding about a claim. A claim without findings has one row, in
    which the number of runs is missing.
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
    # The type `Int64` allows missing numbers, and a claim without findings has no number of
    # runs.
    return pd.DataFrame(rows).astype({"runs": "Int64"})


def sections(claims: Mapping[str, Any], numbers: pd.DataFrame) -> list[Section]:
    """Return the sections of the report: a list of verdicts, then a section for each claim."""
    verdicts = numbers.drop_duplicates("claim")[["statement", "verdict"]]
    report = [Section("", [NOTE], verdicts.rename(columns={"statement": "claim"}))]
    for name, rows in numbers.groupby("claim", sort=False):
        claim = claims[str(name)]
        measured = rows.dropna(subset="runs")
        title = f"{claim.statement}: {rows['verdict'].iloc[0]}"
        formatted = _formatted(measured) if len(measured) else None
        text = f"{claim.section}. {claim.method}"
        report.append(Section(title, [text], formatted))
    return report


def _formatted(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the measured numbers about a claim as a table of texts for the report.

    `rows` are the rows of the claim in the table that the function `table` of this module
    returns.
    """
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
    """Return a number as text: with three decimals below 10, one below 100, and otherwise none.

    The text of infinity is "never", since the time of an event that did not happen is infinite.
    The text of minus infinity, an unknown lower end of an interval, is "?".
    """
    if isinf(value):
        return "never" if value > 0 else "?"
    if abs(value) >= 100:
        return f"{value:,.0f}"
    if abs(value) >= 10:
        return f"{value:.1f}"
    return f"{value:.3f}"
