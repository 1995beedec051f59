"""Read the options that choose controllers, `--agents` and `--agent`.

`--agents` names controllers of this project, and `--agent` names a user's own controller. The
user's code is loaded in the task that runs the controller, so that an error in the user's code
does not stop other tasks.
"""

import importlib.util
import inspect
import json
import pkgutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from agents import PolicyNetwork
from agents.controller import PAPER_WINDOWS
from agents.networks import WINDOWS
from benchmarks.controllers.roster import OWN_LOOKS, RENAMED, ROSTER
from benchmarks.controllers.spec import EVERYTHING, LIMITS, ControllerSpec
from benchmarks.lib.command import Names, Parameter, blame, known, options
from benchmarks.lib.errors import UsageError
from benchmarks.lib.parallel import FanOut
from mptc_gym import IDS, Parameters
from mptc_gym.environments.layers import plant_groups
from mptc_gym.evaluation import case_of
from mptc_gym.scoring.fit import check_fit
from mptc_gym.scoring.opening import opened
from mptc_gym.scoring.policies import start

AgentNames = Annotated[
    Names, Parameter(help=f"The controllers to run, from {', '.join(ROSTER)}.")
]
FORMS = (
    "NEW_NAME=MODULE:FACTORY, NEW_NAME=PPO:FILE.zip, NEW_NAME=gains.json of benchmarks.tune or "
    "NEW_NAME=FILE.npz of benchmarks.train"
)


@options
@dataclass(frozen=True, kw_only=True)
class ControllerOptions:
    """A user's own controllers, and where controllers run."""

    agent: Names = ()
    """A controller of your own, which runs in addition to those of --agents. Its form is
    NAME=MODULE:FACTORY; NAME=PPO:FILE.zip for a model of Stable-Baselines3 (loading a zip runs
    the code in it); NAME=gains.json for a file of benchmarks.tune; or NAME=FILE.npz for a file
    of benchmarks.train. The same name again adds another training of the controller."""
    fan_out: FanOut = field(default_factory=FanOut)


def agent_names(option: str, names: Sequence[str]) -> list[str]:
    """Return the names of controllers that a user has listed in an option, each once.

    Parameters
    ----------
    option
        The name of the option, such as "--agents", for the error message.
    names
        The listed names.

    Raises
    ------
    UsageError
        If a name is not that of a controller in `ROSTER`. For a name of an earlier version, the
        message has the present name.
    """
    for name in names:
        if name in RENAMED:
            raise UsageError(f"{option}: {name!r} is now called {RENAMED[name]!r}")
    return known(option, names, ROSTER)


def chosen(
    names: Sequence[str], user_controllers: Sequence[str] = ()
) -> dict[str, ControllerSpec]:
    """Return the records of the controllers that a user has chosen, by name.

    Parameters
    ----------
    names
        Names of controllers in `ROSTER`: the words of the option `--agents`.
    user_controllers
        A user's own controllers: the words of the option `--agent`, each in the form
        NAME=LOCATION. Several locations with one name become the members of one controller.

    Raises
    ------
    UsageError
        If no controller is chosen, a name is unknown or taken, or a location does not exist.
        The code of a user's module or zip file is loaded later, by the method `members` of the
        record, which raises a `UsageError` if loading fails.
    """
    if not (names or user_controllers):
        raise UsageError("--agents, --agent: name at least one controller")
    specs = {name: ROSTER[name] for name in agent_names("--agents", names)}
    locations_of: dict[str, list[str]] = {}
    for text in user_controllers:
        name, location = _split(text)
        locations_of.setdefault(name, []).append(location)
    for name, locations in locations_of.items():
        specs[name] = _own_spec(name, locations)
    return specs


def _split(text: str) -> tuple[str, str]:
    """Return NAME and LOCATION of a word `text` of the form NAME=LOCATION.

    The word is a value of the option `--agent`. A `UsageError` is raised if the word has
    another form, if the name is that of a controller in `ROSTER`, or if the location, a file or
    a module, does not exist.
    """
    name, _, location = text.partition("=")
    if name.lower() in ROSTER:
        raise UsageError(f"--agent: {text!r} must be {FORMS}; {name!r} is taken")
    module, _, factory = location.partition(":")
    if location.endswith((".json", ".npz")):
        exists = Path(location).is_file()
    elif location.endswith(".zip"):
        exists = Path(factory).is_file()
    else:
        package = module.partition(".")[0] or "-"  # No package is called "-".
        exists = factory != "" and importlib.util.find_spec(package) is not None
    if not (name and exists):
        raise UsageError(
            f"--agent: {text!r} must be {FORMS}, of a module or a file that exists"
        )
    return name, location


