"""Train the neural controllers: `python -m benchmarks.train --help`."""

import importlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from benchmarks.lib.command import Count, FanOut, Folder, Parameter, command, options
from benchmarks.lib.results import KeptResults, conditions_of, results_folder
from benchmarks.lib.seeds import SEEDS
from benchmarks.lib.storage import replacing

SEED = SEEDS["networks"].first  # of the first network; the others follow
# Modules with the recipes, and how many networks are trained by default.
NETWORKS = {"nn-smith": ("through_plant", 1), "ppo": ("ppo", 5), "ppo-hard": ("ppo", 5)}


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Train the neural controllers: by the gradient through the plant, or by PPO.

    If a training of several networks was stopped, the same command with the same code trains
    only those that are missing.
    """

    network: Annotated[str, Parameter(choices=NETWORKS)] = field(kw_only=False)
    """What to train."""
    networks: Count | None = None
    """Networks to train, each from its own seed (default: 1 for nn-smith, where validation
    chooses the best; 5 for PPO, which are all compared)."""
    steps: Count | None = None
    """Optimiser steps or, for PPO, samples of experience (default: as published)."""
    out: Folder = Path("results/networks")
    fan_out: FanOut = field(default_factory=FanOut)


def work(options: Options) -> str:
    """Train networks, save them and show their results in validation."""
    name, target = options.network, options.out / options.network
    module_name, usual = NETWORKS[name]
    module = importlib.import_module(f"benchmarks.train.{module_name}")
    recipe = module.RECIPES[name]
    recipe = replace(recipe, steps=options.steps or recipe.steps)
    seeds = range(SEED, SEED + (options.networks or usual))
    tasks = {f"seed {seed}": partial(module.train, recipe, seed) for seed in seeds}
    with results_folder(target, conditions_of("train", options)) as folder:
        kept = KeptResults(folder, save_network, module.load)
        trained = dict(options.fan_out.stream(tasks, "training", kept))
        files = networks_to_keep(name, {seed: trained[f"seed {seed}"] for seed in seeds})
        for stem, network in files.items():
            save_network(folder / f"{stem}.npz", network)
    return f"Written to {target}: {', '.join(files)}"


def save_network(path: Path, network: Any) -> None:
    """Save a network, completely or not at all."""
    with replacing(path) as partial_path:
        network.save(partial_path)


def networks_to_keep(name: str, networks: Mapping[int, Any]) -> dict[str, Any]:
    """Show the validation of networks, by seed, and return those to keep, by name of the file.

    Of the networks for a bank of models, this is the best one; of PPO's policies, all.
    """
    import pandas as pd

    from benchmarks.lib.report import on_screen

    about = {seed: network.provenance for seed, network in networks.items()}
    rows = {
        seed: {**each["validation"], "CPU (s)": each["cpu_seconds"]}
        for seed, each in about.items()
    }
    shown = pd.DataFrame.from_dict(rows, "index").map("{:.4g}".format)
    print(on_screen(shown.reset_index(names="seed")))
    files = {f"{name}-{seed}": network for seed, network in networks.items()}
    if name == "nn-smith":
        best = min(rows, key=lambda seed: rows[seed]["all"])
        files = {name: networks[best]}
        print(f"Validation chooses seed {best}")
    return files


main = command("train", Options, work)

if __name__ == "__main__":
    raise SystemExit(main(None))
