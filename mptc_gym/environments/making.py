"""Make one environment from an id or an `EnvSpec`, or many such environments in a batch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import gymnasium
from gymnasium.envs.registration import EnvSpec

from mptc_gym.env import MiddlePointEnv
from mptc_gym.plant.checks import shorten
from mptc_gym.presets import IDS
from mptc_gym.vector_env import MiddlePointVectorEnv
from mptc_gym.wrappers.vector import IncrementalAction

Env = gymnasium.Env[Any, Any]


def make_one(env: str | EnvSpec, arguments: Mapping[str, Any]) -> Env:
    """Make one environment with `gymnasium.make`, without Gymnasium's environment checker.

    Parameters
    ----------
    env
        Environment id, such as "MiddlePoint-v0", or an `EnvSpec`.
    arguments
        Keyword arguments of `gymnasium.make`, by name.

    Raises
    ------
    ValueError
        If the environment `env` cannot be found, if a value in `arguments` is out of range, or
        if `env` is the name of a preset, such as "hard", in place of the preset's id.
    """
    if isinstance(env, str) and env in IDS:
        raise ValueError(f"env must be an id: write {IDS[env]} for the preset {env}")
    try:
        return gymnasium.make(env, **{"disable_env_checker": True, **arguments})
    except (gymnasium.error.Error, ImportError) as error:
        raise ValueError(
            f"env must be the id of an environment such as MiddlePoint-v0, got {shorten(env)}: "
            f"{error}"
        ) from error


def make_batch(single: Env, n: int, **modes: Any) -> Any:
    """Return a vector environment of n environments like `single`, or None.

    Parameters
    ----------
    single
        Environment from `gymnasium.make`, with or without wrappers.
    n
        Number of environments.
    **modes
        Values of `render_mode` and `autoreset_mode` for the vector environment.

    Returns
    -------
    VectorEnv or None
        A `MiddlePointVectorEnv` with n plants, with the arguments and the wrappers of `single`.
        None if `single` has no `EnvSpec`, if the innermost environment of `single` is not a
        `MiddlePointEnv`, or if `single` has a wrapper other than `IncrementalAction` and the
        wrappers of `gymnasium.make`.
    """
    spec = single.spec
    plant = single.unwrapped
    if spec is None or type(plant) is not MiddlePointEnv:
        return None
    wrappers = {wrapper.entry_point for wrapper in spec.additional_wrappers}
    if wrappers - {"mptc_gym.wrappers:IncrementalAction"}:
        return None
    envs: Any = MiddlePointVectorEnv(
        n, max_episode_steps=spec.max_episode_steps, **modes, **asdict(plant.parameters)
    )
    envs.spec = spec
    for wrapper in spec.additional_wrappers:
        envs = IncrementalAction(envs, **(wrapper.kwargs or {}))
    return envs
