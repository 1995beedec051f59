"""Read the options that choose controllers: of the roster, or a user's own.

The code of a user's own runs in the tasks that need it: what is wrong with it costs no other.
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

AgentNames = Annotated[Names, Parameter(help=f"Controllers to run, of {', '.join(ROSTER)}.")]
FORMS = (
    "NEW_NAME=MODULE:FACTORY, NEW_NAME=PPO:FILE.zip, NEW_NAME=gains.json of benchmarks.tune or "
    "NEW_NAME=FILE.npz of benchmarks.train"
)


@options
@dataclass(frozen=True, kw_only=True)
class ControllerOptions:
    """A user's own controllers, and where controllers run."""

    agent: Names = ()
    """A controller of your own in addition to those of --agents: NAME=MODULE:FACTORY;
    NAME=PPO:FILE.zip, of Stable-Baselines3 (loading a zip runs the code in it);
    NAME=gains.json, which benchmarks.tune writes; or NAME=FILE.npz, of benchmarks.train. The
    same name again adds another training of it."""
    fan_out: FanOut = field(default_factory=FanOut)


def agent_names(option: str, names: Sequence[str]) -> list[str]:
    """Return names of the roster, each once; a `UsageError` names what is not in it."""
    for name in names:
        if name in RENAMED:
            raise UsageError(f"{option}: {name!r} is now called {RENAMED[name]!r}")
    return known(option, names, ROSTER)


def chosen(names: Sequence[str], own: Sequence[str] = ()) -> dict[str, ControllerSpec]:
    """Return controllers of the roster by name, then a user's own, as given to `--agent`.

    These have a member for each location. A `UsageError` names what is missing or not of the
    right form; `members` raises one for a faulty module or zip.
    """
    if not (names or own):
        raise UsageError("--agents, --agent: no controller to run")
    specs = {name: ROSTER[name] for name in agent_names("--agents", names)}
    locations: dict[str, list[str]] = {}
    for text in own:
        name, location = _split(text)
        locations.setdefault(name, []).append(location)
    for name, places in locations.items():
        specs[name] = _own_spec(name, places)
    return specs


def _split(text: str) -> tuple[str, str]:
    """Return the name and the location in a value of `--agent`; `UsageError` if one is bad."""
    name, _, location = text.partition("=")
    taken = f"; {name!r} is taken" if name.lower() in ROSTER else ""
    module, colon, file = location.partition(":")
    if location.endswith((".json", ".npz")):
        exists = Path(location).is_file()
    elif location.endswith(".zip"):
        exists = bool(colon) and Path(file).is_file()
    else:
        package = module.partition(".")[0] or "-"
        exists = bool(colon and file) and importlib.util.find_spec(package) is not None
    if taken or not (name and exists):
        raise UsageError(
            f"--agent: {text!r} must be {FORMS}, of a module or a file that is there{taken}"
        )
    return name, location


def _own_spec(name: str, locations: Sequence[str]) -> ControllerSpec:
    """Return the record of a user's own controller at these locations."""
    files = [Path(location) for location in locations]
    suffixes = {file.suffix for file in files}
    if (".json" in suffixes and len(files) > 1) or (".npz" in suffixes and len(suffixes) > 1):
        listed = " and ".join(locations)
        raise UsageError(
            f"--agent: {name!r} must be one gains.json or several .npz, got {listed}"
        )
    try:
        if suffixes == {".json"}:
            return _searched(name, files[0])
        if suffixes == {".npz"}:
            return _trained(name, files)
    except (KeyError, OSError, TypeError, ValueError) as error:
        wanted = "a gains.json of benchmarks.tune or a network of benchmarks.train"
        raise UsageError(f"--agent: {name}={locations[0]} must be {wanted}: {error}") from error
    return ControllerSpec(
        name=name,
        label=name,
        look=OWN_LOOKS[0],
        build=_make,
        prior_knowledge=(*EVERYTHING, *LIMITS),
        networks=partial(_load_all, locations),
        random=True,
        pictured=True,
    )


def _searched(name: str, file: Path) -> ControllerSpec:
    """Return the controller whose gains `benchmarks.tune` found, for the plant it used."""
    content = json.loads(file.read_text(encoding="utf-8"))
    spec = ROSTER[content["controller"]].with_gains(content["gains"])
    about = {"made_for": content["plant"], "searched": content["searched"]}
    return replace(spec, name=name, label=name, knows=content["knows"], **about)


