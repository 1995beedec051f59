"""Train the neural controllers: `python -m benchmarks.train --help`."""

import importlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from benchmarks.lib.command import Count, Folder, Parameter, command, options
from benchmarks.lib.errors import UsageError
from benchmarks.lib.parallel import FanOut
from benchmarks.lib.results import KeptResults, conditions_of, results_folder
from benchmarks.lib.seeds import SEEDS
from benchmarks.loop.scenarios import PlantOptions

SEED = SEEDS["networks"].first  # seed of the first network; network i has the seed SEED + i
# For each kind of network, the module of `benchmarks.train` that has its recipe.
NETWORKS = {"neural": "neural", "ppo": "ppo", "ppo-hard": "ppo"}


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Train the neural controllers: by the gradient through the plant, or by PPO.

    If a training of several networks was stopped, the same command with the same code trains
    only those that are missing.
    """

    network: Annotated[str, Parameter(choices=NETWORKS)] = field(kw_only=False)
    """What to train."""
    networks: Count = 5
    """Networks to train, each from its own seed. All are compared, none is chosen."""
    plant: PlantOptions = field(default_factory=PlantOptions)
    steps: Count | None = None
    """Optimiser steps or, for PPO, samples of experience (default: as published)."""
    out: Folder = Path("results/networks")
    fan_out: FanOut = field(default_factory=FanOut)


def work(options: Options) -> str:
    """Train networks, save them, print their validation and return the closing message.

    A `UsageError` is raised if the options name a plant for a network other than "ppo".
    """
    name = options.network
    module = importlib.import_module(f"benchmarks.train.{NETWORKS[name]}")
    recipe = module.RECIPES[name]
    recipe = replace(recipe, steps=options.steps or recipe.steps)
    seeds = range(SEED, SEED + options.networks)
    train, stem = module.train, name
    if options.plant.name:
        if name != "ppo":
            raise UsageError(f"--plant, --preset and --set are for ppo, not for {name}")
        plant = options.plant.arguments()
        recipe = replace(module.for_plant(plant), steps=recipe.steps)
        train, stem = partial(module.train, plant=plant), f"{name}-plant"
    tasks = {f"seed {seed}": partial(train, recipe, seed) for seed in seeds}
    target = options.out / stem
    with results_folder(target, conditions_of("train", options)) as folder:
        kept = KeptResults(folder, save_network, module.load)
        trained = dict(options.fan_out.stream(tasks, "training", kept))
        networks = {seed: trained[f"seed {seed}"] for seed in seeds}
        show_validation(networks)
        files = {f"{stem}-{seed}": network for seed, network in networks.items()}
        for file_name, network in files.items():
            save_network(folder / f"{file_name}.npz", network)
    return f"Written to {target}: {', '.join(files)}"


def save_network(path: Path, network: Any) -> None:
    """Save a network by its method `save` in the file `path`."""
    network.save(path)


def show_validation(networks: Mapping[int, Any]) -> None:
    """Print a table with the validation results of trained networks, a row for each network.

    `networks` has the networks by the seeds of their training.
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


main = command("train", Options, work)

if __name__ == "__main__":
    raise SystemExit(main(None))
