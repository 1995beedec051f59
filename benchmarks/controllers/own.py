"""Make and check a user's own controllers, the values of the option `--agent`.

A *factory* is a user's function or class that returns a policy. The page
`benchmarks/compare/README.md` describes its arguments and its result.
"""

import importlib.util
import inspect
import json
import pkgutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from agents import PolicyNetwork
from benchmarks.controllers.known_plant import KnownPlant
from benchmarks.controllers.roster import ROSTER, ControllerSpec, Made
from benchmarks.lib.command import CommandError
from benchmarks.loop.runs import make_plants
from benchmarks.loop.scenarios import Scenario
from mptc_gym.plant.parameters import INTERFACE
from mptc_gym.rollout import check_fit

FORMS = (
    "NAME=MODULE:FACTORY, NAME=gains.json of benchmarks.tune, or NAME=FILE.npz of "
    "benchmarks.train, with a NAME that no other controller has"
)


def own_controllers(words: Sequence[str]) -> dict[str, ControllerSpec]:
    """Return the record of each of a user's own controllers, by name.

    Parameters
    ----------
    words
        Values of the option `--agent`, each in the form NAME=LOCATION. Several values with the
        same NAME are several training runs of one controller.

    Raises
    ------
    CommandError
        If a value has another form, if a NAME is taken, or if a file or the top-level package
        of a factory does not exist or is damaged.
    """
    locations_of: dict[str, list[str]] = {}
    for word in words:
        name, _, location = word.partition("=")
        if not (name and location) or name.lower() in ROSTER:
            raise CommandError(f"--agent: {word!r} must have the form {FORMS}")
        locations_of.setdefault(name, []).append(location)
    controllers = {}
    for name, locations in locations_of.items():
        try:
            controller = _controller(locations)
        except (KeyError, OSError, TypeError, ValueError) as error:
            word = f"{name}={' '.join(locations)}"
            raise CommandError(f"--agent: {word} must be {FORMS}: {error}") from error
        controllers[name] = replace(controller, name=name, label=name, group="own")
    return controllers


def _controller(locations: Sequence[str]) -> ControllerSpec:
    """Return the record of a controller at `locations`, without its name, label and group."""
    if locations[0].endswith(".json"):
        (file,) = locations  # a ValueError if there are several
        return _with_searched_gains(Path(file))
    if locations[0].endswith(".npz"):
        return _with_trained_networks(locations)
    for location in locations:
        module, _, factory = location.partition(":")
        package = module.partition(".")[0]
        if not factory or importlib.util.find_spec(package) is None:
            raise ValueError(f"{package!r} is no module in the current folder, or installed")
    return ControllerSpec(
        name="", label="", group="", make=from_factory, trainings=locations, random=True
    )


def _with_searched_gains(file: Path) -> ControllerSpec:
    """Return the record of a controller with gains from a JSON file of `benchmarks.tune`."""
    content = json.loads(file.read_text(encoding="utf-8"))
    controller = ROSTER[content["controller"]]
    return replace(
        controller,
        arguments=content["gains"],
        knows=content["knows"],
        searched=content["searched"],
        direction=controller.direction and KnownPlant(content["plant"]).direction,
    )


def _with_trained_networks(files: Sequence[str]) -> ControllerSpec:
    """Return the record of a controller with policies from NPZ files of `benchmarks.train`."""
    # Loading checks each file. The files are taken to come from one command, so the first
    # network describes the training of all.
    networks = [PolicyNetwork.load(file) for file in files]
    provenance = networks[0].provenance
    samples = f"{provenance.get('steps', 0) / 1e6:.3g} M samples per policy"
    return replace(
        ROSTER["ppo"],
        trainings=[str(Path(file).resolve()) for file in files],
        knows=f"trained on a simulator of {_in_words(provenance.get('plant', {}))}",
        searched=f"trained by PPO: {samples}",
        direction=KnownPlant(provenance.get("plant", {})).direction,  # {}: the paper's plant
    )


def _in_words(plant: Mapping[str, Any]) -> str:
    """Return the arguments of a plant as a text for a table."""
    arguments = ", ".join(f"{name}={value}" for name, value in plant.items())
    return f"the plant {arguments}" if arguments else "the plant of the paper"


def from_factory(plant: KnownPlant, runs: int, seed: int, training: str) -> Made:
    """Call a user's factory, and return the policy and the arguments of its environment.

    Of `num_envs`, `seed`, `u_min`, `u_max` and `parameters` (all arguments of the environment),
    the factory gets those that are named in its signature. `training` is the location of the
    factory, in the form MODULE:FACTORY. A ValueError is raised if the factory chooses another
    plant, or returns a model whose normalisation statistics would be left out.
    """
    factory = pkgutil.resolve_name(training)
    offered = {"num_envs": runs, "seed": seed, "parameters": plant.parameters, **plant.limits}
    wanted = inspect.signature(factory).parameters
    made = factory(**{name: offered[name] for name in offered if name in wanted})
    policy, interface = made if isinstance(made, tuple) else (made, {})
    changes = set(interface) - set(INTERFACE)
    if changes:  # With another plant, the controller would be compared unfairly.
        raise ValueError(
            f"a controller may choose {', '.join(INTERFACE)}, got {', '.join(changes)}"
        )
    # The plants of a comparison have no wrappers, so the statistics would be left out.
    if getattr(policy, "get_vec_normalize_env", lambda: None)() is not None:
        raise ValueError(
            "a model with VecNormalize must come as a function of the observations, as "
            "ppo_normalised in benchmarks/examples/train_your_own.md"
        )
    return policy, {**plant.arguments, **interface}


def check_own(controller: ControllerSpec, scenario: Scenario, runs: int, seed: int) -> None:
    """Refuse a user's own controller that does not fit the plants of a scenario.

    A `CommandError` is raised for a controller that `mptc_gym.evaluate` would refuse, such as
    one with other limits of the flow, and for what `from_factory` refuses.
    """
    try:
        for member in controller.members():
            policy, arguments = member.start(scenario.arguments, runs, seed)
            plants = make_plants(runs, scenario.samples, **arguments)
            # The user chose the interface, so it may differ from that of a model's training.
            check_fit(policy, plants, is_made_by_user=True)
    except ValueError as error:
        raise CommandError(f"--agent {controller.name}, {scenario.name}: {error}") from error
