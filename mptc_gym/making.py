"""Make environments from ids, specs and functions: one, or many in one batch."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any

import gymnasium
from gymnasium.envs.registration import EnvSpec

from mptc_gym.checks import reject
from mptc_gym.env import MiddlePointEnv
from mptc_gym.presets import IDS
from mptc_gym.vector_env import MiddlePointVectorEnv
from mptc_gym.wrappers.vector import IncrementalAction

Env = gymnasium.Env[Any, Any]


def make_one(env: str | EnvSpec, arguments: Mapping[str, Any]) -> Env:
    """Make an environment from an id or a spec; ValueError if it cannot be found."""
    try:
        return gymnasium.make(env, **{"disable_env_checker": True, **arguments})
    except (gymnasium.error.Error, ImportError):
        close = difflib.get_close_matches(str(env), IDS.values(), n=1)
        hint = f"did you mean {close[0]}?" if close else f"such as {IDS['paper']}"
        reject("env", env, f"the id of an environment ({hint})")


def make_batch(single: Env, n: int, **modes: Any) -> Any:
    """Return n of an environment in one batch, or None for a foreign one or its wrappers.

    `modes` are the `render_mode` and the `autoreset_mode` of the batch.
    """
    spec, plant = single.spec, single.unwrapped
    if spec is None or type(plant) is not MiddlePointEnv:
        return None
    wrappers = {wrapper.entry_point for wrapper in spec.additional_wrappers}
    if wrappers - {"mptc_gym.wrappers:IncrementalAction"}:
        return None
    modes["max_episode_steps"] = spec.max_episode_steps
    plants: Any = MiddlePointVectorEnv(n, **modes, **asdict(plant.parameters))
    plants.spec = spec
    for wrapper in spec.additional_wrappers:
        plants = IncrementalAction(plants, **(wrapper.kwargs or {}))
    return plants


def make_by(function: Callable[[], Any], n: int) -> list[Env]:
    """Return n environments that a function makes, one a call."""
    environments: list[Env] = []
    plants = set()  # the identities of the innermost environments
    for _ in range(n):
        env = function()
        if not isinstance(env, gymnasium.Env):
            allowed = "a function that makes one environment; where it makes many, call it"
            reject("env", env, allowed)
        if id(env.unwrapped) in plants:
            allowed = "a function that makes another environment in each call"
            reject("env", function, allowed)
        plants.add(id(env.unwrapped))
        environments.append(env)
    return environments
