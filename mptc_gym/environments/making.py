"""Make environments from ids and specs (`EnvSpec`): one environment, or many in one batch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import gymnasium
from gymnasium.envs.registration import EnvSpec

from mptc_gym.env import MiddlePointEnv
from mptc_gym.plant.checks import shorten
from mptc_gym.vector_env import MiddlePointVectorEnv
from mptc_gym.wrappers.vector import IncrementalAction

Env = gymnasium.Env[Any, Any]


def make_one(env: str | EnvSpec, arguments: Mapping[str, Any]) -> Env:
    """Make one environment by `gymnasium.make`, without Gymnasium's environment checker.

    Parameters
    ----------
    env
        An id such as "MiddlePoint-v0", or an `EnvSpec`.
    arguments
        Further arguments of `gymnasium.make`, by name.

    Raises
    ------
    ValueError
        If the environment cannot be found, or an argument is out of range.
    """
    try:
        return gymnasium.make(env, **{"disable_env_checker": True, **arguments})
    except (gymnasium.error.Error, ImportError) as error:
        raise ValueError(
            f"env must be the id of an environment such as MiddlePoint-v0, got {shorten(env)}: "
            f"{error}"
        ) from error


def make_batch(single: Env, n: int, **modes: Any) -> Any:
    """Return n environments like `single` in one batch, or None if no batch can hold them.

    Parameters
    ----------
    single
        An environment from `gymnasium.make`, wrapped or not.
    n
        Number of environments.
    **modes
        The `render_mode` and the `autoreset_mode` of the vector environment.

    Returns
    -------
    VectorEnv or None
        A `MiddlePointVectorEnv`, wrapped as `single`. None if `single` is not a
        `MiddlePointEnv`, or has a wrapper other than `IncrementalAction` and the wrappers of
        `gymnasium.make`.
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