def _own_spec(name: str, locations: Sequence[str]) -> ControllerSpec:
    """Return the record of a user's own controller called `name`.

    The controller has one member for each location: LOCATION in NAME=LOCATION, the value of the
    option `--agent`. A `UsageError` is raised if a JSON or NPZ file cannot be read, or if the
    kinds of locations cannot be combined.
    """
    suffixes = {Path(location).suffix for location in locations}
    if len(locations) > 1 and (".json" in suffixes or {".npz"} < suffixes):
        listed = " and ".join(locations)
        raise UsageError(
            f"--agent: {name!r} must be one gains.json or several .npz, got {listed}"
        )
    try:
        if suffixes == {".json"}:
            return _with_searched_gains(name, Path(locations[0]))
        if suffixes == {".npz"}:
            return _with_trained_networks(name, locations)
    except (KeyError, OSError, TypeError, ValueError) as error:
        allowed = "a gains.json of benchmarks.tune or a network of benchmarks.train"
        text = f"{name}={locations[0]} must be {allowed}: {error}"
        raise UsageError(f"--agent: {text}") from error
    return ControllerSpec(
        name=name,
        label=name,
        look=OWN_LOOKS[0],
        build=_build,
        prior_knowledge=(*EVERYTHING, *LIMITS),
        networks=partial(_load_all, locations),
        random=True,
        pictured=True,
    )


def _with_searched_gains(name: str, file: Path) -> ControllerSpec:
    """Return the record of a controller with the gains in a file of `benchmarks.tune`.

    `name` is the user's name for the controller, and `file` is the JSON file.
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
    """Return the record of a controller with the policies in files of `benchmarks.train ppo`.

    `name` is the user's name for the controller, and `files` are NPZ files with one policy
    each.
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


@dataclass(frozen=True)
class UserCode:
    """A user's own controller, as loaded from a location that the option `--agent` names.

    Attributes
    ----------
    factory : callable
        Returns a policy, or a tuple of a policy and the environment that the policy acts in.
    observation : mapping
        How many samples of each signal the policy observes, by the environment's arguments,
        such as `{"error_window": 3}`.
    provenance : mapping
        Texts for the report: "knows" (the prior knowledge), "searched" (the training) and
        "note" (a remark), each of which may be missing.
    """

    factory: Callable[..., Any]
    observation: Mapping[str, int]
    provenance: Mapping[str, Any]


def _load_all(locations: Sequence[str]) -> dict[str, UserCode]:
    """Load a user's controllers, and return the loaded controllers by location.

    `locations` are texts MODULE:FACTORY or ALGORITHM:FILE.zip. A `UsageError` names a location
    whose code raises an error.
    """
    codes = {}
    for location in locations:
        load = _load_zip if location.endswith(".zip") else _import_factory
        try:
            codes[location] = load(location)
        except (Exception, SystemExit) as error:  # A user's code may raise any error.
            text = f"{location!r} cannot be loaded: {type(error).__name__}: {error}"
            raise UsageError(f"--agent: {text}") from error
    return codes


def _import_factory(location: str) -> UserCode:
    """Import the user's function at the location MODULE:FACTORY.

    `benchmarks/compare/README.md` describes the arguments, the result and the attributes of
    this function. A ValueError is raised if the attribute `observation` has an unknown name.
    """
    factory: Any = pkgutil.resolve_name(location)
    observation = dict(getattr(factory, "observation", PAPER_WINDOWS))
    if not set(observation) <= set(WINDOWS):
        allowed = ", ".join(WINDOWS)
        raise ValueError(f"observation must have names out of {allowed}, got {observation}")
    provenance = {name: str(getattr(factory, name, "")) for name in ("knows", "searched")}
    return UserCode(factory, observation, provenance)


