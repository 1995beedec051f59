"""Make roster entries from a user's own controllers: MODULE:FACTORY, or PPO:model.zip."""

from __future__ import annotations

import inspect
import pkgutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from functools import partial
from typing import Any

from agents.policy_network import WINDOWS
from benchmarks.controllers.engineered import limits
from benchmarks.controllers.records import Cost, Factory, RosterEntry
from benchmarks.lib.command import blame
from benchmarks.loop.rollout import Agent
from mptc_gym import Parameters


def own_entry(name: str, locations: Sequence[str]) -> RosterEntry:
    """Return an entry for a user's own controller, with one or more members per location.

    Raises
    ------
    UsageError
        Where `own_factory` or `benchmarks.controllers.saved.policies` raises a ValueError.
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
    return RosterEntry(name, name, lambda: factories, drawn=True)


def own_factory(location: str) -> Factory:
    """Import a user's factory, `module:factory`.

    The README of `benchmarks.compare` lists the arguments and attributes it may have.

    Raises
    ------
    ValueError
        If there is no such factory; the message says what is expected.
    """
    try:
        found: Any = pkgutil.resolve_name(location)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"{location!r} cannot be imported: {error}") from error
    if not callable(found):
        raise ValueError(f"{location!r} must be MODULE:FACTORY, got {found!r}")
    observation = getattr(found, "observation", {})
    if not (isinstance(observation, Mapping) and set(observation) <= set(WINDOWS)):
        raise ValueError(
            f"observation of {found!r} must be a dict with names out of {', '.join(WINDOWS)}, "
            f"got {observation!r}"
        )
    cost = Cost(*(str(getattr(found, each.name, "")) for each in fields(Cost)))
    return Factory(partial(_made, found), cost, dict(observation), code=found.__module__)


def _try_out(factory: Factory, location: str) -> None:
    """Run a controller for two samples on two plants; raise a ValueError if it fails."""
    size = Parameters(**factory.arguments({})).observation_size
    try:
        factory.run({}, samples=2, runs=2, seed=0)
    except (Exception, SystemExit) as error:
        raise ValueError(
            f"{location!r} must give an object with reset() and act(observations), and act "
            f"take observations of shape (2, {size}), one row a plant, and return actions of "
            f"shape (2, 1); trying it raised {type(error).__name__}: {error}"
        ) from error


def _made(made_by: Callable[..., Agent], plant: Parameters, runs: int, seed: int) -> Agent:
    """Call a user's factory with the arguments that it accepts, by name."""
    offered = {"parameters": plant, "num_envs": runs, "seed": seed, **limits(plant)}
    accepted = inspect.signature(made_by).parameters
    if any(each.kind is each.VAR_KEYWORD for each in accepted.values()):
        return made_by(**offered)
    return made_by(**{name: offered[name] for name in offered if name in accepted})
