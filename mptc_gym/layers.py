"""Look into environments of any kind: their layers, their plants and their wrappers."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import suppress
from typing import Any, Final, NamedTuple

import gymnasium
from gymnasium.vector import AsyncVectorEnv, VectorEnv

from mptc_gym.env import MiddlePointEnv
from mptc_gym.parameters import Parameters
from mptc_gym.vector_env import MiddlePointVectorEnv

VEC_ENV: Final = "stable_baselines3.common.vec_env"
# Where environments of Gymnasium, Stable-Baselines3 and this package hold those within them.
INNER: Final = ("venv", "env", "envs", "batches")
# Layers that change neither observations nor actions, by the name of their class.
_NEUTRAL: Final = frozenset({
    "AsyncVectorEnv", "DummyVecEnv", "GymnasiumVecEnv", "SubprocVecEnv", "SyncVectorEnv",
    "Autoreset", "DictInfoToList", "Monitor", "OrderEnforcing", "PassiveEnvChecker",
    "RecordEpisodeStatistics", "TimeLimit", "VecCheckNan", "VecMonitor",
    "ClipReward", "NormalizeReward", "TransformReward", "VectorizeTransformReward",
    "AddWhiteNoise", "DataCollector", "HumanRendering", "ObstructView", "RecordVideo",
    "RenderCollection", "VecVideoRecorder",
})  # fmt: skip

Chain = tuple[str, ...]  # of wrappers, outermost first


class PlantGroup(NamedTuple):
    """Plants with the same arguments: one environment, or one batch."""

    parameters: Parameters
    num_envs: int
    name: str  # id of the environment, or the name of its class where it has none


def loaded(name: str) -> Any:
    """Return a class by its full name if it is imported; otherwise (), without instances."""
    module, _, class_name = name.rpartition(".")
    return getattr(sys.modules.get(module), class_name, ())


def is_environment(env: Any) -> bool:
    """Whether this is an environment or many, of Gymnasium or of Stable-Baselines3."""
    return isinstance(env, (gymnasium.Env, VectorEnv, loaded(f"{VEC_ENV}.VecEnv")))


def runs_processes(layer: Any) -> bool:
    """Whether a layer runs its environments in other processes."""
    return isinstance(layer, (AsyncVectorEnv, loaded(f"{VEC_ENV}.SubprocVecEnv")))


def inner_environments(env: Any) -> list[Any]:
    """Return the environments directly within an environment of this process."""
    inner: list[Any] = []
    for name in INNER:
        value = vars(env).get(name)
        candidates = value if isinstance(value, list | tuple) else [value]
        inner += [candidate for candidate in candidates if is_environment(candidate)]
    return inner


def layers(env: Any) -> Iterator[Any]:
    """Yield an environment and all environments of this process within it."""
    yield env
    for inner in inner_environments(env):
        yield from layers(inner)


def have_a_layer_in_common(env: Any, other: Any) -> bool:
    """Whether two environments have a layer in common."""
    identities = {id(layer) for layer in layers(other)}
    return any(id(layer) in identities for layer in layers(env))


def plant_groups(env: Any) -> list[PlantGroup]:
    """Return the plants in an environment, in their order; none if it is not open."""
    groups: list[PlantGroup] = []
    for layer in layers(env):
        if isinstance(layer, MiddlePointEnv | MiddlePointVectorEnv):
            name = layer.spec.id if layer.spec else type(layer).__name__
            groups.append(PlantGroup(layer.parameters, getattr(layer, "num_envs", 1), name))
        elif runs_processes(layer):
            groups += Processes(layer).plant_groups()
    return groups


def wrapper_chains(env: Any) -> set[Chain]:
    """Return what changes observations and actions of each plant, outermost first.

    The wrappers of a plant are named by their classes, `IncrementalAction` with its arguments.
    Plants that are wrapped alike share one element. Environments in other processes that do
    not answer are left out.
    """
    outer: Chain = ()
    if _changes_policy(env):
        outer = (_described(type(env).__name__, vars(env).get("increments")),)
    inner = inner_environments(env)
    if runs_processes(env):
        inner_chains = Processes(env).wrapper_chains()
    elif inner:
        inner_chains = set().union(*map(wrapper_chains, inner))
    else:
        return {()}
    return {outer + chain for chain in inner_chains}


def _changes_policy(layer: Any) -> bool:
    """Whether a layer is a wrapper that may change the observations or the actions."""
    of_rewards = gymnasium.RewardWrapper, gymnasium.vector.VectorRewardWrapper
    if type(layer).__name__ in _NEUTRAL or isinstance(layer, of_rewards):
        return False
    if not vars(layer).get("norm_obs", True):  # a VecNormalize of rewards alone
        return False
    wrappers = gymnasium.Wrapper, gymnasium.vector.VectorWrapper
    return isinstance(layer, (*wrappers, loaded(f"{VEC_ENV}.VecEnvWrapper")))


def _described(class_name: str, increments: Any) -> str:
    """Return how a wrapper is named: by its class, and its increments where it has any."""
    return class_name if increments is None else f"{class_name}{increments}"


class Processes:
    """Environments in other processes, which are asked through pipes.

    A question that an environment cannot answer, or whose answer cannot be pickled, ends its
    process. So each is asked only for what it has, and for what this package defined.
    """

    def __init__(self, env: Any) -> None:
        self._env = env
        self._ask = getattr(env, "env_method", None) or env.call
        self._names: list[_Names] = []
        with suppress(Exception):  # whatever closed or broken ones raise
            self._names = [_Names.of(text) for text in self._ask("__str__")]

    def plant_groups(self) -> list[PlantGroup]:
        """Return the plants; none if the processes are closed or run something else."""
        groups = []
        for names, parameters in zip(self._names, self._values("parameters"), strict=False):
            if isinstance(parameters, Parameters):
                groups.append(PlantGroup(parameters, 1, names.plant))
        return groups

    def wrapper_chains(self) -> set[Chain]:
        """Return what changes observations and actions: see the function of this name."""
        increments = self._values("increments")
        chains = set()
        for index, names in enumerate(self._names):
            chain = []
            for class_name in names.wrappers:
                if class_name == "IncrementalAction" and increments:
                    chain.append(_described(class_name, increments[index]))
                elif class_name not in _NEUTRAL:
                    chain.append(class_name)
            chains.add(tuple(chain))
        return chains

    def seeds(self) -> list[int]:
        """Return the latest seed of each environment."""
        return list(self._env.get_attr("np_random_seed")) if self._names else []

    def normalise(self) -> bool:
        """Whether a wrapper of Gymnasium normalises in one of the processes."""
        return bool(self._names) and any(self._ask("has_wrapper_attr", "update_running_mean"))

    def _values(self, name: str) -> list[Any]:
        """Return an attribute of each environment; nothing unless all have it."""
        if self._names and all(self._ask("has_wrapper_attr", name)):
            return list(self._env.get_attr(name))
        return []


class _Names(NamedTuple):
    """The names in the text of an environment of Gymnasium."""

    wrappers: list[str]  # classes, outermost first
    plant: str  # id of the innermost environment, or the name of its class

    @classmethod
    def of(cls, text: str) -> _Names:
        """Read a text such as "<TimeLimit<MiddlePointEnv<MiddlePoint-v0>>>"."""
        *outer, last = text.strip("<>").split("<")
        if last.endswith(" instance"):  # without an id: "<TimeLimit<MiddlePointEnv instance>>"
            return cls(outer, last.removesuffix(" instance"))
        return cls(outer[:-1], last)
