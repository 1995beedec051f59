"""A comparison: runs of controllers on scenarios, written to files as they finish."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import pandas as pd
from tqdm import tqdm

from benchmarks.compare import plots, tables
from benchmarks.compare.estimates import (
    Scale,
    estimate,
    scale_of,
    scores,
    travel_frontier,
    verdict,
)
from benchmarks.controllers.records import Factory, RosterEntry, provenances
from benchmarks.controllers.roster import label
from benchmarks.lib.report import Section, provenance_line, write_report
from benchmarks.lib.storage import commit, read_object, versions, write_json
from benchmarks.lib.tables import write_csv
from benchmarks.loop.metrics import join, mean_error, measure
from benchmarks.loop.rollout import Trajectory, make_plants, rollout
from benchmarks.loop.scenarios import Scenario
from mptc_gym.evaluation import SEED

TWICE = "square"  # every controller runs this scenario a second time, with what it has learnt

BOUNDS_TEXT = (
    "The least possible error marked * supposes that each change of the set point finds the "
    "plant settled and is not foreseen; of random set points it supposes that their law is "
    "known. With preview of the whole set point, no controller at all does better than the "
    "second row says."
)
SCORE_TEXT = (
    "The first column is the interquartile mean over all scenarios and runs, with its 95 % "
    "interval; the others are means. Below 0, doing nothing is better."
)
LIMITS_CAPTION = (
    "A point is the mean over all runs, a bar its 95 % interval. Each axis begins at the least "
    "possible error, the vertical line."
)
TRAVEL_CAPTION = (
    "A point is the median run of a controller: its error against the distance that it moves "
    "the valve. Down and left is better. The line is the least possible error for a given "
    "travel, the dashed one for any travel."
)
RUNS_CAPTION = (
    "A point is one run. It shows what the NN makes of unlucky initial weights, and PPO of an "
    "unlucky training."
)
RESPONSES_CAPTION = (
    "A line is the median over all runs at each sample, a band the 10th to 90th percentile. "
    "The grey band is the dead zone."
)
COSTS_TEXT = (
    "First and second run: mean error on the square wave, the second time with what was learnt "
    "the first time. Most controllers learn nothing in a run, and do the same twice. Training: "
    "of one policy, the median. Runs: all scenarios, including what is measured."
)


class Comparison:
    """Runs of controllers on scenarios, written to files as they finish.

    Parameters
    ----------
    scenarios
        What to run them on.
    runs
        How many runs of each: the episodes of `mptc_gym.evaluate`, from the first on.
    out
        Folder to write to.
    options
        The command line's, to be recorded.
    """

    def __init__(
        self,
        scenarios: Sequence[Scenario],
        runs: int,
        out: Path,
        options: Mapping[str, Any],
    ) -> None:
        self.runs = pd.DataFrame()
        self._scenarios = {scenario.name: scenario for scenario in scenarios}
        self._seeds = list(range(SEED, SEED + runs))
        self._out = out
        self._entries: list[RosterEntry] = []
        self._members: dict[str, list[Factory]] = {}
        self._responses: dict[str, pd.DataFrame] = {}
        self._again: dict[str, float] = {}  # mean |e| in a second run of TWICE
        self._seconds: dict[str, float] = {}
        self._files: list[str] = []
        self._clock = time.perf_counter()
        self._origin = {
            "started": datetime.now(timezone.utc).isoformat(timespec="seconds"),
            "options": dict(options),
            "seeds": self._seeds,
            "scenarios": {
                name: {"samples": each.samples, "arguments": each.arguments}
                for name, each in self._scenarios.items()
            },
            "versions": versions(),
            "commit": commit(),
        }

    def run(self, entry: RosterEntry, members: list[Factory]) -> None:
        """Run all members of a controller on every scenario."""
        self._entries.append(entry)
        self._members[entry.name] = members
        began = time.perf_counter()
        for scenario in tqdm(self._scenarios.values(), desc=entry.name, unit="scenario"):
            trajectories = []
            for number, member in enumerate(members):
                trajectory, again = self._roll_out(scenario, member)
                trajectories.append(trajectory)
                measures = pd.DataFrame(measure(trajectory, scenario.parameters))
                measures.insert(0, "scenario", scenario.name)
                measures.insert(1, "agent", entry.name)
                measures.insert(2, "policy", number)
                measures.insert(3, "seed", self._seeds)
                self.runs = pd.concat([self.runs, measures], ignore_index=True)
                if again is not None:
                    error = float(mean_error(again).mean()) / len(members)
                    self._again[entry.name] = self._again.get(entry.name, 0.0) + error
            responses = tables.summarise_responses(join(trajectories), scenario, entry.name)
            self._responses[scenario.name] = pd.concat(
                [self._responses.get(scenario.name), responses], ignore_index=True
            )
            self._write_runs(complete=False)
        self._seconds[entry.name] = time.perf_counter() - began

    def _roll_out(
        self, scenario: Scenario, factory: Factory
    ) -> tuple[Trajectory, Trajectory | None]:
        """Run one member; and once more with what it has learnt, if that is of interest."""
        runs = len(self._seeds)
        controller = factory(scenario.arguments, runs, SEED)
        plants = make_plants(runs, scenario.samples, **factory.arguments(scenario.arguments))
        first = rollout(plants, controller, scenario.samples, SEED)
        again = None
        if scenario.name == TWICE:
            again = rollout(plants, controller, scenario.samples, SEED)
        plants.close()
        return first, again

    def finish(self, *, complete: bool) -> list[Section]:
        """Write and return the report of all that has been run, with its tables and plots."""
        if self.runs.empty:
            return []
        summary = tables.summarise(self.runs)
        names = self.runs["scenario"].unique()
        scales = {name: scale_of(self._scenarios[name], len(self._seeds)) for name in names}
        estimates = estimate(self.runs, scales, reference=self.runs["agent"].iloc[0])
        sections = self._sections(summary, estimates, scales)
        self._write_csv("summary.csv", summary)
        self._write_csv("estimates.csv", estimates)
        plots.plot_limits(estimates, self._path("limits.png"))
        frontiers = {name: travel_frontier(self._scenarios[name]) for name in names}
        limits = {name: scale.least.value for name, scale in scales.items()}
        plots.plot_travel(summary, limits, frontiers, self._path("travel.png"))
        plots.plot_runs(self.runs, self._path("runs.png"))
        for name, responses in self._responses.items():
            self._write_csv(f"{name}.csv", responses)
            drawn = responses[responses["agent"].isin(self._drawn())]
            plots.plot_responses(drawn, self._scenarios[name], self._path(f"{name}.png"))
        curves = self._curves()
        if not curves.empty:
            self._write_csv("learning.csv", curves)
            plots.plot_learning(curves, self._path("learning.png"))
        for page in ("report.md", "report.html"):
            self._path(page)
        title = "Comparison of controllers"
        write_report(self._out, title, sections, provenance_line("compare", self._origin))
        self._write_runs(complete=complete)
        return sections

    def _drawn(self) -> list[str]:
        drawn = [entry.name for entry in self._entries if entry.drawn]
        return drawn or [entry.name for entry in self._entries]

    def _curves(self) -> pd.DataFrame:
        """Return the learning curves of all members that have one."""
        curves = [
            pd.DataFrame(member.curve).assign(agent=name, policy=number)
            for name, members in self._members.items()
            for number, member in enumerate(members)
            if member.curve
        ]
        return pd.concat(curves, ignore_index=True) if curves else pd.DataFrame()

    def _sections(
        self, summary: pd.DataFrame, estimates: pd.DataFrame, scales: Mapping[str, Scale]
    ) -> list[Section]:
        """Return the report, the parts of most interest first."""
        runs = self.runs
        over = f"{len(self._seeds)} runs, the same noise for all"
        sections = [
            Section(
                f"Mean absolute error (°C): median (10th to 90th percentile) of {over}",
                table=tables.mae_table(summary),
            ),
            Section(
                "Mean absolute error as a multiple of the least possible error, with its 95 % "
                "interval",
                [verdict(estimates), BOUNDS_TEXT, LIMITS_CAPTION],
                tables.ratio_table(estimates, scales),
                ["limits.png"],
            ),
            Section(
                "Score: 0 for leaving the valve alone, 1 for the least possible error",
                [SCORE_TEXT],
                tables.score_table(scores(runs, scales)),
            ),
            Section("Error against valve travel", [TRAVEL_CAPTION], pictures=["travel.png"]),
            Section("What each controller costs", [COSTS_TEXT], self._costs()),
            Section("Every run", [RUNS_CAPTION], pictures=["runs.png"]),
            Section(
                "Other measures: median (10th to 90th percentile)",
                [
                    "Overshoot and settling time are left out where there is noise: it crosses "
                    "every band."
                ],
                tables.metrics_table(summary, self._scenarios),
            ),
            Section(
                "Scenarios",
                [RESPONSES_CAPTION],
                pd.DataFrame(
                    [
                        (name, self._scenarios[name].title)
                        for name in summary["scenario"].unique()
                    ],
                    columns=["scenario", "what it is"],
                ),
                [f"{name}.png" for name in self._responses],
            ),
        ]
        if not self._curves().empty:
            sections.append(Section("Training", pictures=["learning.png"]))
        if runs["agent"].nunique() > 1:
            title = f"Difference to {label(runs['agent'].iloc[0])} (°C), 95 % interval"
            text = ["And the share of runs in which the error is smaller, in the same noise."]
            sections.insert(3, Section(title, text, tables.paired_table(estimates)))
        return sections

    def _costs(self) -> pd.DataFrame:
        rows = []
        for entry in self._entries:
            name, members = entry.name, self._members[entry.name]
            cost = members[0].cost or entry.cost
            cases = self.runs[(self.runs["agent"] == name) & (self.runs["scenario"] == TWICE)]
            curves = [member.curve for member in members if member.curve]
            seconds = pd.Series([curve[-1]["seconds"] for curve in curves]).median()
            first, second = cases["mae"].mean(), self._again.get(name, float("nan"))
            rows.append(
                {
                    "agent": entry.label,
                    "prior knowledge": cost.prior_knowledge,
                    "parameters": cost.parameters,
                    "samples before": cost.samples,
                    "training (s)": "" if pd.isna(seconds) else f"{seconds:.0f}",
                    "runs (s)": f"{self._seconds.get(name, 0.0):.1f}",
                    "first run": "" if pd.isna(first) else f"{first:.3f}",
                    "second run": "" if pd.isna(second) else f"{second:.3f}",
                }
            )
        return pd.DataFrame(rows)

    def _path(self, name: str) -> Path:
        """Return where to write a file; the first time, remove what another run left there."""
        if not self._files:
            for stale in _files_of_earlier_run(self._out / "provenance.json"):
                (self._out / Path(stale).name).unlink(missing_ok=True)
        if name not in self._files:
            self._files.append(name)
        return self._out / name

    def _write_csv(self, name: str, table: pd.DataFrame) -> None:
        write_csv(self._path(name), tables.for_csv(table))

    def _write_runs(self, *, complete: bool) -> None:
        self._write_csv("runs.csv", self.runs)
        provenance: dict[str, Any] = {
            "complete": complete,
            "seconds": round(time.perf_counter() - self._clock, 1),
            **self._origin,
            "policies": provenances(self._members),
            "files": self._files,
        }
        write_json(self._path("provenance.json"), provenance)


def _files_of_earlier_run(provenance: Path) -> list[str]:
    """Return what an earlier comparison wrote; if that cannot be read, say so and go on."""
    if not provenance.exists():
        return []
    try:
        files = read_object(provenance).get("files", [])
        if not isinstance(files, list) or not all(isinstance(file, str) for file in files):
            raise ValueError(f"{provenance} is damaged: it lists no files")
    except ValueError as error:
        tqdm.write(f"{error}. Other files of the earlier run may stay.", file=sys.stderr)
        return []
    return files
