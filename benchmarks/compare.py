"""Compare controllers on the paper's cases: `python -m benchmarks.compare --help`."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import pandas as pd
from tqdm import tqdm

from benchmarks import command_line, plots, tables
from benchmarks.estimates import beaten, estimate
from benchmarks.experiments import join, mean_error
from benchmarks.metrics import measure
from benchmarks.opponents import ACCOUNTS
from benchmarks.report import Section, write_report
from benchmarks.rollout import Trajectory, make_plants, rollout
from benchmarks.roster import BUILT_IN, Factory, build, label, load_factory, observation
from benchmarks.scenarios import SCENARIOS, Scenario
from benchmarks.storage import commit, replacing, versions, write_json
from mptc_gym import Parameters

SEED = 0  # run i meets the noise, and starts from the weights, of seed SEED + i
TWICE = "square"  # every controller runs this scenario a second time, with what it has learnt
DRAWN = ("nn", "pi", "smith", "ppo")  # responses of these and of the user's own are drawn


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the comparison and write what it finds.

    Parameters
    ----------
    arguments
        The command line without the program's name.

    Returns
    -------
    int
        0, or 130 if it was interrupted.
    """
    parser = _parser()
    options = parser.parse_args(arguments)
    try:
        options.agents = _known("agents", options.agents, [*BUILT_IN, "ppo"])
        options.scenarios = _known("scenarios", options.scenarios, list(SCENARIOS))
        factories = _factories(options)
    except ValueError as error:
        parser.error(str(error))

    # Wide enough for the tables where nothing says how wide the page is.
    console = command_line.console(170)
    comparison = Comparison(options)
    try:
        for agent, factory in factories.items():
            comparison.run(agent, factory)
    except KeyboardInterrupt:
        console.print("\nInterrupted: what has finished is kept.")
        comparison.finish(complete=False)
        return 130
    except Exception:
        comparison.finish(complete=False)
        raise
    report = comparison.finish(complete=True)

    for section in report[:2]:
        console.print(section.title, *section.text, sep="\n")
        console.print(tables.on_screen(section.table))
    console.print(f"The report, tables, data and plots are in {options.out}/")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = command_line.parser(
        "compare", "Compare controllers on the paper's cases, all of them on the same noise."
    )
    add = parser.add_argument
    names = {"nargs": "*", "metavar": "NAME"}
    add("--agents", default=[*BUILT_IN, "ppo"], help="controllers of this repository", **names)
    add(
        "--agent",
        action="append",
        default=[],
        metavar="NAME=MODULE:FACTORY",
        help="a controller of your own, beside those of --agents (may be given more than once)",
    )
    add("--scenarios", default=list(SCENARIOS), help="cases", **names)
    add("--seeds", type=command_line.number, default=100, help="number of runs of each case")
    add(
        "--ppo-steps",
        type=command_line.number,
        default=argparse.SUPPRESS,
        help="samples of experience of each PPO policy (default: 1000000)",
    )
    add(
        "--ppo-policies",
        type=command_line.number,
        default=argparse.SUPPRESS,
        help="how many PPO policies to train and compare (default: 5)",
    )
    command_line.add_fan_out(parser, "trainings")
    add("--retrain", action="store_true", help="train PPO anew")
    add("--out", type=Path, default=Path("results/compare"), help="folder to write to")
    add(
        "--policies",
        type=Path,
        default=Path("results/policies"),
        help="folder where trained policies are kept",
    )
    return parser


def _known(option: str, given: list[str], known: list[str]) -> list[str]:
    names = [name for text in given for name in text.split(",") if name]
    for name in names:
        if name not in known:
            raise ValueError(f"--{option}: no {name!r}; there are {', '.join(known)}")
    return list(dict.fromkeys(names))


def _factories(options: argparse.Namespace) -> dict[str, Factory]:
    factories = {name: load_factory(BUILT_IN[name]) for name in options.agents if name != "ppo"}
    for text in options.agent:
        name, equals, location = text.partition("=")
        if not (name and equals) or name.lower() in [*BUILT_IN, "ppo", *factories]:
            raise ValueError(f"--agent must be NEW_NAME=MODULE:FACTORY, got {text!r}")
        factories[name] = load_factory(location)
    if "ppo" in options.agents:  # last, as it takes longest and may be interrupted
        from benchmarks import ppo  # here: torch takes seconds to load

        changes = {"steps": options.ppo_steps} if "ppo_steps" in options else {}
        factories["ppo"] = ppo.Trained(
            ppo.PPOArguments(**changes),
            options.policies,
            policies=getattr(options, "ppo_policies", ppo.POLICIES),
            fan_out=command_line.fan_out(options),
            retrain=options.retrain,
            progress=True,
        )
    if not factories:
        raise ValueError("--agents, --agent: no controller to run")
    if not options.scenarios:
        raise ValueError("--scenarios: none to run")
    for factory in factories.values():
        observation(factory)  # complain now, not after the first controllers have run
    return factories


