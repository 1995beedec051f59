"""Run batches of the NN and the PI controller, and judge and report what is found."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import inf, isfinite, isinf
from typing import Any

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
    "over the runs. A criterion counts as shown only if the entire 95 % confidence interval "
    "satisfies it. A claim holds if all its criteria are shown, and in part if some are."
)
OFTEN = 0.9  # "works", "converges": in at least this share of the draws


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
        of_nodes, of_inputs = (3 / nodes, 3 / length) if slower else (1.0, 1.0)
        paper = DirectNNController()
        return DirectNNController(
            n_inputs=2 * length,
            n_hidden=nodes,
            eta=of_nodes * of_inputs * paper.eta,
            eta_1=of_nodes * paper.eta_1,
            eta_theta=of_nodes * paper.eta_theta,
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

    def run_pi(self, kp: float, ki: float, samples: int, **arguments: Any) -> Trajectory:
        """Run a PI controller, only once if there is no noise."""
        batch = self if "noise_variance" in arguments else Batch(1, self.seed)
        return batch.run(PIController(kp, ki), samples, **arguments)


def judge(
    quantity: str, found: Any, unit: str = "", *, at_least: float = -inf, at_most: float = inf
) -> Finding:
    """Judge a number: an estimate, the median of one value per run, or an exact value.

    A bound makes the number part of the verdict. It is shown if the whole interval keeps the
    bound, and not shown if no part of the interval does.
    """
    if not isinstance(found, Estimate):
        one = float(np.ravel(found)[0])
        found = quantile(found, 0.5) if np.ndim(found) else Estimate(one, one, one, 1)
    bounds = {"at least": at_least, "at most": at_most}
    asked = [f"{name} {bound:g}" for name, bound in bounds.items() if isfinite(bound)]
    shown = "undecided" if asked else ""
    if asked and at_least <= found.low and found.high <= at_most:
        shown = "yes"
    elif found.high < at_least or found.low > at_most:
        shown = "no"
    criterion = {"criterion": " and ".join(asked), "shown": shown}
    return {"quantity": quantity, "unit": unit, **vars(found), **criterion}


def judge_share(quantity: str, found: NDArray[np.bool_], *, often: bool = False) -> Finding:
    """Judge the share of runs in which `found` is true; `often` requires `OFTEN`."""
    at_least = 100 * OFTEN if often else -inf
    return judge(quantity, share(found).scaled(100), "% of runs", at_least=at_least)


def judge_time(quantity: str, samples: ArrayLike) -> Iterator[Finding]:
    """Find the 10th, 50th and 90th percentiles of a time; infinite means never."""
    for p in (0.1, 0.5, 0.9):
        yield judge(f"{quantity}, {p:.0%} of runs", quantile(samples, p), "samples")


def verdict(findings: Iterable[Finding]) -> str:
    """Return the verdict in words; an undecided finding counts as not shown."""
    shown = [row["shown"] == "yes" for row in findings if row["shown"]]
    if not shown:
        return "cannot be tested from the text"
    if all(shown):
        return "holds"
    return "holds in part" if any(shown) else "does not hold"


def table(claims: Mapping[str, Any], found: Mapping[str, Sequence[Finding]]) -> pd.DataFrame:
    """Return one row for each finding about a claim, and one for a claim without findings."""
    rows = []
    for name, findings in found.items():
        claim, judged = claims[name], verdict(findings)
        about = {"claim": name, "section": claim.section, "statement": claim.statement}
        rows += [{**about, "verdict": judged, **each} for each in findings or [{"runs": None}]]
    # Nullable integers, as a claim without findings has no runs.
    return pd.DataFrame(rows).astype({"runs": "Int64"})


def sections(claims: Mapping[str, Any], numbers: pd.DataFrame) -> list[Section]:
    """Return the sections of the report: the verdicts, then the numbers of each claim."""
    verdicts = numbers.drop_duplicates("claim")[["statement", "verdict"]]
    found = [Section("", [NOTE], verdicts.rename(columns={"statement": "claim"}))]
    for name, rows in numbers.groupby("claim", sort=False):
        claim, measured = claims[str(name)], rows.dropna(subset="runs")
        title = f"{claim.statement}: {rows['verdict'].iloc[0]}"
        shown = _formatted(measured) if len(measured) else None
        text = f"{claim.section}. {claim.method}"
        found.append(Section(title, [text], shown, bold=["no"]))
    return found


def _formatted(rows: pd.DataFrame) -> pd.DataFrame:
    value, low, high = (rows[name].map(_three_digits) for name in ("value", "low", "high"))
    columns = {
        "measured": rows["quantity"] + rows["unit"].map(lambda unit: unit and f" ({unit})"),
        "value": value,
        "95 % interval": (low + " to " + high).where(rows["runs"] != 1, "exact"),
        "asked": rows["criterion"],
        "shown": rows["shown"],
    }
    return pd.DataFrame(columns)


def _three_digits(value: float) -> str:
    if isinf(value):
        return "never" if value > 0 else "?"
    digits = 0 if abs(value) >= 100 else 1 if abs(value) >= 10 else 3
    return f"{value:,.{digits}f}"
