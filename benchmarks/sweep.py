"""Where controllers still work on other plants: `python -m benchmarks.sweep --help`."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks import command_line, maps, tables
from benchmarks.fan_out import CellsFailedError, FanOut
from benchmarks.report import Section, write_report
from benchmarks.robustness import (
    FIXED,
    Plant,
    agent_cell,
    grid,
    limit_cell,
    random_design,
)
from benchmarks.roster import label
from benchmarks.statistics import Estimate, bootstrap, improvement
from benchmarks.storage import ROOT, commit, fingerprint, replacing, versions, write_json

AGENTS = ("nn", "nn-frozen", "pi", "pi-simc", "smith", "ppo", "ppo-randomised")
LEARNT = ("ppo", "ppo-randomised")  # before the sweep
DESIGN_SEED = 0
SEED = 0  # of a plant's first run
OSCILLATES = 1.0  # degC that the swing on steady stretches exceeds that without control by
GROUPS = (  # of the plants that drift, by which the answer is split: half-open intervals
    ("gain falls to less than 0.8 times", "gain_drift", 0.0, 0.8),
    ("gain stays within 0.8 to 1.25 times", "gain_drift", 0.8, 1.25),
    ("gain rises to more than 1.25 times", "gain_drift", 1.25, np.inf),
    ("delay below 14 samples", "delay", 0, 14),
    ("delay from 14 to 22 samples", "delay", 14, 23),
    ("delay above 22 samples", "delay", 23, np.inf),
)
SHAPING = (  # modules of this package that shape a cell
    "experiments", "limits", "opponents", "robustness", "rollout", "scenarios",
)  # fmt: skip
PAIRS = (("nn", "pi-simc"), ("nn", "nn-frozen"), ("nn-frozen", "pi-simc"))


def main(arguments: list[str] | None = None) -> int:
    """Run the sweep and write what it finds.

    Parameters
    ----------
    arguments
        The command line without the program's name.

    Returns
    -------
    int
        0; 130 if it was interrupted; 1 if cells failed. Called again, it goes on.
    """
    parser = _parser()
    options = parser.parse_args(arguments)
    known = [*FIXED, *LEARNT]
    for agent in options.agents:
        if agent not in known:
            parser.error(f"--agents: no {agent!r}; there are {', '.join(known)}")
    out = options.out or Path(f"results/sweep-{options.design}")
    console = command_line.console(150)
    try:
        fan_out = command_line.fan_out(options)
        policies = _policies(options, fan_out)
        plants = (
            grid()
            if options.design == "grid"
            else random_design(options.plants, DESIGN_SEED, options.samples)
        )
        began = time.perf_counter()
        cells = _cells(plants, options, policies)
        results = fan_out.run(cells, out / "cells" / _key(options, policies), title="sweep")
    except ValueError as error:
        parser.error(str(error))
    except KeyboardInterrupt:
        console.print("\nInterrupted: what has finished is kept, and the next call goes on.")
        return 130
    except CellsFailedError as error:
        console.print(str(error))
        return 1
    seconds = time.perf_counter() - began

    runs = _table(plants, options, results)
    sections = report(runs, out, options.design)
    with replacing(out / "runs.csv") as file:
        runs.to_csv(file, index=False)
    write_json(
        out / "provenance.json",
        {
            "seconds": round(seconds, 1),
            "options": {name: str(value) for name, value in vars(options).items()},
            "policies": {name: list(map(str, folders)) for name, folders in policies.items()},
            "versions": versions(),
            "commit": commit(),
        },
    )
    write_report(out, "Controllers on plants that they were not made for", sections)
    for section in sections:
        console.print(section.title, *section.text, sep="\n")
        if section.table is not None:
            console.print(tables.on_screen(section.table))
    console.print(
        f"{len(cells)} cells in {seconds:.0f} s. The report, data and maps are in {out}/"
    )
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = command_line.parser("sweep", "Run controllers on plants they were not made for.")
    add = parser.add_argument
    add(
        "--design",
        choices=("grid", "random"),
        default="grid",
        help="grid: 20 delays by 10 gains; random: plants that differ in everything, half of "
        "which drift",
    )
    add("--plants", type=command_line.number, default=200, help="of a random design")
    add("--runs", type=command_line.number, default=20, help="of each controller on each plant")
    add("--samples", type=command_line.number, default=1200, help="length of a run")
    add("--agents", nargs="+", default=list(AGENTS), metavar="NAME", help="controllers")
    add("--ppo-steps", type=command_line.number, default=argparse.SUPPRESS,
        help="samples of experience of each PPO policy")  # fmt: skip
    add("--ppo-policies", type=command_line.number, default=5, help="of each of the two PPOs")
    command_line.add_fan_out(parser, "cells and trainings")
    add("--out", type=Path, help="folder to write to (default: results/sweep-DESIGN)")
    add("--policies", type=Path, default=Path("results/policies"),
        help="folder where trained policies are kept")  # fmt: skip
    return parser


def _policies(options: argparse.Namespace, fan_out: FanOut) -> dict[str, list[Path]]:
    """Train what is to be trained before, and return the folders of the policies."""
    if not set(LEARNT) & set(options.agents):
        return {}
    from benchmarks import ppo  # here: torch takes seconds to load

    changes = {"steps": options.ppo_steps} if "ppo_steps" in options else {}
    nominal = replace(ppo.PPOArguments(), **changes)
    trained = {"ppo": nominal, "ppo-randomised": replace(nominal, **ppo.RANDOMISED)}
    policies = {}
    for agent, arguments in trained.items():
        if agent in options.agents:
            members = ppo.Trained(
                arguments, options.policies, policies=options.ppo_policies, fan_out=fan_out,
                retrain=False, progress=True,
            )  # fmt: skip
            members.members()
            policies[agent] = [Path(used["folder"]).absolute() for used in members.used]
    return policies


def _cells(
    plants: list[Plant], options: argparse.Namespace, policies: dict[str, list[Path]]
) -> dict[str, Callable[[], Any]]:
    """Return what is to be run: every controller on every plant, and the limits."""
    cells: dict[str, Callable[[], Any]] = {}
    common = {"samples": options.samples, "runs": options.runs, "seed": SEED}
    for i, plant in enumerate(plants):
        cells[f"limit {i}"] = partial(limit_cell, plant, options.samples)
        for agent in ("nothing", *options.agents):
            # Every plant has its own policy, in turn: how much they differ shows in the maps.
            folders = policies.get(agent)
            policy = folders[i % len(folders)] if folders else None
            cells[f"{agent} {i}"] = partial(agent_cell, agent, plant, policy=policy, **common)
    return cells


def _key(options: argparse.Namespace, policies: dict[str, list[Path]]) -> str:
    """Return a name made of everything that shapes the cells' results."""
    sources = [
        *sorted((ROOT / "mptc_gym").glob("*.py")),
        *sorted((ROOT / "agents").glob("*.py")),
        *(ROOT / "benchmarks" / f"{name}.py" for name in SHAPING),
    ]
    return fingerprint(
        sources,
        options=[options.design, options.plants, options.runs, options.samples],
        policies={name: [f.name for f in folders] for name, folders in policies.items()},
        versions=versions(),
    )


