"""Train as the options say, and put the networks where they are kept."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
from rich.console import Console

from agents.archive import PRETRAINED
from agents.neural_law import LawNetwork
from benchmarks.lib import command_line
from benchmarks.lib.fan_out import FanOut
from benchmarks.lib.storage import commit, replacing
from benchmarks.lib.tables import on_screen
from benchmarks.train import kept, ppo
from benchmarks.train.options import Options
from benchmarks.train.through_plant import KINDS, Training, train, training_key


def execute(options: Options, console: Console) -> str:
    """Train, and say how the networks do in validation."""
    out = command_line.out_folder(options.out)
    target = PRETRAINED if options.keep else out
    if options.network == "ppo":
        return _ppo(options, console, out, target)
    first = Training() if options.steps is None else replace(Training(), steps=options.steps)
    seeds = range(first.seed, first.seed + (options.networks or 1))
    trainings = [replace(first, seed=seed) for seed in seeds]
    networks = trained(
        trainings,
        out,
        options.fan_out.open(),
        retrain=options.retrain,
        here=options.fan_out.backend == "loky",
    )
    table = summary(networks)
    console.print(on_screen(table.map("{:.4g}".format)))
    best = networks[int(table["all"].argmin())]
    with replacing(target / "nn-smith.npz") as file:
        best.save(file)
    seed = best.provenance["training"]["seed"]
    return f"Validation chooses seed {seed}: it is in {target / 'nn-smith.npz'}"


def trained(
    trainings: Sequence[Training],
    out: Path,
    fan_out: FanOut,
    *,
    retrain: bool = False,
    here: bool = True,
) -> list[LawNetwork]:
    """Train side by side what `out` does not hold yet, and return the networks.

    Where `out` is at hand, `here`, it also keeps how far a training got.
    """
    files = {out / training_key(each) / "network.npz": each for each in trainings}
    for file in files:
        file.parent.mkdir(parents=True, exist_ok=True)
        if retrain:
            file.with_name("state.pt").unlink(missing_ok=True)
    kept.train(
        {
            file: partial(train, each, file.with_name("state.pt") if here else None, commit())
            for file, each in files.items()
        },
        fan_out,
        retrain=retrain,
    )
    for file in files:
        file.with_name("state.pt").unlink(missing_ok=True)
    return [LawNetwork.load(file) for file in files]


def summary(networks: Sequence[LawNetwork]) -> pd.DataFrame:
    """Return how networks do in validation: geometric means of |e|, as shares of the reach."""
    rows = []
    for network in networks:
        found = network.provenance["validation"]
        logarithms = {kind: found[kind] for kind in KINDS}
        logarithms["all"] = float(np.mean([*logarithms.values()]))
        rows.append(
            {
                "seed": network.provenance["training"]["seed"],
                **{kind: np.exp(value) for kind, value in logarithms.items()},
                "CPU (s)": network.provenance["cpu_seconds"],
            }
        )
    return pd.DataFrame(rows)


def _ppo(options: Options, console: Console, out: Path, target: Path) -> str:
    """Train PPO's policies, say how they do, and put them where they are kept."""
    asked = ppo.PolicyRequest(
        options.fan_out.open(), out, options.steps, options.networks, options.retrain
    )
    policies = ppo.members(asked, shipped=False)
    rows = []
    for policy in policies:
        best = min(policy.curve, key=lambda point: point["validation_mae"])
        rows.append(
            {
                "seed": policy.arguments.seed,
                "best after": best["steps"],
                "mean |e| in validation (°C)": best["validation_mae"],
                "on the square wave (°C)": best["square_mae"],
                "CPU (s)": policy.curve[-1]["seconds"],
            }
        )
    shown = pd.DataFrame(rows).map(lambda x: f"{x:.4g}" if isinstance(x, float) else str(x))
    console.print(on_screen(shown))
    for policy in policies:
        policy.network.save(target / ppo.file_name(policy.arguments))
    return f"The policies are in {target}"
