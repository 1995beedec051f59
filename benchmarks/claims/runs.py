"""Run batches of the NN and the PI controller, and judge and report what is found."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import inf, isfinite, isinf
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from agents import DirectNNController, PIController
from benchmarks.lib.report import Section
from benchmarks.lib.statistics import Estimate, quantile, share
from benchmarks.loop.rollout import Agent, Trajectory, make_plants, rollout

Array = NDArray[np.floating]
Finding = dict[str, Any]  # a row of the table of numbers

NOTE = (
    "Each case is run with independent initial weights and noise. A mean error is that of one "
    "run over its samples; the number in the table, like a ratio of such errors, is the median "
    "over the runs. A criterion counts as met only if the entire 95 % confidence interval "
    "satisfies it. A claim holds if all its criteria are met, and it holds in part if some of "
    "them are."
)
OFTEN = 0.9  # "works", "converges": in at least this share of the draws


class Gains(NamedTuple):
    """The gains of a PI controller."""

    kp: float
    ki: float


@dataclass(frozen=True)
class Batch:
    """A batch of runs; run i has the initial weights and noise of seed `seed + i`."""

    runs: int
    seed: int = 0

    def networks(
        self, *, nodes: int = 3, length: int = 3, slower: bool = False, direction: int = -1
    ) -> DirectNNController:
        """Return a network for each run, by default the paper's.

        A network has `nodes` hidden nodes, and sees `length` set points and errors. A sum moves
        faster the more terms it has, if the weights of all terms learn with the same gain;
        `slower` scales the gains down to compensate.
        """
        node_scale = 1.0
        input_scale = 1.0
        if slower:
            node_scale = 3 / nodes
            input_scale = 3 / length
        paper = DirectNNController()
        return DirectNNController(
            n_inputs=2 * length,
            n_hidden=nodes,
            eta=node_scale * input_scale * paper.eta,
            eta_1=node_scale * paper.eta_1,
            eta_theta=node_scale * paper.eta_theta,
            direction=direction,
            error_index=length,
            seed=self.seed,
            num_envs=self.runs,
        )

    def run(
        self, agent: Agent, samples: int, before: Any = None, **arguments: Any
    ) -> Trajectory:
        """Run a controller on plants with these arguments; for `before` see `rollout`."""
        plants = make_plants(self.runs, samples, **arguments)
        return rollout(plants, agent, samples, self.seed, before)

    def run_nn(self, samples: int, **arguments: Any) -> Trajectory:
        """Run the paper's networks."""
        return self.run(self.networks(), samples, **arguments)

    def run_pi(self, gains: Gains, samples: int, **arguments: Any) -> Trajectory:
        """Run a PI controller, only once if there is no noise."""
        batch = self if "noise_variance" in arguments else Batch(1, self.seed)
        return batch.run(PIController(*gains), samples, **arguments)


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
        Bounds that a claim asks for. They are shown to hold if the entire interval satisfies
        them, and shown not to hold if no part of it does. Without a bound, the number is
        information, and no part of the verdict.
    """
    estimate = _estimate(value)
    bounds = {"at least": at_least, "at most": at_most}
    criteria = [f"{name} {bound:g}" for name, bound in bounds.items() if isfinite(bound)]
    shown = ""
    if criteria:
        shown = _shown(estimate, at_least, at_most)
    return {
        "quantity": quantity,
        "unit": unit,
        **vars(estimate),
        "criterion": " and ".join(criteria),
        "shown": shown,
    }


def _estimate(value: Any) -> Estimate:
    """Return an estimate of a number; see `judge`."""
    if isinstance(value, Estimate):
        return value
    if np.ndim(value):
        return quantile(value, 0.5)
    number = float(value)
    return Estimate(number, number, number, 1)


def _shown(estimate: Estimate, at_least: float, at_most: float) -> str:
    """Return whether bounds hold: "yes", "no" or "undecided"."""
    if at_least <= estimate.low and estimate.high <= at_most:
        return "yes"
    if estimate.high < at_least or estimate.low > at_most:
        return "no"
    return "undecided"


def judge_share(quantity: str, happened: NDArray[np.bool_], *, often: bool = False) -> Finding:
    """Judge the share of runs in which something happened; `often` requires `OFTEN`."""
    at_least = 100 * OFTEN if often else -inf
    return judge(quantity, share(happened).scaled(100), "% of runs", at_least=at_least)


def judge_worst(plants: pd.DataFrame, text: str) -> Finding:
    """Judge the share of runs that settle on the plant on which it is smallest.

    `plants` has a row for each plant, with the columns `delay`, `gain`, `constant`, `share`,
    and `runs`: whether each run has settled.
    """
    worst = plants.iloc[plants["share"].argmin()]
    numbers = f"delay {worst['delay']}, gain {worst['gain']:g}"
    numbers += f", time constant {worst['constant']:g}"
    quantity = f"settled within 1,200 samples, the worst of {text} ({numbers})"
    return judge_share(quantity, worst["runs"], often=True)


def judge_time(quantity: str, samples: ArrayLike) -> Iterator[Finding]:
    """Yield the 10th, 50th and 90th percentile of a time in samples; infinite means never."""
    for probability in (0.1, 0.5, 0.9):
        estimate = quantile(samples, probability)
        yield judge(f"{quantity}, {probability:.0%} of runs", estimate, "samples")


def verdict(findings: Iterable[Finding]) -> str:
    """Return the verdict in words; an undecided finding counts as not shown."""
    met = [finding["shown"] == "yes" for finding in findings if finding["shown"]]
    if not met:
        return "cannot be tested from the text"
    if all(met):
        return "holds"
    if any(met):
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
        rows += [{**claim_columns, **finding} for finding in findings_of_claim]
        if not findings_of_claim:
            rows.append({**claim_columns, "runs": None})
    # Nullable integers, as a claim without findings has no runs.
    return pd.DataFrame(rows).astype({"runs": "Int64"})


def sections(claims: Mapping[str, Any], numbers: pd.DataFrame) -> list[Section]:
    """Return the sections of the report: the verdicts, then the numbers of each claim.

    `numbers` are those of `table`.
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
    """Return the rows of `table` as a report shows them."""
    value = rows["value"].map(_three_digits)
    low = rows["low"].map(_three_digits)
    high = rows["high"].map(_three_digits)
    columns = {
        "measured": rows["quantity"] + rows["unit"].map(lambda unit: unit and f" ({unit})"),
        "value": value,
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
