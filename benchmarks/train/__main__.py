"""Train the neural controllers: `python -m benchmarks.train --help`."""

import importlib
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated

from benchmarks.lib.command import Count, FanOut, Folder, Parameter, command, options
from benchmarks.lib.storage import Kept, out_folder, replacing

SEED = 10_000  # of the first network; the others follow
# Modules with the recipes.
NETWORKS = {"neural": "neural", "ppo": "ppo", "ppo-hard": "ppo"}


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Train the neural controllers: by the gradient through the plant, or by PPO.

    Finished networks are kept, if no file of the checkout differs from its commit: the same
    command, run again, trains only the missing ones.
    """

    network: Annotated[str, Parameter(choices=NETWORKS)] = field(kw_only=False)
    """What to train."""
    networks: Count = 5
    """Networks to train, each from its own seed. All are compared, none is chosen."""
    steps: Count | None = None
    """Optimiser steps or, for PPO, samples of experience (default: as published)."""
    out: Folder = Path("results/networks")
    fan_out: FanOut = field(default_factory=FanOut)


def work(options: Options) -> str:
    """Train networks, save them and show their results in validation."""
    import pandas as pd

    from benchmarks.lib.report import on_screen

    out, name = out_folder(options.out), options.network
    module = importlib.import_module(f"benchmarks.train.{NETWORKS[name]}")
    recipe = module.RECIPES[name]
    recipe = replace(recipe, steps=options.steps or recipe.steps)
    seeds = range(SEED, SEED + options.networks)
    tasks = {f"seed {seed}": partial(module.train, recipe, seed) for seed in seeds}
    trained = dict(options.fan_out.stream(tasks, "training", Kept(out / "tasks")))
    networks = {seed: trained[f"seed {seed}"] for seed in seeds}
    about = {seed: network.provenance for seed, network in networks.items()}
    rows = {
        seed: {**each["validation"], "CPU (s)": each["cpu_seconds"]}
        for seed, each in about.items()
    }
    shown = pd.DataFrame.from_dict(rows, "index").map("{:.4g}".format)
    print(on_screen(shown.reset_index(names="seed")))
    files = {f"{name}-{seed}": network for seed, network in networks.items()}
    for stem, network in files.items():
        with replacing(out / f"{stem}.npz") as file:
            network.save(file)
    return f"Written to {out}: {', '.join(files)}"


main = command("train", Options, work)

if __name__ == "__main__":
    raise SystemExit(main(None))
