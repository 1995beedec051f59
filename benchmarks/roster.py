"""The controllers that can be compared, by name, and how one is built for a batch of runs."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable
from typing import Any, cast

from benchmarks.rollout import Agent
from mptc_gym import Parameters

Factory = Callable[..., Agent]

BUILT_IN: dict[str, str] = {
    "nn": "agents:DirectNNController",
    "pi": "agents:PIController",
    "pi-simc": "benchmarks.opponents:simc_pi",
    "pi-searched": "benchmarks.opponents:searched_pi",
    "smith": "benchmarks.opponents:smith",
    "mpc": "benchmarks.opponents:mpc",
}
WINDOWS = ("setpoint_window", "error_window", "output_window", "action_window")
LABELS: dict[str, str] = {
    "nn": "NN",
    "pi": "PI",
    "pi-simc": "PI, SIMC",
    "pi-searched": "PI, searched",
    "smith": "Smith",
    "mpc": "MPC",
    "ppo": "PPO",
    "ppo-randomised": "PPO, randomised",
    "nn-frozen": "NN, frozen",
}


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
        If there is no such module or factory in it.
    """
    module_name, _, name = location.partition(":")
    if not (module_name and name):
        raise ValueError(f"{location!r} must be module:factory")
    try:
        factory = getattr(importlib.import_module(module_name), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"{location!r} must be module:factory: {error}") from error
    if not callable(factory):
        raise ValueError(f"{location!r} must be callable, got {factory!r}")
    return cast("Factory", factory)


def build(factory: Factory, parameters: Parameters, num_envs: int, seed: int) -> Agent:
    """Call a factory with those of the arguments it can be offered that it has."""
    offered: dict[str, Any] = {
        "num_envs": num_envs,
        "seed": seed,
        "u_min": parameters.u_min,
        "u_max": parameters.u_max,
        "parameters": parameters,
    }
    accepted = inspect.signature(factory).parameters
    if any(parameter.kind is parameter.VAR_KEYWORD for parameter in accepted.values()):
        return factory(**offered)
    return factory(**{name: value for name, value in offered.items() if name in accepted})


def observation(factory: Factory) -> dict[str, Any]:
    """Return the arguments of the environment that give a factory's controllers their input.

    Raises
    ------
    ValueError
        If there are others among them: everyone is to control the same plant.
    """
    arguments = dict(getattr(factory, "observation", {}))
    for name in arguments:
        if name not in WINDOWS:
            raise ValueError(
                f"observation of {factory!r} must have names out of {', '.join(WINDOWS)}, "
                f"got {name!r}"
            )
    return arguments


def label(agent: str) -> str:
    """Return the name of a controller in tables and plots."""
    return LABELS.get(agent, agent)
