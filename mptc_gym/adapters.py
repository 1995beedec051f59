"""Adapt environments of any kind to one interface, by which a policy acts in them.

Each kind has its adapter. All have the same two methods: `reset(seeds)` and `step(actions)`
return a `Sample` of all plants.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium.vector import VectorEnv
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array, iterate
from numpy.typing import NDArray

from mptc_gym.layers import PlantGroup, loaded, plant_groups

Infos = Mapping[str, Any]  # arrays, one element per plant


class Sample(NamedTuple):
    """What n plants show at one sample."""

    observations: Any  # one row per plant, as the policy sees them
    infos: Infos  # those of the last sample, where the same step begins the next episode
    ended: NDArray[np.bool_]  # whose episode has ended, shape (n,)


class Plants(ABC):
    """Environments of one kind, as a rollout steps them.

    Attributes
    ----------
    environments : list
        What the policy acts in, to look into.
    num_envs : int
        Number n of plants.
    observation_space, action_space : gymnasium.Space
        Those of one plant.
    are_trusted : bool
        Whether the package made them, so that they surely run the episodes of their seeds.
    """

    environments: list[Any]
    num_envs: int
    observation_space: Any
    action_space: Any
    are_trusted = False

    @abstractmethod
    def reset(self, seeds: list[int]) -> Sample:
        """Reset all plants, with a seed each."""

    @abstractmethod
    def step(self, actions: NDArray[Any]) -> Sample:
        """Step all plants."""

    @cached_property
    def groups(self) -> list[PlantGroup]:
        """The plants, in their order; none if the environments are not open."""
        return [group for env in self.environments for group in plant_groups(env)]

    def close(self) -> None:
        """Close the environments."""
        for env in self.environments:
            env.close()


class SeparatePlants(Plants):
    """Environments of Gymnasium with one plant each, stepped one after another."""

    def __init__(self, environments: Sequence[gymnasium.Env[Any, Any]]) -> None:
        self.environments = [*environments]
        self.num_envs = len(environments)
        self.observation_space = environments[0].observation_space
        self.action_space = environments[0].action_space
        self._actions = batch_space(self.action_space, self.num_envs)

    def reset(self, seeds: list[int]) -> Sample:
        """Reset all plants, with a seed each."""
        observations, infos = [], []
        for env, seed in zip(self.environments, seeds, strict=True):
            observation, info = env.reset(seed=seed)
            observations.append(_in_numpy(observation))
            infos.append(info)
        return Sample(
            self._stacked(observations), _columns(infos), np.zeros(self.num_envs, np.bool_)
        )

    def step(self, actions: NDArray[Any]) -> Sample:
        """Step all plants."""
        observations, infos = [], []
        ended = np.zeros(self.num_envs, np.bool_)
        for index, action in enumerate(iterate(self._actions, actions)):
            observation, _, terminated, truncated, info = self.environments[index].step(action)
            observations.append(observation)
            infos.append(info)
            ended[index] = terminated or truncated
        return Sample(self._stacked(observations), _columns(infos), ended)

    def _stacked(self, observations: list[Any]) -> Any:
        """Return observations in one array, or in one of each part of the space."""
        space = self.observation_space
        empty: Any = create_empty_array(space, self.num_envs)
        return concatenate(space, observations, empty)


class VectorPlants(Plants):
    """A vector environment of Gymnasium, also one that runs in other processes."""

    def __init__(self, env: VectorEnv[Any, Any, Any]) -> None:
        self.environments = [env]
        self._env: Any = env
        self.num_envs = env.num_envs
        self.observation_space = env.single_observation_space
        self.action_space = env.single_action_space

    def reset(self, seeds: list[int]) -> Sample:
        """Reset all plants, with a seed each."""
        observations, infos = self._env.reset(seed=seeds)
        return Sample(
            _in_numpy(observations), _as_columns(infos), np.zeros(self.num_envs, np.bool_)
        )

    def step(self, actions: NDArray[Any]) -> Sample:
        """Step all plants."""
        observations, _, terminated, truncated, infos = self._env.step(actions)
        columns = _as_columns(infos)
        last = columns.get("final_info", columns)
        return Sample(observations, last, terminated | truncated)


class VecEnvPlants(Plants):
    """A `VecEnv` of Stable-Baselines3, also one that runs in other processes."""

    def __init__(self, env: Any) -> None:
        self.environments = [env]
        self._env = env
        self._innermost = env.unwrapped
        self.num_envs = env.num_envs
        self.observation_space = env.observation_space
        self.action_space = env.action_space

    def reset(self, seeds: list[int]) -> Sample:
        """Reset all plants, with seeds that follow one another."""
        # Plants in groups share seeds unless they are set one by one.
        set_seeds = getattr(self._innermost, "set_seeds", None)
        if set_seeds is None:
            self._env.seed(seeds[0])
        else:
            set_seeds(seeds)
        observations = self._env.reset()
        infos = _columns(self._innermost.reset_infos)
        return Sample(observations, infos, np.zeros(self.num_envs, np.bool_))

    def step(self, actions: NDArray[Any]) -> Sample:
        """Step all plants."""
        observations, _, ended, infos = self._env.step(actions)
        # A `GymnasiumVecEnv` fills its list of infos only where episodes end.
        columns = _columns(infos) or getattr(self._innermost, "infos", {})
        return Sample(observations, columns, ended)


def _in_numpy(observations: Any) -> Any:
    """Return observations; ValueError if they are tensors."""
    if isinstance(observations, loaded("torch.Tensor")):
        raise ValueError("env must be in NumPy, without a wrapper such as NumpyToTorch")
    return observations


def _columns(infos: Sequence[Mapping[str, Any]]) -> Infos:
    """Return the numbers in infos as arrays, one element per plant."""
    names = [name for name, value in infos[0].items() if isinstance(value, int | float)]
    return {name: np.array([info.get(name, np.nan) for info in infos]) for name in names}


def _as_columns(infos: Any) -> Infos:
    """Return infos as arrays, also from wrappers that list them by plant."""
    return _columns(infos) if isinstance(infos, list) else infos


def adapted(env: Any) -> Plants:
    """Return the adapter of environments of any kind."""
    if isinstance(env, gymnasium.Env):
        return SeparatePlants([env])
    return VectorPlants(env) if isinstance(env, VectorEnv) else VecEnvPlants(env)
