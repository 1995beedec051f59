"""Read the command-line options `--agents` and `--agent`, which choose controllers.

The option `--agents` chooses controllers of this project, and the option `--agent` adds a
user's own controller.
"""

import importlib.util
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated

from agents import PolicyNetwork
from benchmarks.controllers.own import OwnController, make_controller
from benchmarks.controllers.roster import OWN_LOOKS, ROSTER
from benchmarks.controllers.spec import EVERYTHING, LIMITS, ControllerSpec
from benchmarks.lib.command import CommandError, Names, Parameter, known, options
from benchmarks.lib.fan_out import FanOut

AgentNames = Annotated[
    Names, Parameter(help=f"The controllers to run, from {', '.join(ROSTER)}.")
]
FORMS = (
    "NEW_NAME=MODULE:FACTORY (MODULE without .py), NEW_NAME=gains.json of benchmarks.tune, or "
    "NEW_NAME=FILE.npz of benchmarks.train"
)
# The name of a module, such as "mine" or "package.mine". A name that ends in ".py" is a file.
MODULE_NAME = re.compile(r"\w+(\.(?!py$)\w+)*")


@options
@dataclass(frozen=True, kw_only=True)
class ControllerOptions:
    """The options `--agent`, `--jobs` and `--backend`: own controllers and parallel tasks."""

    agent: Names = ()
    """A controller of your own, which runs in addition to those of --agents. Its form is
    NAME=MODULE:FACTORY; NAME=gains.json for a file of benchmarks.tune; or NAME=FILE.npz for a
    file of benchmarks.train. The same name again adds another training of the controller."""
    fan_out: FanOut = field(default_factory=FanOut)


def chosen(
    names: Sequence[str], user_controllers: Sequence[str] = ()
) -> dict[str, ControllerSpec]:
    """Return a `ControllerSpec` for each controller that a user has chosen, by name.

    The method `members` of a returned `ControllerSpec` loads the code in the user's module or
    zip file.

    Parameters
    ----------
    names
        Values of the option `--agents`: names of controllers in `ROSTER`.
    user_controllers
        Values of the option `--agent`, each in the form NAME=LOCATION. Several values with the
        same NAME are several trainings of one controller.

    Raises
    ------
    CommandError
        If no controller is chosen, if a controller's name is unknown or taken, or if the
        location of a user's controller does not exist.
    """
    if not (names or user_controllers):
        raise CommandError("--agents, --agent: name at least one controller")
    specs = {name: ROSTER[name] for name in known("--agents", names, ROSTER)}
    locations_of: dict[str, list[str]] = {}
    for word in user_controllers:
        name, location = _name_and_location(word)
        locations_of.setdefault(name, []).append(location)
    for name, locations in locations_of.items():
        specs[name] = _own_spec(name, locations)
    return specs


def _name_and_location(word: str) -> tuple[str, str]:
    """Split a value NAME=LOCATION of the option `--agent` into NAME and LOCATION.

    Raises
    ------
    CommandError
        If `word` does not have one of the `FORMS`, if NAME in lower case is the name of a
        controller in `ROSTER`, or if the file or the top-level package in LOCATION does not
        exist.
    """
    name, _, location = word.partition("=")
    module, _, factory = location.partition(":")
    file = ""
    if location.endswith((".json", ".npz")):
        file = location
    is_module = bool(factory) and MODULE_NAME.fullmatch(module) is not None
    if not name or not (file or is_module):
        raise CommandError(f"--agent: {word!r} must have the form {FORMS}")
    if name.lower() in ROSTER:
        raise CommandError(f"--agent: {word!r} must have a new name: {name!r} is taken")
    if file and not Path(file).is_file():
        raise CommandError(f"--agent: {word!r} needs the file {file!r}, which does not exist")
    package = module.partition(".")[0]
    if not file and importlib.util.find_spec(package) is None:
        raise CommandError(
            f"--agent: {word!r} needs the module {package!r}, which is neither in the current "
            "folder nor installed"
        )
    return name, location


def _own_spec(name: str, locations: Sequence[str]) -> ControllerSpec:
    """Return the `ControllerSpec` of a user's own controller called `name`.

    Each element of `locations` is the text LOCATION of an option `--agent NAME=LOCATION`.

    Raises
    ------
    CommandError
        If a JSON or NPZ file in `locations` cannot be read, if a JSON file is combined with
        another location, or if an NPZ file is combined with a location of another type.
    """
    suffixes = {Path(location).suffix for location in locations}
    has_file = ".json" in suffixes or ".npz" in suffixes
    if len(locations) > 1 and has_file and suffixes != {".npz"}:
        listed = " and ".join(locations)
        raise CommandError(
            f"--agent: {name!r} must be one gains.json or several .npz files, got {listed}"
        )
    try:
        if suffixes == {".json"}:
            return _with_searched_gains(name, Path(locations[0]))
        if suffixes == {".npz"}:
            return _with_trained_networks(name, locations)
    except (KeyError, OSError, TypeError, ValueError) as error:
        allowed = "a gains.json of benchmarks.tune or a network of benchmarks.train"
        word = f"{name}={locations[0]}"
        raise CommandError(f"--agent: {word} must be {allowed}: {error}") from error
    return OwnController(
        name=name,
        label=name,
        look=OWN_LOOKS[0],
        build=make_controller,
        prior_knowledge=(*EVERYTHING, *LIMITS),
        random=True,
        pictured=True,
        locations=locations,
    )


def _with_searched_gains(name: str, file: Path) -> ControllerSpec:
    """Return the `ControllerSpec` of a controller with gains from a `benchmarks.tune` file.

    The JSON file `file` has the controller's name in `ROSTER`, the gains, the plant on which
    the gains were searched, and two texts for tables: the element "knows" describes the
    controller's prior knowledge, and the element "searched" says how the gains were searched.
    """
    content = json.loads(file.read_text(encoding="utf-8"))
    return replace(
        ROSTER[content["controller"]].with_gains(content["gains"]),
        name=name,
        label=name,
        knows=content["knows"],
        searched=content["searched"],
        made_for=content["plant"],
    )


def _with_trained_networks(name: str, files: Sequence[str]) -> ControllerSpec:
    """Return the `ControllerSpec` of a controller with policies from NPZ files.

    Each NPZ file in `files` contains one policy that `benchmarks.train ppo` has trained.
    """
    networks = {file: PolicyNetwork.load(Path(file)) for file in files}
    provenance = networks[files[0]].provenance
    samples = f"{provenance.get('steps', 0) / 1e6:.3g} M samples a policy"
    return replace(
        ROSTER["ppo"],
        name=name,
        label=name,
        knows="trained on a simulator of this plant",
        searched=f"trained by PPO: {samples}",
        made_for=provenance.get("plant", {}),
        networks=partial(dict, networks),
    )
