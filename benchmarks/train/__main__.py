"""Train policies by PPO: `python -m benchmarks.train --help`."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from agents import PolicyNetwork
from benchmarks.lib.command import CommandError, Count, Folder, Parameter, command, options
from benchmarks.lib.fan_out import FanOut
from benchmarks.lib.outputs import new_folder, provenance_of
from benchmarks.lib.seeds import SEEDS
from benchmarks.loop.scenarios import PlantOptions

SEED = SEEDS["networks"].start  # seed of the first network; network i has the seed SEED + i
NETWORKS = "ppo", "ppo-hard"


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Train policies by PPO on simulated plants, and draw their scores over the samples.

    If --out names the folder of an earlier run of the same training, only networks that are
    missing are trained.
    """

    network: Annotated[str | None, Parameter(choices=NETWORKS)] = field(
        default=None, kw_only=False
    )
    """The kind of network to train."""
    networks: Count = 5
    """The number of networks to train, each from a different seed. All trained networks are
    written, and none is chosen by its result."""
    plant: PlantOptions = field(default_factory=PlantOptions)
    steps: Count | None = None
    """The length of a training run, samples of experience (default: as for the published
    networks)."""
    out: Folder = None
    fan_out: FanOut = field(default_factory=FanOut)


def work(options: Options) -> None:
    """Train the networks that are missing in the folder, and show the results of all of them.

    A `CommandError` is raised

    - if the options name no network;
    - if the options choose a plant, and another network than "ppo";
    - if the folder has networks of another plant or of other settings;
    - at the end, if tasks failed or the user interrupted the command.
    """
    from benchmarks.train import learning, ppo
    from benchmarks.train.recipe import RECIPES, for_plant

    name = options.network
    if name is None:
        raise CommandError(f"name the network to train: {', '.join(NETWORKS)}")
    recipe = RECIPES[name]
    stem = name  # beginning of the names of the files
    if options.plant.name:
        if name != "ppo":
            raise CommandError(f"--plant, --preset and --set are for ppo, not for {name}")
        recipe = for_plant(options.plant.arguments())
        stem = "ppo-plant"
    if options.steps:
        recipe = replace(recipe, steps=options.steps)
    seeds = list(range(SEED, SEED + options.networks))
    if options.out:
        check_folder(options.out, ppo.settings_of(recipe))
    # With `goes_on`, the folder may be that of an earlier run, which is continued.
    folder = new_folder(options.out, f"train-{stem}", provenance_of(seeds=seeds), goes_on=True)
    files = {seed: folder / f"{stem}-{seed}.npz" for seed in seeds}
    tasks = {
        file.name: partial(ppo.train, recipe, seed)
        for seed, file in files.items()
        if not file.exists()
    }
    finished = options.fan_out.run(
        tasks, "training", save=lambda name, network: network.save(folder / name)
    )
    networks = {seed: PolicyNetwork.load(file) for seed, file in files.items() if file.exists()}
    show_validation(networks)
    print(f"The networks are in {folder}/")
    if finished.error:  # raised last, so that the networks that are finished are shown
        raise finished.error
    controllers = {
        name: partial(learning.score_controller, name, recipe) for name in learning.COMPARED
    }
    scored = options.fan_out.run(controllers, "other controllers")
    learning.write(networks, scored.results, folder)
    if scored.error:
        raise scored.error


def check_folder(folder: Path, settings: Mapping[str, Any]) -> None:
    """Raise a CommandError if a folder has a network that other settings have given.

    `settings` are those of the training, as `ppo.settings_of` returns them.
    """
    # A file has the settings as JSON, with lists in place of tuples.
    expected = flattened(json.loads(json.dumps(settings)))
    for file in folder.glob("*.npz"):
        present = flattened(PolicyNetwork.load(file).provenance)
        for name, value in expected.items():
            if present[name] != value:
                raise CommandError(
                    f"--out: {file} is of another training run, with {name} "
                    f"{json.dumps(present[name])} and not {json.dumps(value)}"
                )


def flattened(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the plant, which the oldest files do not name, and each setting by name.

    {} is the paper's plant.
    """
    return {"plant": settings.get("plant", {}), **settings["recipe"]}


def show_validation(networks: Mapping[int, PolicyNetwork]) -> None:
    """Print a table with the validation results of trained networks, a row for each network.

    The keys of `networks` are the seeds of the training runs.
    """
    import pandas as pd

    from benchmarks.lib.sections import on_screen

    rows = {}
    for seed, network in networks.items():
        provenance = network.provenance
        rows[seed] = {**provenance["validation"], "CPU (s)": provenance["cpu_seconds"]}
    texts = pd.DataFrame.from_dict(rows, "index").map("{:.4g}".format)
    print(on_screen(texts.reset_index(names="seed")))


main = command("train", Options, work)

if __name__ == "__main__":
    raise SystemExit(main())