def _trained(name: str, files: Sequence[Path]) -> ControllerSpec:
    """Return the policies that `benchmarks.train ppo` wrote, for the plant it used."""
    networks = {str(file): PolicyNetwork.load(file) for file in files}
    first = next(iter(networks.values())).provenance
    samples = f"{first.get('steps', 0) / 1e6:.3g} M samples a policy"
    return replace(
        ROSTER["ppo"],
        name=name,
        label=name,
        knows="trained on a simulator of this plant",
        searched=f"trained by PPO: {samples}",
        made_for=first.get("plant", {}),
        networks=partial(dict, networks),
    )


@dataclass(frozen=True)
class UserCode:
    """What a location of `--agent` holds."""

    factory: Callable[..., Any]  # returns a policy, or it and the environment that it acts in
    observation: Mapping[str, int] = field(default_factory=lambda: PAPER_WINDOWS)
    provenance: Mapping[str, Any] = field(default_factory=dict)


def _load_all(locations: Sequence[str]) -> dict[str, UserCode]:
    """Return what each location holds, by location."""
    return {location: _loaded(location) for location in locations}


def _loaded(location: str) -> UserCode:
    """Return what a location holds, a module or a zip; `UsageError` if it is faulty."""
    try:
        return _saved(location) if location.endswith(".zip") else _imported(location)
    except (Exception, SystemExit) as error:  # whatever a user's code or file raises
        text = f"{location!r} cannot be loaded: {type(error).__name__}: {error}"
        raise UsageError(f"--agent: {text}") from error


def _imported(location: str) -> UserCode:
    """Import a user's factory; the README of `benchmarks.compare` says what it may have."""
    factory: Any = pkgutil.resolve_name(location)
    observation = dict(getattr(factory, "observation", PAPER_WINDOWS))
    if not set(observation) <= set(WINDOWS):
        allowed = ", ".join(WINDOWS)
        raise ValueError(f"observation must have names out of {allowed}, got {observation}")
    about = {name: str(getattr(factory, name, "")) for name in ("knows", "searched")}
    return UserCode(factory, observation, about)


def _saved(location: str) -> UserCode:
    """Load a model, which acts as its file says, or else in the plain environment."""
    import stable_baselines3  # here: PyTorch takes seconds to load

    from mptc_gym.sb3 import load

    (algorithm, _, file), about = location.partition(":"), {}
    try:
        model: Any = load(file, device="cpu")
    except ValueError:  # not of `mptc_gym.sb3.save`
        kind: Any = getattr(stable_baselines3, algorithm, None)
        kind = kind or pkgutil.resolve_name(f"sb3_contrib:{algorithm}")
        model = kind.load(file, device="cpu")
        about["note"] = f"{file} names no environment: run in the plain one, without wrappers."
    weights = sum(weight.numel() for weight in model.policy.parameters())
    samples = f"{model.num_timesteps / 1e6:.3g} M samples a policy"
    about["searched"] = f"{weights:,} weights: {samples}"
    return UserCode(lambda: model, provenance=about)


def _make(*, network: UserCode, **known: Any) -> Any:
    """Call a user's factory with the arguments that it accepts, by name."""
    accepted = inspect.signature(network.factory).parameters
    takes_all = any(argument.kind is argument.VAR_KEYWORD for argument in accepted.values())
    arguments = {name: known[name] for name in known if takes_all or name in accepted}
    controller = network.factory(**arguments)
    if hasattr(controller, "reset") and hasattr(controller, "act"):
        return controller
    policy, env = controller if isinstance(controller, tuple) else (controller, None)
    return Policy(policy, env, known["num_envs"])


@dataclass
class Policy:
    """A policy in any form that `mptc_gym.evaluate` takes, and what it acts in."""

    policy: Any
    # Environment, or what makes one; None for that saved with the model, or else the plain one.
    env: Any
    runs: int

    def reset(self) -> None:
        """Start an episode."""
        self.act = start(self.policy, self.runs)

    @contextmanager
    def opened(self, samples: int, **arguments: Any) -> Iterator[Any]:
        """Yield the plants that it acts in, with these arguments or refused."""
        env, more = self.env, {}
        if env is None:
            env, more = IDS["paper"], {**arguments, "max_episode_steps": samples}
            if getattr(self.policy, "get_env", lambda: None)() is not None:
                from mptc_gym.sb3 import spec_of

                plant = {each: more[each] for each in more if each not in WINDOWS}
                env, more = spec_of(self.policy, **plant), {}
        with opened(env, self.runs, self.policy, **more) as given:
            with blame("--agent"):
                case = case_of(Parameters(**arguments))
                if any(case_of(group.parameters) != case for group in plant_groups(given)):
                    raise ValueError("the environment must have the parameters of the case")
                check_fit(self.policy, given)
            yield given
