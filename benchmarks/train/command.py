"""Train networks as the options say, and save them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from rich.console import Console

from agents import LawNetwork, PolicyNetwork
from agents.networks import PRETRAINED
from benchmarks.lib.command import out_folder
from benchmarks.lib.fan_out import FanOut
from benchmarks.lib.storage import Kept, commit, replacing
from benchmarks.lib.tables import ScreenTable
from benchmarks.train.__main__ import Options
from benchmarks.train.through_plant import KINDS, Training, train

SEED = 10_000  # of the first policy; the others follow
# Networks to save, by file name; a table row per trained network; and the closing message.
Made = tuple[Mapping[str, LawNetwork | PolicyNetwork], list[dict[str, Any]], str]


def execute(options: Options, console: Console) -> str:
    """Train networks, save them and show their results in validation."""
    out = out_folder(options.out)
    target = PRETRAINED if options.keep else out
    networks, rows, said = (_law if options.network == "nn-smith" else _ppo)(options, out)
    shown = pd.DataFrame(rows).map(lambda x: f"{x:.4g}" if isinstance(x, float) else str(x))
    console.print(ScreenTable(shown))
    for name, network in networks.items():
        with replacing(target / name) as file:
            network.save(file)
    return f"{said} in {target}"


def trained(trainings: Sequence[Training], out: Path, fan_out: FanOut) -> list[LawNetwork]:
    """Train in parallel the networks that `out` does not hold yet, and return all of them."""
    tasks = {f"seed {each.seed}": partial(train, each, commit()) for each in trainings}
    kept = Kept(out / "tasks")
    return [*fan_out.run(tasks, "training", kept).values()]


def _law(options: Options, out: Path) -> Made:
    """Train networks for the law, and choose one by validation.

    The rows show geometric means of |e|, as shares of the authority.
    """
    first = Training()
    first = replace(first, steps=options.steps or first.steps)
    seeds = range(first.seed, first.seed + (options.networks or 1))
    networks = trained([replace(first, seed=seed) for seed in seeds], out, options.fan_out)
    rows = []
    for seed, network in zip(seeds, networks, strict=True):
        logarithms = {kind: network.provenance["validation"][kind] for kind in KINDS}
        logarithms["all"] = np.mean([*logarithms.values()])
        means = {kind: float(np.exp(value)) for kind, value in logarithms.items()}
        rows.append({"seed": seed, **means, "CPU (s)": network.provenance["cpu_seconds"]})
    best = min(range(len(rows)), key=lambda i: rows[i]["all"])
    said = f"Validation chooses seed {seeds[best]}: it is nn-smith.npz"
    return {"nn-smith.npz": networks[best]}, rows, said


def _ppo(options: Options, out: Path) -> Made:
    """Train PPO policies, and save all of them.

    The rows show the mean |e| of each validation case, in degC.
    """
    from benchmarks.train import ppo  # here: torch takes seconds to load

    recipe = ppo.RECIPES[options.network]
    recipe = replace(recipe, steps=options.steps or recipe.steps)
    seeds = range(SEED, SEED + (options.networks or 5))
    tasks = {f"seed {seed}": partial(ppo.train, recipe, seed) for seed in seeds}
    kept = Kept(out / "tasks")
    policies, rows = {}, []
    found = options.fan_out.run(tasks, "training", kept)
    for seed, policy in zip(seeds, found.values(), strict=True):
        about = policy.provenance
        rows.append({"seed": seed, **about["validation"], "CPU (s)": about["cpu_seconds"]})
        policies[f"{options.network}-{seed}.npz"] = policy
    return policies, rows, "The policies are"