def _table(
    plants: list[Plant], options: argparse.Namespace, results: dict[str, Any]
) -> pd.DataFrame:
    """Return one row a run: the plant, what came of it, and how that compares."""
    rows = []
    for i, plant in enumerate(plants):
        limit = results[f"limit {i}"]["mae"]
        nothing = pd.DataFrame(results[f"nothing {i}"])
        for agent in options.agents:
            cell = pd.DataFrame(results[f"{agent} {i}"])
            cell.insert(0, "plant", i)
            cell.insert(1, "agent", agent)
            cell.insert(2, "run", range(len(cell)))
            cell["limit"] = np.nan if limit is None else limit
            cell["ratio"] = cell["mae"] / cell["limit"]
            # The same noise with no control, which sets both scales.
            cell["oscillates"] = cell["swing"] > nothing["swing"] + OSCILLATES
            cell["useless"] = cell["mae"] >= nothing["mae"]
            rows.append(cell.assign(**plant))
    return pd.concat(rows, ignore_index=True)


def report(runs: pd.DataFrame, out: Path, design: str) -> list[Section]:
    """Draw the maps, and return what there is to say.

    Parameters
    ----------
    runs
        One row a run.
    out
        Where to write the maps.
    design
        "grid" or "random".
    """
    sections = [
        Section(
            "How many plants each controller works on",
            [
                "Ratio: mean error as a multiple of the least possible, median and 90th "
                "percentile over the plants whose limit is known (the median run of each). "
                f"Oscillates: on steady stretches the error swings, by its deviation, "
                f"{OSCILLATES:g} °C more than with no control at all. The actuator is limited "
                "and the plant stable, so instability can come to no more than that here. "
                "Useless: the mean error is no smaller than with no control. Both are shares "
                "of the runs. PPO's policies take the plants in turn."
            ],
            _overview(runs),
        )
    ]
    if design == "grid":
        maps.plot_grid(runs, out / "map.png")
        sections[0] = replace(sections[0], pictures=["map.png"])
        return sections
    maps.plot_plants(runs, out / "plants.png")
    maps.plot_drift(runs, PAIRS[0], out / "drift.png")
    sections[0] = replace(sections[0], pictures=["plants.png"])
    if {agent for pair in PAIRS for agent in pair} <= set(runs["agent"]):
        sections.append(
            Section(
                "Does learning help when the plant drifts?",
                [
                    "Differences of the mean error over the second half of a run (°C), run by "
                    "run in the same noise, with 95 % intervals over plants and runs: below 0 "
                    "the first of the two is better; in parentheses, the share of runs in "
                    "which it is. All were made for the nominal plant: the networks learnt on "
                    "it, the PI is tuned by rule from its step test."
                ],
                _differences(runs),
                ["drift.png"],
            )
        )
    return sections


