"""Factories of controllers: how they are found, tried out, and called for a batch of runs."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol, cast, runtime_checkable

import numpy as np

from benchmarks.rollout import Agent, make_plants
from mptc_gym import Parameters

Factory = Callable[..., Agent]

WINDOWS = ("setpoint_window", "error_window", "output_window", "action_window")


@runtime_checkable
class HasProvenance(Protocol):
    """A factory of a trained policy, which can say where the policy comes from."""

    @property
    def provenance(self) -> dict[str, Any]:
        """In a form for JSON."""


@runtime_checkable
class HasCurve(Protocol):
    """A factory of a trained policy with its learning curve."""

    @property
    def curve(self) -> list[dict[str, float]]:
        """A row an evaluation."""


def try_out(factory: Factory) -> None:
    """Have a factory's controller act once on two plants.

    Raises
    ------
    ValueError
        If it is not a controller of a batch; the message says what is expected.
    """
    windows = observation(factory)
    parameters = Parameters(**windows)
    controller = build(factory, parameters, 2, 0)
    for method in ("reset", "act"):
        if not callable(getattr(controller, method, None)):
            raise ValueError(
                f"{factory!r} must return an object with reset() and act(observations), "
                f"got {controller!r}"
            )
    plants = make_plants(2, 1, **windows)
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


def load(location: str) -> Callable[..., Any]:
    """Import what `module:name` names.

    Raises
    ------
    ValueError
        If there is no such module, or nothing callable of that name in it.
    """
    module_name, _, name = location.partition(":")
    if not (module_name and name):
        raise ValueError(f"{location!r} must be module:factory")
    try:
        found = getattr(importlib.import_module(module_name), name)
    except (ImportError, AttributeError, ValueError, TypeError) as error:
        raise ValueError(f"{location!r} cannot be imported: {error}") from error
    if not callable(found):
        raise ValueError(f"{location!r} must be callable, got {found!r}")
    return cast("Callable[..., Any]", found)


def load_factory(location: str) -> Factory:
    """Import a factory.

    Parameters
    ----------
    location
        `module:factory`. The factory is called with keyword arguments, those of the following
        that it has: `num_envs` (runs in the batch), `seed` (run i is to use `seed + i`),
        `u_min`, `u_max` (t/h) and `parameters` (all arguments of the environment). It returns
        an object with `reset()` and `act(observations) -> actions`. Its attribute
        `observation`, if it has one, is a dict of the environment's `*_window` arguments, and
        gives the controller the observation that it wants.

    Returns
    -------
    callable
        The factory.

    Raises
    ------
    ValueError
        If there is no such module or factory, or if its `observation` is not valid.
    """
    factory = cast("Factory", load(location))
    observation(factory)
    return factory


def build(factory: Factory, parameters: Parameters, num_envs: int, seed: int) -> Agent:
    """Call a factory with the arguments that it accepts; see `load_factory`."""
    offered: dict[str, Any] = {
        "num_envs": num_envs,
        "seed": seed,
        "u_min": parameters.range_of("u_min")[0],
        "u_max": parameters.range_of("u_max")[1],
        "parameters": parameters,
    }
    accepted = inspect.signature(factory).parameters
    if any(parameter.kind is parameter.VAR_KEYWORD for parameter in accepted.values()):
        return factory(**offered)
    return factory(**{name: value for name, value in offered.items() if name in accepted})


def provenances(members: Mapping[str, Sequence[object]]) -> dict[str, list[dict[str, Any]]]:
    """Return the provenance of every trained policy, by the name of its controller."""
    found = {
        name: [each.provenance for each in factories if isinstance(each, HasProvenance)]
        for name, factories in members.items()
    }
    return {name: each for name, each in found.items() if each}


def curve(factory: object) -> list[dict[str, float]] | None:
    """Return the learning curve of a factory's policy; None if it has none."""
    return factory.curve if isinstance(factory, HasCurve) else None


def observation(factory: Factory) -> dict[str, Any]:
    """Return the arguments of the environment that give a factory's controllers their input.

    Raises
    ------
    ValueError
        If it is not a dict, or holds other arguments: all controllers have the same plant.
    """
    arguments = getattr(factory, "observation", {})
    if not isinstance(arguments, Mapping):
        raise ValueError(f"observation of {factory!r} must be a dict, got {arguments!r}")
    for name in arguments:
        if name not in WINDOWS:
            raise ValueError(
                f"observation of {factory!r} must have names out of {', '.join(WINDOWS)}, "
                f"got {name!r}"
            )
    return dict(arguments)
