"""Estimate distances to the least possible error, and paired differences, from runs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from benchmarks.bounds.least import LeastPossible, is_random, least_possible
from benchmarks.lib.statistics import Estimate, bootstrap, improvement
from benchmarks.lib.tables import groups
from benchmarks.loop.scenarios import Scenario
from mptc_gym.evaluation import EPISODES

Score = tuple[Estimate, dict[str, float]]  # overall, and by scenario

BOOTSTRAP = 0  # seed of the bootstraps


@dataclass(frozen=True)
class Scale:
    """The bounds that the errors of a scenario are measured against."""

    scenario: str
    least: LeastPossible
    """The least possible error that applies: of the kind "causal", "reference" or "preview", as
    `least_possible` chooses."""
    preview: LeastPossible
    """The least possible error of any controller, even with preview."""
    drawn: bool
    """Whether anything is random, so that runs differ."""

    @classmethod
    def of(cls, values: dict[str, Any]) -> Scale:
        """Return a scale from the values that `asdict` gives, in JSON or not."""
        least, preview = (LeastPossible(**values[name]) for name in ("least", "preview"))
        return cls(**{**values, "least": least, "preview": preview})


def scale_of(scenario: Scenario, runs: int) -> Scale:
    """Return the bounds on the errors of a scenario.

    Bounds of drawn plants and set points are means over the episodes that are run.
    """
    case: dict[str, Any] = {
        "samples": scenario.samples,
        "episodes": min(runs, EPISODES),
        **scenario.arguments,
    }
    least, preview = least_possible(**case), least_possible(kind="preview", **case)
    return Scale(scenario.name, least, preview, is_random(scenario.parameters))


def bounds(scenario: Scenario, runs: int) -> dict[str, Any]:
    """Return the bounds on the errors of a scenario as values to be kept; see `Scale.of`."""
    return asdict(scale_of(scenario, runs))


def estimate(runs: pd.DataFrame, scale: Scale, reference: str) -> pd.DataFrame:
    """Return estimates for a scenario with 95 % intervals, one row for each agent.

    They are the `mean` of |e|, degC; `ratio`, the mean as a multiple of `limit`, the least
    possible error that applies; `difference`, the mean paired difference from the reference
    agent; and `improvement`, the probability of doing better than that agent. `preview` is the
    least possible error of any controller. Ends are infinite if runs differ but there is only
    one.
    """
    rows = []
    limit = scale.least.value
    errors = {agent: _errors(group) for agent, group in groups(runs, "agent")}
    base = errors[reference].mean(axis=0) if reference in errors else None
    for agent, values in errors.items():
        mean = bootstrap(values, seed=BOOTSTRAP)
        if scale.drawn and values.size == 1:
            mean = replace(mean, low=-math.inf, high=math.inf)
        row: dict[str, Any] = {
            "scenario": scale.scenario,
            "agent": agent,
            "limit": limit,
            "preview": scale.preview.value,
            "mean": mean,
            "ratio": replace(
                mean, value=mean.value / limit, low=mean.low / limit, high=mean.high / limit
            ),
        }
        if base is not None and agent != reference:
            row["difference"] = bootstrap(values - base, seed=BOOTSTRAP)
            row["improvement"] = improvement(values, base, BOOTSTRAP)
        rows.append(row)
    return pd.DataFrame(rows)


def ranked(runs: pd.DataFrame, scales: Mapping[str, Scale]) -> dict[str, Score]:
    """Return the scores of all agents, the best first."""
    scores = {agent: score(of_agent, scales) for agent, of_agent in groups(runs, "agent")}
    return dict(sorted(scores.items(), key=lambda each: -each[1][0].value))


def score(runs: pd.DataFrame, scales: Mapping[str, Scale]) -> Score:
    """Return an agent's score, overall and in each scenario.

    A run scores 0 for the mean error of a valve that is left alone and 1 for the least possible
    error. The score of a scenario is the mean over its runs, which is the score of
    `mptc_gym.evaluate`; the overall score is the mean over the scenarios, however hard they
    are. Its 95 % interval resamples policies and runs within each scenario.
    """
    tables = {
        scenario: scales[scenario].least.score(_errors(group))
        for scenario, group in groups(runs, "scenario")
    }
    overall = bootstrap(*tables.values(), seed=BOOTSTRAP)
    return overall, {scenario: float(table.mean()) for scenario, table in tables.items()}


def _errors(runs: pd.DataFrame) -> NDArray[np.float64]:
    """Return the errors of a controller's runs, shape (policies, seeds)."""
    return runs.pivot_table(index="policy", columns="seed", values="mae").to_numpy()
