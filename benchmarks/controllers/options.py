"""Read the options that choose controllers: of the roster, or a user's own.

The code of a user's own runs in the tasks that need it: what is wrong with it costs no other.
"""

from __future__ import annotations

import glob
import hashlib
import importlib
import inspect
import pkgutil
import sys
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from agents.controller import PAPER_WINDOWS
from agents.networks import WINDOWS
from benchmarks.controllers.roster import OWN, ROSTER, Controller, limits
from benchmarks.lib.command import FanOut, Names, Repeated, blame, options
from benchmarks.lib.storage import UsageError
from benchmarks.loop.rollout import make_plants
from mptc_gym import MiddlePointEnv, Parameters
from mptc_gym.acting import opened, start
from mptc_gym.evaluation import case_of
from mptc_gym.wrappers.vector import IncrementalAction

AgentNames = Annotated[Names, Parameter(help="Controllers to run.", choices=ROSTER)]
_ADVICE = (
    "write a function that returns the policy, or the policy and the environment that it acts "
    "in, and give --agent NAME=MODULE:FUNCTION"
)


@options
@dataclass(frozen=True, kw_only=True)
class ControllerOptions:
    """A user's own controllers, and where controllers run."""

    agent: Repeated = ()
    """A controller of your own in addition to those of --agents, NAME=MODULE:FACTORY or
    NAME=PPO:FILE.zip, of Stable-Baselines3; loading a zip runs the code in it. The same name
    again adds another training of it (repeatable)."""
    fan_out: FanOut = field(default_factory=FanOut)


def chosen(names: Sequence[str], own: Sequence[str] = ()) -> dict[str, Controller]:
    """Return controllers of the roster by name, then a user's own, as given to `--agent`."""
    locations: dict[str, list[str]] = {}
    for text in own:
        name, equals, location = text.partition("=")
        taken = f", and {name!r} is taken" if name.lower() in ROSTER else ""
        if taken or not (name and equals):
            raise UsageError(
                "--agent must be NEW_NAME=MODULE:FACTORY or NEW_NAME=PPO:FILE.zip"
                f"{taken}, got {text!r}"
            )
        locations.setdefault(name, []).append(location)
    found = {name: ROSTER[name] for name in names}
    found |= {name: own_entry(name, each) for name, each in locations.items()}
    if not found:
        raise UsageError("--agents, --agent: no controller to run")
    return found


def own_entry(name: str, locations: Sequence[str]) -> Controller:
    """Return the record of a user's own controller, with a member or more for each location.

    Its `members` raises a `UsageError` that says what is wrong with a location.
    """
    read = partial(_read, tuple(locations))
    return Controller(name, name, OWN[0], _make, networks=read, random=True, drawn=True)


@dataclass(frozen=True)
class Own:
    """What is found at a location."""

    make: Callable[..., Any]
    """Function of the arguments that `_make` offers, as far as it takes them by name; it
    returns a policy, or a policy and the environment that it acts in."""
    observation: Mapping[str, int]
    provenance: Mapping[str, Any]


def _read(locations: Sequence[str]) -> dict[str, Own]:
    found: dict[str, Own] = {}
    for location in locations:
        with blame("--agent"):
            if location.endswith(".zip"):
                algorithm, _, pattern = location.partition(":")
                if not pattern:
                    raise ValueError(f"{location!r} must be such as PPO:{location}")
                files = sorted(glob.glob(pattern))  # noqa: PTH207 (patterns of absolute paths, too)
                if not files:
                    raise ValueError(f"{location!r}: there is no file {pattern}")
                found |= {file: _saved(algorithm, Path(file).resolve()) for file in files}
            else:
                found[location] = _function(location)
    return found


def _function(location: str) -> Own:
    """Import a user's factory, `module:factory`; a ValueError says what is expected.

    The README of `benchmarks.compare` lists the arguments and attributes it may have.
    """
    try:
        made_by: Any = pkgutil.resolve_name(location)
    except (Exception, SystemExit) as error:  # whatever the code of a user raises
        text = f"{type(error).__name__}: {error}"
        raise ValueError(f"{location!r} cannot be imported: {text}") from error
    if not callable(made_by):
        raise ValueError(f"{location!r} must be MODULE:FACTORY, got {made_by!r}")
    observation = getattr(made_by, "observation", PAPER_WINDOWS)
    if not (isinstance(observation, Mapping) and set(observation) <= set(WINDOWS)):
        raise ValueError(
            f"observation of {made_by!r} must be a dict with names out of "
            f"{', '.join(WINDOWS)}, got {observation!r}"
        )
    about = {name: str(getattr(made_by, name, "")) for name in ("knows", "searched")}
    source = getattr(sys.modules[made_by.__module__], "__file__", None)
    if source:
        about["sha256"] = hashlib.sha256(Path(source).read_bytes()).hexdigest()
    return Own(made_by, dict(observation), about)


