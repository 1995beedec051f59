"""Make roster entries of a user's own controllers: MODULE:FACTORY, or PPO:model.zip."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from functools import partial
from typing import Any

import numpy as np

from agents.policy_network import WINDOWS
from benchmarks.controllers.engineered import limits
from benchmarks.controllers.records import Cost, Factory, RosterEntry
from benchmarks.lib.command_line import blame
from benchmarks.loop.rollout import Agent, make_plants
from mptc_gym import Parameters


def _made(made_by: Callable[..., Agent], plant: Parameters, runs: int, seed: int) -> Agent:
    """Call a user's factory with what it accepts, by name."""
    offered = {"parameters": plant, "num_envs": runs, "seed": seed, **limits(plant)}
    accepted = inspect.signature(made_by).parameters
    if any(each.kind is each.VAR_KEYWORD for each in accepted.values()):
        return made_by(**offered)
    return made_by(**{name: offered[name] for name in offered if name in accepted})


def own_factory(location: str) -> Factory:
    """Import a user's factory, `module:factory`, and try it out.

    It is called with keyword arguments, those of the following that it has: `num_envs` (runs
    in the batch), `seed` (run i is to use `seed + i`), `u_min`, `u_max` (t/h) and `parameters`
    (all arguments of the environment). It returns an object with `reset()` and
    `act(observations) -> actions`. Its attribute `observation`, if it has one, is a dict of the
    environment's `*_window` arguments, and gives the controller the observation that it wants.
    Its attributes `prior_knowledge`, `parameters` and `samples` fill its row in the report's
    table of costs.

    Raises
    ------
    ValueError
        If there is no such factory, or if what it makes is not a controller of a batch; the
        message says what is expected.
    """
    found = _imported(location)
    observation = getattr(found, "observation", {})
    if not isinstance(observation, Mapping):
        raise ValueError(f"observation of {found!r} must be a dict, got {observation!r}")
    for name in observation:
        if name not in WINDOWS:
            raise ValueError(
                f"observation of {found!r} must have names out of {', '.join(WINDOWS)}, "
                f"got {name!r}"
            )
    cost = Cost(*(str(getattr(found, each.name, "")) for each in fields(Cost)))
    factory = Factory(
        partial(_made, found), dict(observation), code=found.__module__, cost=cost
    )
    _try_out(factory, repr(found))
    return factory


def own_entry(name: str, locations: Sequence[str]) -> RosterEntry:
    """Return an entry for a user's own controller, with one member or more for each location.

    Raises
    ------
    UsageError
        As `own_factory` and `benchmarks.controllers.saved.policies` raise a ValueError.
    """
    factories: list[Factory] = []
    with blame("--agent"):
        for location in locations:
            if location.endswith(".zip"):
                from benchmarks.controllers import saved  # here: PyTorch takes seconds to load

                factories += saved.policies(location)
            else:
                factories.append(own_factory(location))
    return RosterEntry(name, name, lambda request: factories, drawn=True)


def _imported(location: str) -> Callable[..., Any]:
    module_name, _, name = location.partition(":")
    if not (module_name and name):
        raise ValueError(f"{location!r} must be module:factory")
    try:
        found: Callable[..., Any] = getattr(importlib.import_module(module_name), name)
    except (ImportError, AttributeError, ValueError, TypeError) as error:
        raise ValueError(f"{location!r} cannot be imported: {error}") from error
    if not callable(found):
        raise ValueError(f"{location!r} must be callable, got {found!r}")
    return found


def _try_out(factory: Factory, shown: str) -> None:
    """Have a factory's controller act once on two plants."""
    controller = factory({}, 2, 0)
    for method in ("reset", "act"):
        if not callable(getattr(controller, method, None)):
            raise ValueError(
                f"{shown} must return an object with reset() and act(observations), "
                f"got {controller!r}"
            )
    plants = make_plants(2, 1, **factory.observation)
    observations, _ = plants.reset(seed=0)
    plants.close()
    expected = (
        f"act must take observations of shape {observations.shape}, one row a plant, and "
        "return actions of shape (2, 1)"
    )
    controller.reset()
    try:
        actions = np.asarray(controller.act(observations), np.float64)
    except Exception as error:
        raise ValueError(f"{expected}; it raised {type(error).__name__}: {error}") from error
    if actions.shape != (2, 1):
        raise ValueError(f"{expected}, got shape {actions.shape}")
