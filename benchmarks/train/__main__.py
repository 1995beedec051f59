"""Train policies by PPO: `python -m benchmarks.train --help`."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated

from agents import PolicyNetwork
from benchmarks.lib.command import Count, Folder, Parameter, command, options
from benchmarks.lib.errors import UsageError
from benchmarks.lib.parallel import FanOut
from benchmarks.lib.results import KeptResults, conditions_of, results_folder
from benchmarks.lib.seeds import SEEDS
from benchmarks.loop.scenarios import PlantOptions

SEED = SEEDS["networks"].first  # seed of the first network; network i has the seed SEED + i
NETWORKS = "ppo", "ppo-hard"


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Train policies by PPO on simulated plants.

    After an interruption, the same command with the same code trains only the networks that are
    still missing.
    """

    network: Annotated[str, Parameter(choices=NETWORKS)] = field(kw_only=False)
    """The kind of network to train."""
    networks: Count = 5
    """The number of networks to train, each from a different seed. All trained networks are
    written, and none is chosen by its result."""
    plant: PlantOptions = field(default_factory=PlantOptions)
    steps: Count | None = None
    """The length of a training, samples of experience (default: as for the published
    networks)."""
    out: Folder = Path("results/networks")
    fan_out: FanOut = field(default_factory=FanOut)


def work(options: Options) -> str:
    """Train and save networks, print the validation results, and return the last line to print.

    A `UsageError` is raised if the options name a plant for a network other than "ppo".
    """
    from benchmarks.train import ppo

    name = options.network
    recipe = ppo.RECIPES[name]
    train = ppo.train
    stem = name  # beginning of the names of the files
    if options.plant.name:
        if name != "ppo":
            raise UsageError(f"--plant, --preset and --set are for ppo, not for {name}")
        plant = options.plant.arguments()
        recipe = ppo.for_plant(plant)
        train = partial(train, plant=plant)
        stem = "ppo-plant"
    if options.steps:
        recipe = replace(recipe, steps=options.steps)
    seeds = range(SEED, SEED + options.networks)
    tasks = {f"seed {seed}": partial(train, recipe, seed) for seed in seeds}
    target = options.out / stem
    with results_folder(target, conditions_of("train", options)) as folder:
        kept = KeptResults(folder, save_network, PolicyNetwork.load)
        trained = dict(options.fan_out.stream(tasks, "training", kept))
        networks = {seed: trained[f"seed {seed}"] for seed in seeds}
        show_validation(networks)
        files = {seed: f"{stem}-{seed}" for seed in seeds}
        for seed, network in networks.items():
            save_network(folder / f"{files[seed]}.npz", network)
    return f"Written to {target}: {', '.join(files.values())}"


def save_network(path: Path, network: PolicyNetwork) -> None:
    """Save `network` in the file `path`."""
    network.save(path)


def show_validation(networks: Mapping[int, PolicyNetwork]) -> None:
    """Print a table with the validation results of trained networks, a row for each network.

    The keys of `networks` are the seeds of the trainings.
    """
    import pandas as pd

    from benchmarks.lib.report import on_screen

    rows = {}
    for seed, network in networks.items():
        provenance = network.provenance
        rows[seed] = {**provenance["validation"], "CPU (s)": provenance["cpu_seconds"]}
    texts = pd.DataFrame.from_dict(rows, "index").map("{:.4g}".format)
    print(on_screen(texts.reset_index(names="seed")))


main = command("train", Options, work)

if __name__ == "__main__":
    raise SystemExit(main(None))
