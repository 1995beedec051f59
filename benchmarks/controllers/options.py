"""Read the options that choose controllers: of the roster, or a user's own.

A user's own is MODULE:FACTORY, or PPO:FILE.zip.
"""

from __future__ import annotations

import hashlib
import inspect
import pkgutil
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import Annotated, Any, cast

from cyclopts import Parameter

from agents.controller import PAPER_WINDOWS
from agents.policy_network import WINDOWS
from benchmarks.controllers.engineered import limits
from benchmarks.controllers.records import Cost, Factory, RosterEntry
from benchmarks.controllers.roster import OWN, ROSTER
from benchmarks.lib.command import Names, Repeated, UsageError, blame, options
from benchmarks.lib.fan_out import FanOut
from benchmarks.loop.rollout import Agent
from mptc_gym import Parameters
from mptc_gym.policies import start

AgentNames = Annotated[Names, Parameter(help="Controllers to run.", choices=ROSTER)]


@options
@dataclass(frozen=True, kw_only=True)
class ControllerOptions:
    """A user's own controllers, and where controllers run."""

    agent: Repeated = ()
    """A controller of your own in addition to those of --agents, NAME=MODULE:FACTORY or
    NAME=PPO:FILE.zip, of Stable-Baselines3; loading a zip runs the code in it. The same name
    again adds another training of it (repeatable)."""
    fan_out: FanOut = field(default_factory=FanOut)


def chosen(names: Sequence[str], own: Sequence[str] = ()) -> dict[str, RosterEntry]:
    """Return controllers of the roster by name, then a user's own, as given to `--agent`.

    A `UsageError` says what is wrong with a user's own, or that there is no controller at all.
    """
    found = {name: ROSTER[name] for name in names}
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
    found |= {name: own_entry(name, each) for name, each in locations.items()}
    if not found:
        raise UsageError("--agents, --agent: no controller to run")
    return found


def own_entry(name: str, locations: Sequence[str]) -> RosterEntry:
    """Return an entry for a user's own controller, with one or more members per location.

    A `UsageError` says what is wrong with a location.
    """
    factories: list[Factory] = []
    with blame("--agent"):
        for location in locations:
            if location.endswith(".zip"):
                from benchmarks.controllers import saved  # here: PyTorch takes seconds to load

                made = saved.policies(location)
            else:
                made = [own_factory(location)]
            for factory in made:
                _try_out(factory, location)
            factories += made
    return RosterEntry(name, name, OWN[0], lambda: factories, drawn=True)


def own_factory(location: str) -> Factory:
    """Import a user's factory, `module:factory`; a ValueError says what is expected.

    The README of `benchmarks.compare` lists the arguments and attributes it may have.
    """
    try:
        found: Any = pkgutil.resolve_name(location)
    except (Exception, SystemExit) as error:  # whatever the code of a user raises
        text = f"{type(error).__name__}: {error}"
        raise ValueError(f"{location!r} cannot be imported: {text}") from error
    if not callable(found):
        raise ValueError(f"{location!r} must be MODULE:FACTORY, got {found!r}")
    observation = getattr(found, "observation", PAPER_WINDOWS)
    if not (isinstance(observation, Mapping) and set(observation) <= set(WINDOWS)):
        raise ValueError(
            f"observation of {found!r} must be a dict with names out of {', '.join(WINDOWS)}, "
            f"got {observation!r}"
        )
    cost = Cost(*(str(getattr(found, each.name, "")) for each in fields(Cost)))
    source = getattr(sys.modules[found.__module__], "__file__", None)
    code = hashlib.sha256(Path(source).read_bytes()).hexdigest() if source else ""
    return Factory(partial(_made, location), cost, dict(observation), code=code)


def _try_out(factory: Factory, location: str) -> None:
    """Run a controller for two samples on two plants; raise a ValueError if it fails."""
    size = Parameters(**factory.arguments({})).observation_size
    try:
        factory.run({}, samples=2, runs=2, seed=0)
    except (Exception, SystemExit) as error:
        raise ValueError(
            f"{location!r} must give an object with reset() and act(observations), or another "
            "policy that mptc_gym.evaluate takes, with or without its own environment; "
            f"it must take observations of shape (2, {size}), one row a plant, and return "
            f"actions of shape (2, 1); trying it raised {type(error).__name__}: {error}"
        ) from error


def _made(location: str, plant: Parameters, runs: int, seed: int) -> Agent:
    """Call a user's factory with the arguments that it accepts, by name."""
    made_by: Callable[..., Agent] = pkgutil.resolve_name(location)
    offered = {"parameters": plant, "num_envs": runs, "seed": seed, **limits(plant)}
    accepted = inspect.signature(made_by).parameters
    if not any(each.kind is each.VAR_KEYWORD for each in accepted.values()):
        offered = {name: offered[name] for name in offered if name in accepted}
    made: Any = made_by(**offered)
    policy, env = made if isinstance(made, tuple) else (made, None)
    if env is None and hasattr(policy, "reset") and hasattr(policy, "act"):
        return cast("Agent", policy)
    return OwnPolicy(policy, env, runs)


class OwnPolicy:
    """A policy in any form that `mptc_gym.evaluate` takes, and the environment it acts in."""

    def __init__(self, policy: Any, env: Any, runs: int) -> None:
        self.policy, self.env, self._runs = policy, env, runs

    def reset(self) -> None:
        """Start an episode."""
        self._act = start(self.policy, self._runs)

    def act(self, observation: Any) -> Any:
        """Return actions, shape (runs, 1)."""
        return self._act(observation)
