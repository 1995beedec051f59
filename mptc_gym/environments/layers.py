"""Find the plants and the wrappers in an environment of any kind.

A layer is one of the objects that form an environment: a wrapper, a vector environment or an
innermost environment.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import gymnasium
from gymnasium.vector import AsyncVectorEnv, VectorEnv

from mptc_gym.env import MiddlePointEnv
from mptc_gym.plant.parameters import Parameters
from mptc_gym.vector_env import MiddlePointVectorEnv

VEC_ENV: Final = "stable_baselines3.common.vec_env"
# The attributes in which a wrapper or vector environment of Gymnasium, Stable-Baselines3 or
# this package holds inner environments.
INNER: Final = ("venv", "env", "envs", "batches")
# Class names of layers that may differ between a policy's training and an evaluation: these
# layers leave actions as they are, and leave observations that are not pictures as they are.
_NEUTRAL: Final = frozenset({
    "MiddlePointEnv",
    "AsyncVectorEnv", "DummyVecEnv", "GymnasiumVecEnv", "SubprocVecEnv", "SyncVectorEnv",
    "Autoreset", "DictInfoToList", "Monitor", "OrderEnforcing", "PassiveEnvChecker",
    "RecordEpisodeStatistics", "TimeLimit", "VecCheckNan", "VecMonitor",
    "ClipReward", "NormalizeReward", "TransformReward", "VectorizeTransformReward",
    "AddWhiteNoise", "DataCollector", "HumanRendering", "ObstructView", "RecordVideo",
    "RenderCollection", "VecVideoRecorder",
})  # fmt: skip


class PlantGroup(NamedTuple):
    """Description of one environment, or of one batch of plants with equal arguments."""

    parameters: Parameters
    num_envs: int
    name: str  # id of the environment, or the name of the class of an environment without an id
    # The classes of the wrappers that change observations or actions, outermost first.
    wrappers: tuple[str, ...]


def loaded(name: str) -> Any:
    """Return the class with the full name `name`, or () if the module is not imported.

    Since `isinstance(env, ())` is False, a caller can test for a class of an optional package
    without importing that package.
    """
    module, _, class_name = name.rpartition(".")
    return getattr(sys.modules.get(module), class_name, ())


def is_environment(env: Any) -> bool:
    """Return whether `env` is an `Env` or `VectorEnv` of Gymnasium, or a `VecEnv` of SB3."""
    return isinstance(env, (gymnasium.Env, VectorEnv, loaded(f"{VEC_ENV}.VecEnv")))


def runs_processes(layer: Any) -> bool:
    """Return whether `layer` runs environments in worker processes."""
    return isinstance(layer, (AsyncVectorEnv, loaded(f"{VEC_ENV}.SubprocVecEnv")))


def normaliser_flag(layer: Any) -> str:
    """Return the name of the attribute that enables the updates of a normalising wrapper.

    The returned name is "" if `layer` does not normalise observations or rewards by running
    statistics.
    """
    if isinstance(layer, loaded(f"{VEC_ENV}.VecNormalize")):
        return "training"
    if hasattr(type(layer), "update_running_mean"):  # a wrapper of Gymnasium
        return "update_running_mean"
    return ""


def inner_environments(env: Any) -> list[Any]:
    """Return the environments directly inside `env`, without those in worker processes."""
    inner: list[Any] = []
    for name in INNER:
        value = vars(env).get(name)
        candidates = value if isinstance(value, list | tuple) else [value]
        inner += [candidate for candidate in candidates if is_environment(candidate)]
    return inner


def layers(env: Any) -> Iterator[Any]:
    """Yield `env` and all environments within `env` in this process, the outermost first."""
    yield env
    for inner in inner_environments(env):
        yield from layers(inner)


def plant_groups(env: Any, outer: tuple[str, ...] = ()) -> list[PlantGroup]:
    """Return descriptions of the plants in `env`, including plants in worker processes.

    Parameters
    ----------
    env
        An environment of any kind.
    outer
        Class names of the wrappers around `env`, the outermost first.

    Returns
    -------
    list of PlantGroup
        One `PlantGroup` for each environment or batch of plants, in the order of the plants.
        The returned list is empty if `env` holds no plants of this package in NumPy, or if the
        worker processes of `env` are closed.
    """
    wrappers = outer
    if _changes_policy(env):
        wrapper = type(env).__name__
        if "increments" in vars(env):  # an IncrementalAction
            wrapper += f"{env.increments}"
        clip_obs = vars(env).get("clip_obs")
        if clip_obs is not None:  # a VecNormalize
            wrapper += f"(clip_obs={clip_obs:g})"
        wrappers = (*outer, wrapper)
    if isinstance(env, MiddlePointEnv | MiddlePointVectorEnv):
        name = env.spec.id if env.spec else type(env).__name__
        return [PlantGroup(env.parameters, getattr(env, "num_envs", 1), name, wrappers)]
    if runs_processes(env):
        return _groups_in_processes(env, wrappers)
    groups: list[PlantGroup] = []
    for inner in inner_environments(env):
        groups += plant_groups(inner, wrappers)
    return groups


def _changes_policy(layer: Any) -> bool:
    """Return whether `layer` is a wrapper that may change observations or actions."""
    reward_wrappers = gymnasium.RewardWrapper, gymnasium.vector.VectorRewardWrapper
    if type(layer).__name__ in _NEUTRAL or isinstance(layer, reward_wrappers):
        return False
    if not vars(layer).get("norm_obs", True):  # a VecNormalize of rewards alone
        return False
    wrappers = gymnasium.Wrapper, gymnasium.vector.VectorWrapper
    return isinstance(layer, (*wrappers, loaded(f"{VEC_ENV}.VecEnvWrapper")))


def ask_processes(env: Any, method: str, *arguments: Any) -> list[Any]:
    """Call a method of the environment in each worker process, and return the results.

    `env` is an `AsyncVectorEnv` of Gymnasium or a `SubprocVecEnv` of Stable-Baselines3. A
    worker process ends if the environment in the process lacks the method `method`, or if the
    result of the method cannot be pickled.
    """
    call_each = getattr(env, "env_method", None) or env.call
    return list(call_each(method, *arguments))


def _groups_in_processes(env: Any, outer: tuple[str, ...]) -> list[PlantGroup]:
    """Return descriptions of the plants in the worker processes of a vector environment.

    `outer` holds the class names of the wrappers around `env`, the outermost first. The
    returned list is empty if the worker processes are closed, or if an environment has no
    attribute `parameters`, as is usual for environments of other packages.
    """
    try:
        texts = ask_processes(env, "__str__")
        if not all(ask_processes(env, "has_wrapper_attr", "parameters")):
            return []
        parameters = env.get_attr("parameters")
    except Exception:  # closed or broken processes raise various errors
        return []
    groups = []
    for text, parameters_of_plant in zip(texts, parameters, strict=True):
        # A text names the layers of an environment, as in
        # "<TimeLimit<MiddlePointEnv<MiddlePoint-v0>>>", or without an id
        # "<TimeLimit<MiddlePointEnv instance>>".
        *classes, innermost = text.strip("<>").split("<")
        wrappers = tuple(name for name in classes if name not in _NEUTRAL)
        if isinstance(parameters_of_plant, Parameters):
            name_of_plant = innermost.removesuffix(" instance")
            groups.append(PlantGroup(parameters_of_plant, 1, name_of_plant, outer + wrappers))
    return groups
