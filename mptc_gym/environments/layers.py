"""Look into environments of any kind: their layers, their plants and their wrappers.

A layer is one environment object in a nesting: a wrapper, a vector environment or an innermost
environment.
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
# layers leave actions as they are, and leave observations as they are or add noise.
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
    """Plants with the same arguments and wrappers: one environment, or one batch of plants."""

    parameters: Parameters
    num_envs: int
    name: str  # id of the environment, or the name of the class of an environment without an id
    # The classes of the wrappers that change observations or actions, outermost first.
    wrappers: tuple[str, ...]


def loaded(name: str) -> Any:
    """Return the class with the full name `name`, or () if its module has not been imported.

    The result is the second argument of an `isinstance`, which is False for (). So an optional
    package need not be imported to recognise objects of the package.
    """
    module, _, class_name = name.rpartition(".")
    return getattr(sys.modules.get(module), class_name, ())


def is_environment(env: Any) -> bool:
    """Whether `env` is an environment or a vector environment.

    Objects of Gymnasium, and a `VecEnv` of Stable-Baselines3, count.
    """
    return isinstance(env, (gymnasium.Env, VectorEnv, loaded(f"{VEC_ENV}.VecEnv")))


def runs_processes(layer: Any) -> bool:
    """Whether a layer runs its inner environments in other processes."""
    return isinstance(layer, (AsyncVectorEnv, loaded(f"{VEC_ENV}.SubprocVecEnv")))


def normaliser_flag(layer: Any) -> str:
    """Return the attribute that switches updates of a layer's statistics on and off.

    The result is "" if the layer does not normalise observations or rewards by statistics.
    """
    if isinstance(layer, loaded(f"{VEC_ENV}.VecNormalize")):
        return "training"
    # The wrappers of Gymnasium that normalise, of one environment or of many.
    return "update_running_mean" if hasattr(type(layer), "update_running_mean") else ""


def inner_environments(env: Any) -> list[Any]:
    """Return the environments directly within `env`; none that run in other processes."""
    inner: list[Any] = []
    for name in INNER:
        value = vars(env).get(name)
        candidates = value if isinstance(value, list | tuple) else [value]
        inner += [candidate for candidate in candidates if is_environment(candidate)]
    return inner


def layers(env: Any) -> Iterator[Any]:
    """Yield the environment `env` and all environments within it, the outermost first.

    Environments in other processes are not included.
    """
    yield env
    for inner in inner_environments(env):
        yield from layers(inner)


def plant_groups(env: Any, outer: tuple[str, ...] = ()) -> list[PlantGroup]:
    """Return a description of the plants in an environment, in the order of the plants.

    Plants in other processes are included.

    Parameters
    ----------
    env
        An environment of any kind.
    outer
        The names of the wrappers around `env`, outermost first.

    Returns
    -------
    list of PlantGroup
        One element for each environment or batch of plants. The list is empty if `env` holds no
        plants of this package in NumPy, or if the processes of `env` are closed.
    """
    wrappers = outer
    if _changes_policy(env):
        increments = vars(env).get("increments", "")  # the arguments of an IncrementalAction
        limit = vars(env).get("clip_obs")  # of a VecNormalize
        name = f"{type(env).__name__}{increments}"
        wrappers = (*outer, name if limit is None else f"{name}(clip_obs={limit:g})")
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
    """Whether a layer is a wrapper that may change observations or actions of a policy."""
    of_rewards = gymnasium.RewardWrapper, gymnasium.vector.VectorRewardWrapper
    if type(layer).__name__ in _NEUTRAL or isinstance(layer, of_rewards):
        return False
    if not vars(layer).get("norm_obs", True):  # a VecNormalize of rewards alone
        return False
    wrappers = gymnasium.Wrapper, gymnasium.vector.VectorWrapper
    return isinstance(layer, (*wrappers, loaded(f"{VEC_ENV}.VecEnvWrapper")))


def ask_processes(env: Any, method: str, *arguments: Any) -> list[Any]:
    """Return what a method returns for each environment in other processes.

    If an environment lacks the method, or if a result cannot be pickled, the process of this
    environment ends.

    Parameters
    ----------
    env
        An `AsyncVectorEnv` of Gymnasium or a `SubprocVecEnv` of Stable-Baselines3.
    method
        Name of the method to call.
    *arguments
        Arguments of the method.
    """
    ask = getattr(env, "env_method", None) or env.call
    return list(ask(method, *arguments))


def _groups_in_processes(env: Any, outer: tuple[str, ...]) -> list[PlantGroup]:
    """Return the plants in other processes, as `plant_groups` does; [] if these are closed.

    `env` runs the processes, and `outer` holds the names of the wrappers around `env`.
    """
    try:
        texts = ask_processes(env, "__str__")
        if not all(ask_processes(env, "has_wrapper_attr", "parameters")):
            return []
        parameters = env.get_attr("parameters")
    except Exception:  # whatever closed or broken processes raise
        return []
    groups = []
    for text, plant_parameters in zip(texts, parameters, strict=True):
        # An example of a text is "<TimeLimit<MiddlePointEnv<MiddlePoint-v0>>>". For an
        # environment without an id, it is "<TimeLimit<MiddlePointEnv instance>>".
        *classes, last = text.strip("<>").split("<")
        wrappers = tuple(name for name in classes if name not in _NEUTRAL)
        if isinstance(plant_parameters, Parameters):
            name = last.removesuffix(" instance")
            groups.append(PlantGroup(plant_parameters, 1, name, outer + wrappers))
    return groups