def _make(plant: Parameters, runs: int, seed: int, *, network: Own) -> Any:
    """Call a user's factory with the arguments that it accepts, by name."""
    offered = {"parameters": plant, "num_envs": runs, "seed": seed, **limits(plant)}
    accepted = inspect.signature(network.make).parameters
    if not any(each.kind is each.VAR_KEYWORD for each in accepted.values()):
        offered = {name: offered[name] for name in offered if name in accepted}
    made = network.make(**offered)
    if hasattr(made, "reset") and hasattr(made, "act"):
        return made
    policy, env = made if isinstance(made, tuple) else (made, None)
    return Policy(policy, env, plant, runs)


@dataclass
class Policy:
    """A policy in any form that `mptc_gym.evaluate` takes, and what it acts in."""

    policy: Any
    env: Any
    """None for the plain environment, arguments of `IncrementalAction` for it in that wrapper,
    or an environment, or a function that makes one."""
    plant: Parameters
    runs: int

    def reset(self) -> None:
        """Start an episode."""
        self._act = start(self.policy, self.runs)

    def act(self, observation: Any) -> Any:
        """Return actions, shape (runs, 1)."""
        return self._act(observation)

    @contextmanager
    def opened(self, samples: int, **arguments: Any) -> Iterator[Any]:
        """Yield the plants that it acts in, with these arguments or refused."""
        if self.env is None or isinstance(self.env, Mapping):
            with closing(make_plants(self.runs, samples, **arguments)) as plants:
                yield IncrementalAction(plants, **self.env) if self.env else plants
            return
        with opened(self.env, self.runs) as given:
            if {case_of(each.parameters) for each in given.plants} != {case_of(self.plant)}:
                raise ValueError("the environment must have the parameters that it is made for")
            yield given


def _saved(algorithm: str, file: Path) -> Own:
    """Return a model, which acts as its file says, or else in the plain environment."""
    from mptc_gym.sb3 import MEMBER, load, spec_of  # here: PyTorch takes seconds to load

    says, windows, moves = True, dict(PAPER_WINDOWS), None
    with suppress(zipfile.BadZipFile), zipfile.ZipFile(file) as archive:
        says = MEMBER in archive.namelist()
    model = load(file, device="cpu") if says else _plain(algorithm, file)
    if type(model).__name__ != algorithm:
        raise ValueError(f"{file} holds a model of {type(model).__name__}, not of {algorithm}")
    if says:
        spec = spec_of(model)
        names = [each.name for each in spec.additional_wrappers]
        if names not in ([], ["IncrementalAction"]):
            acts_in = f"{', '.join(names)}, not in IncrementalAction alone"
            raise ValueError(f"{file} acts in {acts_in}: {_ADVICE}")
        moves = spec.additional_wrappers[0].kwargs if names else None
        plant = Parameters.of_environment(spec.kwargs)
        windows = {name: getattr(plant, name) for name in WINDOWS}
    weights = sum(weight.numel() for weight in model.policy.parameters())
    samples = f"{model.num_timesteps / 1e6:.3g} M samples a policy"
    about = {
        "file": file.name,
        "sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
        "searched": f"{weights:,} weights: {samples}",
    }
    return Own(lambda: (model, moves), windows, about)


def _plain(algorithm: str, file: Path) -> Any:
    """Return a model that does not say where it acts, if it may be in the plain environment."""
    for package in ("stable_baselines3", "sb3_contrib"):
        with suppress(ImportError):
            if kind := getattr(importlib.import_module(package), algorithm, None):
                model, plain = kind.load(file, device="cpu"), MiddlePointEnv()
                spaces = plain.observation_space, plain.action_space
                if (model.observation_space, model.action_space) != spaces:
                    raise ValueError(f"{file} does not act in the plain environment: {_ADVICE}")
                return model
    raise ValueError(f"{algorithm} must be an algorithm of Stable-Baselines3, such as PPO")