def _overview(runs: pd.DataFrame) -> pd.DataFrame:
    rows = []
    for agent, group in runs.groupby("agent", sort=False):
        ratio = group.groupby("plant")["ratio"].median().dropna()
        rows.append(
            {
                "controller": label(agent),
                "ratio, median": f"{ratio.median():.2f}",
                "ratio, 90 %": f"{ratio.quantile(0.9):.2f}",
                "oscillates (%)": f"{100 * group['oscillates'].mean():.1f}",
                "useless (%)": f"{100 * group['useless'].mean():.1f}",
            }
        )
    return pd.DataFrame(rows)


def _differences(runs: pd.DataFrame) -> pd.DataFrame:
    drifting = runs[runs["gain_drift"].notna()]
    groups = {"no drift": runs[runs["gain_drift"].isna()], "all that drift": drifting}
    for name, column, low, high in GROUPS:
        groups[name] = drifting[drifting[column].between(low, high, inclusive="left")]
    rows = []
    for name, group in groups.items():
        row = {"plants": name, "number": str(group["plant"].nunique())}
        for pair in PAIRS:
            ours, theirs = (
                group[group["agent"] == agent]
                .pivot_table(index="plant", columns="run", values="late")
                .to_numpy()
                for agent in pair
            )
            if len(ours) > 1:
                difference = bootstrap(ours - theirs, SEED)
                better = improvement(ours, theirs, SEED)
                row[" - ".join(map(label, pair))] = _cell(difference, better)
        rows.append(row)
    return pd.DataFrame(rows).fillna("")


def _cell(difference: Estimate, better: Estimate) -> str:
    return (
        f"{difference.value:+.3f} [{difference.low:+.3f}, {difference.high:+.3f}] "
        f"({100 * better.value:.0f} %)"
    )


if __name__ == "__main__":
    sys.exit(main())
