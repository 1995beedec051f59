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
from rich.console import Console
from tqdm import tqdm

from benchmarks import plots, tables
from benchmarks.metrics import METRICS, measure
from benchmarks.options import number
from benchmarks.rollout import make_plants, rollout
from benchmarks.roster import BUILT_IN, Factory, build, load_factory, observation
from benchmarks.scenarios import SCENARIOS
from benchmarks.storage import commit, replacing, versions, write_json, write_text
from mptc_gym import Parameters

SEED = 0  # run i meets the noise, and starts from the weights, of seed SEED + i


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
    console = Console(width=None if sys.stdout.isatty() else 140, markup=False)
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
    summary = comparison.finish(complete=True)

    title = f"{METRICS['mae']}: median (10th to 90th percentile) of {options.seeds} runs"
    console.print(title)
    console.print(tables.on_screen(tables.mae_table(summary)))
    others = tables.metrics_table(summary, tables.format_median)
    console.print(f"Other measures: median of {options.seeds} runs")
    console.print(tables.on_screen(others))
    console.print(f"Tables, data and plots are in {options.out}/", highlight=False)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.compare",
        description="Compare controllers on the paper's cases, all of them on the same noise.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
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
    add("--seeds", type=number, default=100, help="number of runs of each case")
    add(
        "--ppo-steps",
        type=number,
        default=argparse.SUPPRESS,
        help="samples of experience of each PPO policy (default: 1000000)",
    )
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
        from benchmarks.ppo import PPOArguments, Trained  # here: torch takes seconds to load

        changes = {"steps": options.ppo_steps} if "ppo_steps" in options else {}
        factories["ppo"] = Trained(
            PPOArguments(**changes), options.policies, retrain=options.retrain, progress=True
        )
    if not factories:
        raise ValueError("--agents, --agent: no controller to run")
    if not options.scenarios:
        raise ValueError("--scenarios: none to run")
    for factory in factories.values():
        observation(factory)  # complain now, not after the first controllers have run
    return factories


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
        seeds, scenarios = self._options.seeds, [SCENARIOS[s] for s in self._options.scenarios]
        # Building may take long, as PPO is trained then, and shows a progress bar of its own.
        windows = observation(factory)
        built = [
            build(factory, Parameters(**scenario.arguments, **windows), seeds, SEED)
            for scenario in scenarios
        ]
        if agent == "ppo":  # the only one that learns beforehand
            self._policies[agent] = factory.used
            self._curves = factory.curves

        cells = list(zip(scenarios, built, strict=True))
        for scenario, controller in tqdm(cells, desc=agent, unit="scenario"):
            plants = make_plants(seeds, scenario.samples, **scenario.arguments, **windows)
            trajectory = rollout(plants, controller, scenario.samples, SEED)
            plants.close()
            measures = pd.DataFrame(measure(trajectory, scenario.parameters))
            measures.insert(0, "scenario", scenario.name)
            measures.insert(1, "agent", agent)
            measures.insert(2, "seed", range(SEED, SEED + seeds))
            self.runs = pd.concat([self.runs, measures], ignore_index=True)
            responses = tables.summarise_responses(trajectory, scenario, agent)
            self._responses[scenario.name] = pd.concat(
                [self._responses.get(scenario.name), responses], ignore_index=True
            )
            self._write_runs(complete=False)

    def finish(self, *, complete: bool) -> pd.DataFrame:
        """Write and return the summary, and plot all that has been run, if anything has."""
        if self.runs.empty:
            return pd.DataFrame()
        summary = tables.summarise(self.runs)
        self._write_csv("summary.csv", summary)
        write_text(self._path("summary.md"), tables.markdown(summary, self._options.seeds))
        plots.plot_mae(summary, self._path("mae.png"))
        for name, responses in self._responses.items():
            self._write_csv(f"{name}.csv", responses)
            plots.plot_responses(responses, SCENARIOS[name], self._path(f"{name}.png"))
        if not self._curves.empty:
            self._write_csv("learning.csv", self._curves)
            plots.plot_learning(self._curves, self._path("learning.png"))
        self._write_runs(complete=complete)
        return summary

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
