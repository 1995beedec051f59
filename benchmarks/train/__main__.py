"""Train the neural controllers: `python -m benchmarks.train --help`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from cyclopts import Parameter

from agents.networks import PRETRAINED
from benchmarks.lib.command import Count, FanOut, Folder, command, options
from benchmarks.lib.storage import Kept, commit, out_folder, replacing

SEED = 10_000  # of the first network; the others follow
NETWORKS = {"nn-smith": 1, "ppo": 5, "ppo-hard": 5}  # and how many are trained by default


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Train the neural controllers: by the gradient through the plant, or by PPO.

    Finished networks are kept, if no file of the checkout differs from its commit: the same
    command, run again, trains only the missing ones.
    """

    network: Annotated[str, Parameter(choices=NETWORKS)] = field(kw_only=False)
    """What to train."""
    networks: Count | None = None
    """Number of networks to train, each from its own seed (default: 1 for nn-smith, where
    validation chooses the best of several; 5 for PPO, which are all compared)."""
    steps: Count | None = None
    """Optimiser steps or, for PPO, samples of experience (default: as published)."""
    keep: bool = False
    """Save the result to agents/pretrained."""
    out: Folder = Path("results/networks")
    fan_out: FanOut = field(default_factory=FanOut)


def work(options: Options) -> str:
    """Train networks, save them and show their results in validation."""
    import pandas as pd

    from benchmarks.lib.report import on_screen

    out = out_folder(options.out)
    seeds = range(SEED, SEED + (options.networks or NETWORKS[options.network]))
    tasks = {f"seed {seed}": task_of(options, seed) for seed in seeds}
    trained = options.fan_out.run(tasks, "training", Kept(out / "tasks"))
    networks = dict(zip(seeds, trained.values(), strict=True))
    rows = {seed: _validated(network) for seed, network in networks.items()}
    shown = pd.DataFrame.from_dict(rows, "index").map("{:.4g}".format)
    print(on_screen(shown.reset_index(names="seed")))
    target, said = PRETRAINED if options.keep else out, "The policies are"
    if options.network == "nn-smith":
        best = min(rows, key=lambda seed: rows[seed]["all"])
        networks = {best: networks[best]}
        said = f"Validation chooses seed {best}: it is nn-smith.npz"
    for seed, network in networks.items():
        name = options.network if options.network == "nn-smith" else f"{options.network}-{seed}"
        with replacing(target / f"{name}.npz") as file:
            network.save(file)
    return f"{said} in {target}"


def task_of(options: Options, seed: int) -> Any:
    """Return the training of one network, a function without arguments."""
    if options.network == "nn-smith":
        from benchmarks.train.through_plant import Training, train

        training = Training(seed=seed)
        return partial(
            train, replace(training, steps=options.steps or training.steps), commit()
        )
    from benchmarks.train import ppo

    recipe = ppo.RECIPES[options.network]
    return partial(ppo.train, replace(recipe, steps=options.steps or recipe.steps), seed)


def _validated(network: Any) -> dict[str, float]:
    """Return the results of a network in validation.

    For the law these are geometric means of |e| as shares of the authority, and their mean;
    for PPO mean |e| of each case, degC.
    """
    about = network.provenance
    found = dict(about["validation"])
    if found.pop("seed", None) is not None:
        from benchmarks.train.through_plant import KINDS

        logarithms = {kind: found[kind] for kind in KINDS}
        logarithms["all"] = float(np.mean([*logarithms.values()]))
        found = {kind: float(np.exp(value)) for kind, value in logarithms.items()}
    return {**found, "CPU (s)": about["cpu_seconds"]}


main = command("train", Options, work)

if __name__ == "__main__":
    raise SystemExit(main(None))