def _load_zip(location: str) -> UserCode:
    """Load a model of Stable-Baselines3 from the location ALGORITHM:FILE.zip.

    If `mptc_gym.sb3.save` wrote the file, the file describes the environment that the model
    acts in. Otherwise, the model acts in `MiddlePoint-v0` without wrappers.
    """
    import stable_baselines3  # imported here, as PyTorch takes seconds to load

    from mptc_gym.sb3 import load

    algorithm, _, file = location.partition(":")
    provenance = {}
    try:
        model: Any = load(file, device="cpu")
    except ValueError:  # The file is not one of `mptc_gym.sb3.save`.
        kind: Any = getattr(stable_baselines3, algorithm, None)
        kind = kind or pkgutil.resolve_name(f"sb3_contrib:{algorithm}")
        model = kind.load(file, device="cpu")
        note = f"{file} names no environment: run in the plain one, without wrappers."
        provenance["note"] = note
    weights = sum(weight.numel() for weight in model.policy.parameters())
    samples = f"{model.num_timesteps / 1e6:.3g} M samples a policy"
    provenance["searched"] = f"{weights:,} weights: {samples}"
    return UserCode(lambda: model, PAPER_WINDOWS, provenance)


def _build(*, network: UserCode, **prior_knowledge: Any) -> Any:
    """Return a user's controller, made by calling the user's factory.

    Parameters
    ----------
    network
        The loaded code. It takes the place of the trained network of other controllers, hence
        the name of the argument.
    prior_knowledge
        What the controller may know about the plant: quantities by name. The factory is called
        with the quantities that are among the parameters of the factory, or with all quantities
        if the factory has `**kwargs`.
    """
    accepted = inspect.signature(network.factory).parameters
    accepts_all = any(argument.kind is argument.VAR_KEYWORD for argument in accepted.values())
    arguments = {
        name: value
        for name, value in prior_knowledge.items()
        if accepts_all or name in accepted
    }
    product = network.factory(**arguments)
    if hasattr(product, "reset") and hasattr(product, "act"):
        return product
    if isinstance(product, tuple):
        policy, env = product
        return Policy(policy, env, prior_knowledge["num_envs"])
    return Policy(product, None, prior_knowledge["num_envs"])


@dataclass
class Policy:
    """A policy in any form that `mptc_gym.evaluate` takes, as a controller of the benchmarks.

    Attributes
    ----------
    policy
        The policy.
    env
        The environment that the policy acts in, or a function that makes an environment. None
        stands for the environment that was saved with a model of Stable-Baselines3, or for
        `MiddlePoint-v0` without wrappers if no environment was saved.
    runs : int
        Number of runs in a batch.
    """

    policy: Any
    env: Any
    runs: int

    def reset(self) -> None:
        """Begin an episode: set `act` to a function from observations to actions.

        Observations have the shape (runs, elements), and actions have the shape (runs, 1).
        """
        self.act = start(self.policy, self.runs)

    @contextmanager
    def opened(self, samples: int, **arguments: Any) -> Iterator[Any]:
        """Yield a vector environment of `runs` plants with the wrappers that the policy needs.

        Parameters
        ----------
        samples
            Length of an episode, in samples.
        arguments
            Arguments of the environment that define the case.

        Raises
        ------
        UsageError
            If the policy brings its own environment and this environment has other parameters
            than the case, or if the policy does not fit the observations.
        """
        env, env_arguments = self._environment({**arguments, "max_episode_steps": samples})
        with opened(env, self.runs, self.policy, **env_arguments) as plants:
            with blame("--agent"):
                case = case_of(Parameters(**arguments))
                if any(case_of(group.parameters) != case for group in plant_groups(plants)):
                    raise ValueError("the environment must have the parameters of the case")
                check_fit(self.policy, plants)
            yield plants

    def _environment(self, arguments: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        """Return the first argument of `opened`, and the keyword arguments of the environment.

        The first argument is an environment, a function that makes one, an id or an `EnvSpec`.
        `arguments` are the keyword arguments of `gymnasium.make` that define the case. The
        returned arguments are `arguments`, or empty if the environment is already defined.
        """
        if self.env is not None:
            return self.env, {}
        if getattr(self.policy, "get_env", lambda: None)() is None:
            return IDS["paper"], arguments
        from mptc_gym.sb3 import spec_of

        # A saved model has the windows and wrappers of its training.
        without_windows = {name: arguments[name] for name in arguments if name not in WINDOWS}
        return spec_of(self.policy, **without_windows), {}
