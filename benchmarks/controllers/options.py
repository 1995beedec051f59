"""Read the options that choose controllers: of the roster, or a user's own.

A user's own code runs in the tasks that need it, so that a fault in it costs no other task.
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
from benchmarks.lib.command import FanOut, Names, Parameter, blame, known, options
from benchmarks.lib.errors import UsageError
from mptc_gym import IDS, Parameters
from mptc_gym.evaluation import case_of
from mptc_gym.layers import plant_groups
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
    """Return names of the roster without repetitions; a `UsageError` names unknown ones."""
    for name in names:
        if name in RENAMED:
            raise UsageError(f"{option}: {name!r} is now called {RENAMED[name]!r}")
    return known(option, names, ROSTER)


def chosen(
    names: Sequence[str], user_controllers: Sequence[str] = ()
) -> dict[str, ControllerSpec]:
    """Return the records of controllers by name.

    Parameters
    ----------
    names
        Controllers of the roster, as in the option `--agents`.
    user_controllers
        A user's own controllers, in the form NAME=LOCATION of the option `--agent`. Several
        locations under one name become the members of one controller.

    Raises
    ------
    UsageError
        If there is no controller, a name is unknown or taken, or a location does not exist.
        A module or a zip file is loaded by the method `members` of the record, which raises
        the error if loading fails.
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
    """Return the name and the location in a value of `--agent`; `UsageError` if one is bad."""
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
    """Return the record of a user's own controller, a member for each location."""
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
    """Return the controller with the gains in a file of `benchmarks.tune`."""
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
    """Return the controller with the policies in files of `benchmarks.train ppo`."""
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
    """The code at a location of `--agent`.

    Attributes
    ----------
    factory : callable
        Returns a policy, or a policy and the environment that the policy acts in.
    observation : mapping
        The windows of the observation, by the environment's arguments.
    provenance : mapping
        What the report says about the controller.
    """

    factory: Callable[..., Any]
    observation: Mapping[str, int]
    provenance: Mapping[str, Any]


def _load_all(locations: Sequence[str]) -> dict[str, UserCode]:
    """Return the code at each location; a `UsageError` names a location that is faulty."""
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
    """Import MODULE:FACTORY; the README of `benchmarks.compare` describes a factory."""
    factory: Any = pkgutil.resolve_name(location)
    observation = dict(getattr(factory, "observation", PAPER_WINDOWS))
    if not set(observation) <= set(WINDOWS):
        allowed = ", ".join(WINDOWS)
        raise ValueError(f"observation must have names out of {allowed}, got {observation}")
    provenance = {name: str(getattr(factory, name, "")) for name in ("knows", "searched")}
    return UserCode(factory, observation, provenance)


def _load_zip(location: str) -> UserCode:
    """Load ALGORITHM:FILE.zip, a model of Stable-Baselines3.

    A model acts in the environment that its file describes, or else in the plain environment.
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
    """Return a user's controller, made with the arguments that its factory accepts by name."""
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
        The environment that the policy acts in, or a function that makes one. None stands for
        the environment that is saved with a model, or else for the plain environment.
    runs : int
        Number of runs in a batch.
    """

    policy: Any
    env: Any
    runs: int

    def reset(self) -> None:
        """Start an episode: `act` is then the function of observations that returns actions."""
        self.act = start(self.policy, self.runs)

    @contextmanager
    def opened(self, samples: int, **arguments: Any) -> Iterator[Any]:
        """Yield the plants that the policy acts in, for episodes of `samples` samples.

        `arguments` are the environment's. A `UsageError` is raised if the policy's own
        environment has other parameters, or if the policy does not fit its observations.
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
        """Return an environment in a form that `opened` takes, and its arguments beyond that.

        `arguments` are those of `gymnasium.make`.
        """
        if self.env is not None:
            return self.env, {}
        if getattr(self.policy, "get_env", lambda: None)() is None:
            return IDS["paper"], arguments
        from mptc_gym.sb3 import spec_of

        # A saved model has the windows and wrappers of its training.
        without_windows = {name: arguments[name] for name in arguments if name not in WINDOWS}
        return spec_of(self.policy, **without_windows), {}