ACCOUNTS_TEXT = [
    "While learning and after: on the square wave. The NN learns in the run that is compared; "
    "after is a second run with the weights that it has then, still learning. PPO learns "
    "before, on random set points with noise, while it explores; after is what is compared. "
    "The others learn nothing, and do the same twice.",
    "Training: of one policy, the median. Runs: all scenarios, including what is measured.",
]
FAILURES_TEXT = (
    "One point a run. What the NN makes of unlucky initial weights, and PPO of an unlucky "
    "training, is to be seen here."
)


class Comparison:
    """Runs of controllers on scenarios, written to files as they finish.

    Parameters
    ----------
    options
        The command line's: `scenarios`, `seeds` and `out` are used, all are recorded.
    """

    def __init__(self, options: argparse.Namespace) -> None:
        self.runs = pd.DataFrame()
        self._options = options
        self._responses: dict[str, pd.DataFrame] = {}
        self._curves = pd.DataFrame()
        self._policies: dict[str, Any] = {}
        self._again: dict[str, float] = {}  # mean |e| in a second run of TWICE
        self._seconds: dict[str, float] = {}
        self._files: list[str] = []
        self._clock = time.perf_counter()
        self._origin = {
            "started": datetime.now(timezone.utc).isoformat(timespec="seconds"),
            "options": {name: _plain(value) for name, value in vars(options).items()},
            "seeds": list(range(SEED, SEED + options.seeds)),
            "versions": versions(),
            "commit": commit(),
        }

    def run(self, agent: str, factory: Factory) -> None:
        """Run a controller on every scenario."""
        # PPO's are several policies, which may have to be trained first.
        members = factory.members() if hasattr(factory, "members") else [factory]
        if agent == "ppo":
            self._policies[agent] = factory.used
            self._curves = factory.curves
        windows = observation(factory)
        began = time.perf_counter()
        for name in tqdm(self._options.scenarios, desc=agent, unit="scenario"):
            scenario = SCENARIOS[name]
            trajectories = []
            for policy, member in enumerate(members):
                trajectory, again = self._roll_out(scenario, member, windows)
                trajectories.append(trajectory)
                measures = pd.DataFrame(measure(trajectory, scenario.parameters))
                measures.insert(0, "scenario", name)
                measures.insert(1, "agent", agent)
                measures.insert(2, "policy", policy)
                measures.insert(3, "seed", self._origin["seeds"])
                self.runs = pd.concat([self.runs, measures], ignore_index=True)
                if again is not None:
                    error = float(mean_error(again).mean())
                    self._again[agent] = self._again.get(agent, 0.0) + error / len(members)
            responses = tables.summarise_responses(join(trajectories), scenario, agent)
            self._responses[name] = pd.concat(
                [self._responses.get(name), responses], ignore_index=True
            )
            self._write_runs(complete=False)
        self._seconds[agent] = time.perf_counter() - began

    def _roll_out(
        self, scenario: Scenario, factory: Factory, windows: dict[str, Any]
    ) -> tuple[Trajectory, Trajectory | None]:
        """Run one member; and once more with what it has learnt, if that is of interest."""
        seeds = self._options.seeds
        parameters = Parameters(**scenario.arguments, **windows)
        controller = build(factory, parameters, seeds, SEED)
        plants = make_plants(seeds, scenario.samples, **scenario.arguments, **windows)
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
        estimates = estimate(self.runs, reference=self.runs["agent"].iloc[0])
        sections = self._sections(summary, estimates)
        self._write_csv("summary.csv", summary)
        self._write_csv("estimates.csv", estimates)
        plots.plot_limits(estimates, self._path("limits.png"))
        plots.plot_runs(self.runs, self._path("runs.png"))
        for name, responses in self._responses.items():
            self._write_csv(f"{name}.csv", responses)
            drawn = responses[responses["agent"].isin(self._drawn(responses))]
            plots.plot_responses(drawn, SCENARIOS[name], self._path(f"{name}.png"))
        if not self._curves.empty:
            self._write_csv("learning.csv", self._curves)
            plots.plot_learning(self._curves, self._path("learning.png"))
        for page in ("report.md", "report.html"):
            self._path(page)
        write_report(self._options.out, "Comparison of controllers", sections)
        self._write_runs(complete=complete)
        return sections

    @staticmethod
    def _drawn(responses: pd.DataFrame) -> list[str]:
        agents = responses["agent"].unique()
        chosen = [agent for agent in agents if agent in DRAWN or agent not in ACCOUNTS]
        return chosen or list(agents)

    def _sections(self, summary: pd.DataFrame, estimates: pd.DataFrame) -> list[Section]:
        """Return the report, the parts of most interest first."""
        seeds, runs = self._options.seeds, self.runs
        below = beaten(estimates)
        verdict = "No controller beats a limit, in any scenario."
        if len(below):
            cases = ", ".join(f"{row.agent} in {row.scenario}" for row in below.itertuples())
            verdict = f"Below a limit, which cannot be: {cases}."
        over = f"{seeds} runs, the same noise for all"
        sections = [
            Section(
                f"Mean absolute error (°C): median (10th to 90th percentile) of {over}",
                table=tables.mae_table(summary),
            ),
            Section(
                "Mean absolute error as a multiple of the least possible, 95 % interval",
                [verdict],
                tables.ratio_table(estimates),
                ["limits.png"],
            ),
            Section("What each costs", ACCOUNTS_TEXT, self._accounts()),
            Section("Every run", [FAILURES_TEXT], pictures=["runs.png"]),
            Section(
                "Other measures: median (10th to 90th percentile)",
                table=tables.metrics_table(summary),
            ),
            Section(
                "Scenarios",
                table=pd.DataFrame(
                    [(name, SCENARIOS[name].title) for name in summary["scenario"].unique()],
                    columns=["scenario", "what it is"],
                ),
                pictures=[f"{name}.png" for name in self._responses],
            ),
        ]
        if not self._curves.empty:
            sections.append(Section("PPO's training", pictures=["learning.png"]))
        if runs["agent"].nunique() > 1:
            title = f"Difference to {label(runs['agent'].iloc[0])} (°C), 95 % interval"
            text = ["And the share of runs in which the error is smaller, in the same noise."]
            sections.insert(2, Section(title, text, tables.paired_table(estimates)))
        return sections

    def _accounts(self) -> pd.DataFrame:
        rows = []
        for agent in self.runs["agent"].unique():
            known = ACCOUNTS.get(agent)
            cases = self.runs[(self.runs["agent"] == agent) & (self.runs["scenario"] == TWICE)]
            learning, after = cases["mae"].mean(), self._again.get(agent, float("nan"))
            seconds = 0.0
            if agent == "ppo" and not self._curves.empty:
                learning = self._curves["training_mae"].mean()
                after = cases["mae"].mean()
                seconds = float(self._curves.groupby("policy")["seconds"].max().median())
            rows.append(
                {
                    "agent": label(agent),
                    "told about the plant": known.told if known else "",
                    "parameters": known.parameters if known else "",
                    "samples before": known.samples if known else "",
                    "training (s)": f"{seconds:.0f}" if seconds else "",
                    "runs (s)": f"{self._seconds.get(agent, 0.0):.1f}",
                    "mean error while learning": "" if pd.isna(learning) else f"{learning:.3f}",
                    "after": "" if pd.isna(after) else f"{after:.3f}",
                }
            )
        return pd.DataFrame(rows)

    def _path(self, name: str) -> Path:
        """Return where to write a file; the first time, remove what another run left there."""
        out: Path = self._options.out
        if not self._files:
            earlier = out / "provenance.json"
            if earlier.exists():
                for stale in json.loads(earlier.read_text(encoding="utf-8")).get("files", []):
                    (out / Path(stale).name).unlink(missing_ok=True)
        if name not in self._files:
            self._files.append(name)
        return out / name

    def _write_csv(self, name: str, table: pd.DataFrame) -> None:
        with replacing(self._path(name)) as file:
            tables.for_csv(table).to_csv(file, index=False)

    def _write_runs(self, *, complete: bool) -> None:
        self._write_csv("runs.csv", self.runs)
        path = self._path("provenance.json")
        provenance: dict[str, Any] = {
            "complete": complete,
            "seconds": round(time.perf_counter() - self._clock, 1),
            **self._origin,
            "policies": self._policies,
            "files": self._files,
        }
        write_json(path, provenance)


def _plain(value: Any) -> Any:
    return str(value) if isinstance(value, Path) else value


if __name__ == "__main__":
    sys.exit(main())
