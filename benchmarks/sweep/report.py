"""Tabulate the runs of a sweep, and make the sections of its report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.controllers.roster import label
from benchmarks.lib.report import Section
from benchmarks.lib.statistics import bootstrap, improvement
from benchmarks.lib.tables import groups
from benchmarks.loop.designs import SPANS, Arguments
from benchmarks.sweep import maps
from mptc_gym import Parameters

SEED = 0  # seed of the bootstraps
OSCILLATES = 1.0  # degC by which the swing must exceed that without control
GROUPS = (  # groups of drifting plants, by half-open intervals; each has a row of its own
    ("gain falls to less than 0.8 times", "gain_drift", 0.0, 0.8),
    ("gain stays within 0.8 to 1.25 times", "gain_drift", 0.8, 1.25),
    ("gain rises to more than 1.25 times", "gain_drift", 1.25, np.inf),
    ("delay below 14 samples", "delay", 0, 14),
    ("delay from 14 to 22 samples", "delay", 14, 23),
    ("delay above 22 samples", "delay", 23, np.inf),
)
MEASURES = {"mae": "over a whole run", "late": "over the second half of a run"}
# Questions about pairs of controllers: does the first make the smaller error?
QUESTIONS = (
    (
        "Does online learning help when the plant drifts?",
        "All were made for the nominal plant: the networks learnt on it, the PI is tuned by "
        "rule from its step test.",
        (("nn", "pi-simc"), ("nn", "nn-frozen"), ("nn-frozen", "pi-simc")),
        "drift_learning.png",
    ),
    (
        "What does adaptation buy?",
        "The self-tuning controllers identify the plant while they control it. The Smith "
        "predictor and the network behind a model are told the nominal plant.",
        (
            ("nn-self-tuning", "nn-smith"),
            ("nn-self-tuning", "self-tuning"),
            ("nn-smith", "smith"),
            ("self-tuning", "smith"),
        ),
        "drift_adapting.png",
    ),
)
OVERVIEW_TEXT = (
    "Multiple: mean error / least possible error, the median and 90th percentile over the "
    "plants (the median run of each). Travel: of the valve in a run, the median. "
    "Oscillates: on steady stretches the standard deviation of the error is "
    f"{OSCILLATES:g} °C larger than without control. This, and no better than no control, are "
    "shares of the runs."
)
DIFFERENCES_TEXT = (
    "Differences of the mean error (°C), run by run in the same noise, with 95 % intervals "
    "over plants and runs: below 0 the first of the two is better. At the end: the share "
    "of runs in which it is."
)


def table(
    plants: Sequence[Arguments], agents: Sequence[str], found: Mapping[str, Any]
) -> pd.DataFrame:
    """Return one row for each run: its plant, its measures, and how they compare.

    A plant holds the arguments in which it differs from the nominal one. Found are, by the
    names of the tasks, the limit of each plant and the measures of each agent on it, and of
    "nothing".
    """
    rows = []
    for i, plant in enumerate(plants):
        nothing = pd.DataFrame(found[f"plant {i}, nothing"])
        for agent in agents:
            task = pd.DataFrame({"plant": i, "agent": agent, **found[f"plant {i}, {agent}"]})
            task.insert(2, "run", range(len(task)))
            task["limit"] = found[f"plant {i}"] or np.nan  # None where it does not settle
            task["ratio"] = task["mae"] / task["limit"]
            # Doing nothing in the same noise sets both scales.
            task["oscillates"] = task["swing"] > nothing["swing"] + OSCILLATES
            task["useless"] = task["mae"] >= nothing["mae"]
            rows.append(task.assign(**plant))
    return pd.concat(rows, ignore_index=True)


def report(
    runs: pd.DataFrame, out: Path, centre: Parameters | None, told: str
) -> list[Section]:
    """Draw the maps of a grid around the plant `centre`, or of another design, and report.

    `QUESTIONS` are asked unless the design is a grid or controllers are `told` each plant.
    """
    picture = "map.png" if centre else "plants.png"
    maps.plot_maps(runs, out / picture, centre)
    title = "How many plants each controller works on"
    spans = ", ".join(
        f"{name} {runs[name].min():.4g} to {runs[name].max():.4g}"
        for name in SPANS if name in runs
    )  # fmt: skip
    about = [f"The plants have: {spans}.", OVERVIEW_TEXT]
    sections = [Section(title, about, overview(runs), {picture: title})]
    if centre or told == "each":
        return sections
    for title, text, pairs, picture in QUESTIONS:
        asked = [pair for pair in pairs if set(pair) <= set(runs["agent"])]
        if not asked:
            continue
        maps.plot_drift(runs, asked[0], out / picture)
        sections += [
            Section(
                f"{title} Mean error {when}",
                [text, DIFFERENCES_TEXT],
                differences(runs, asked, measure),
                {picture: title} if measure == "late" else {},
            )
            for measure, when in MEASURES.items()
        ]
    return sections


def overview(runs: pd.DataFrame) -> pd.DataFrame:
    """Return one row for each controller; see `OVERVIEW_TEXT`."""
    rows = []
    for agent, group in groups(runs, "agent"):
        ratio = group.groupby("plant")["ratio"].median().dropna()
        rows.append(
            {
                "controller": label(agent),
                "multiple, median": f"{ratio.median():.3f}",
                "multiple, 90 %": f"{ratio.quantile(0.9):.3f}",
                "travel (t/h)": f"{group['total_variation'].median():,.0f}",
                "oscillates (%)": f"{100 * group['oscillates'].mean():.1f}",
                "no better than no control (%)": f"{100 * group['useless'].mean():.1f}",
            }
        )
    return pd.DataFrame(rows)


def differences(
    runs: pd.DataFrame, pairs: Sequence[tuple[str, str]], measure: str
) -> pd.DataFrame:
    """Return differences, a row for each group of plants, a column for each pair."""
    drifting = runs[runs["gain_drift"].notna()]
    groups = {"no drift": runs[runs["gain_drift"].isna()], "all that drift": drifting}
    for name, column, low, high in GROUPS:
        groups[name] = drifting[drifting[column].between(low, high, inclusive="left")]
    rows = []
    for name, group in groups.items():
        row = {"plants": name, "number": str(group["plant"].nunique())}
        errors = group.pivot_table(index="plant", columns=["agent", "run"], values=measure)
        for pair in pairs if len(errors) > 1 else ():
            ours, theirs = (errors[agent].to_numpy() for agent in pair)
            difference = bootstrap(ours - theirs, seed=SEED)
            better = improvement(ours, theirs, SEED)
            shown = f"{difference:+.3f}; {100 * better.value:.0f} %"
            row[" - ".join(map(label, pair))] = shown
        rows.append(row)
    return pd.DataFrame(rows).fillna("")
