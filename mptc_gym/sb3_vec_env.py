"""Step many plants at once for Stable-Baselines3, as a `VecEnv`; `mptc_gym.sb3` exports it."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NoReturn, cast

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecCheckNan,
    VecEnv,
    VecEnvWrapper,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
    VecVideoRecorder,
)
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from mptc_gym.plant.parameters import INTERFACE
from mptc_gym.vector_env import parameters_of

# Wrappers that only record or check: `like` leaves them out.
_RECORDERS = "Monitor", "RecordEpisodeStatistics", "RecordVideo", "RenderCollection"
_VEC_RECORDERS = VecMonitor, VecVideoRecorder, VecCheckNan


class GymnasiumVecEnv(VecEnv):
    """A `VecEnv` of Stable-Baselines3 that steps a vector environment of Gymnasium (a batch).

    All environments of a batch are stepped at once, whereas a `DummyVecEnv` steps one
    environment after another. `reset` and `step` return bit for bit what a `DummyVecEnv`
    returns for the same environments and seeds in `Monitor` wrappers, except for the infos of
    `step`. To save time, `step` returns an empty info for each environment whose episode has
    not ended. The info at the end of an episode has the entry "episode" of a `Monitor`, and
    `env_is_wrapped(Monitor)` is True. So, as for a `DummyVecEnv` of `Monitor` wrappers,
    Stable-Baselines3 evaluates the rewards of the environments even in a `VecNormalize`, and a
    `VecMonitor` warns of two monitors. `env_method` and `set_attr` raise an error.

    Parameters
    ----------
    batch
        Vector environment of Gymnasium with the autoreset mode "SameStep".
    group
        Number of successive environments that share a seed, and thus all random numbers.

    Attributes
    ----------
    batch : VectorEnv
        The vector environment.
    infos : dict
        Infos of the latest `reset` or `step` of the batch.
    """

    def __init__(self, batch: VectorEnv[Any, Any, Any], *, group: int = 1) -> None:
        mode = batch.metadata.get("autoreset_mode")
        if mode is not AutoresetMode.SAME_STEP:
            raise ValueError(f"batch must have autoreset_mode 'SameStep', got {mode}")
        self.batch: Any = batch
        self.group = group
        self.infos: dict[str, Any] = {}
        # Sum of rewards and number of samples in the present episode of each environment.
        self._returns = np.zeros(batch.num_envs)
        self._lengths = np.zeros(batch.num_envs, np.int64)
        super().__init__(
            batch.num_envs, batch.single_observation_space, batch.single_action_space
        )

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Set and return the seeds of the next reset: environment i gets `seed + i // group`.

        If `seed` is None, the first seed is random.
        """
        first = cast("int", super().seed(seed)[0])  # which replaces None by a random seed
        self._seeds = [first + index // self.group for index in range(self.num_envs)]
        return self._seeds

    def reset(self) -> NDArray[Any]:
        """Reset all environments, and return the observations, shape (num_envs, size).

        If no seeds have been set since the latest reset, the random number generators continue
        without a new seed.
        """
        # `_seeds` are those of `seed`, or None for each environment after `_reset_seeds`.
        observations, self.infos = self.batch.reset(seed=self._seeds)
        self.reset_infos = [_infos_of_one(self.infos, i) for i in range(self.num_envs)]
        self._reset_seeds()
        self._returns[:] = 0.0
        self._lengths[:] = 0
        return cast("NDArray[Any]", observations)

    def step_async(self, actions: NDArray[Any]) -> None:
        """Store actions of shape (num_envs, 1) for the next call of `step_wait`."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Step all environments with the actions from the latest call of `step_async`.

        Returns
        -------
        observations : ndarray
            Observations, shape (num_envs, size). If the episode of an environment has ended,
            the environment's observation is the first one of the next episode.
        rewards : ndarray of float32
            Rewards, shape (num_envs,).
        ended : ndarray of bool
            Whether the episode of each environment has ended, shape (num_envs,).
        infos : list of dict
            Info of each environment. If the episode of an environment has ended, the info holds
            the last observation as "terminal_observation"; otherwise the info is empty.
        """
        observations, rewards, terminated, truncated, self.infos = self.batch.step(
            self._actions
        )
        ended = terminated | truncated
        self._returns += rewards
        self._lengths += 1
        infos: list[dict[str, Any]] = [{} for _ in ended]
        for i in np.flatnonzero(ended).tolist():
            infos[i] = {
                **_infos_of_one(self.infos["final_info"], i),
                "terminal_observation": self.infos["final_obs"][i],
                "TimeLimit.truncated": bool(truncated[i] and not terminated[i]),
                "episode": {"r": self._returns[i].item(), "l": self._lengths[i].item()},
            }
            self.reset_infos[i] = _infos_of_one(self.infos, i)
        self._returns[ended] = 0.0
        self._lengths[ended] = 0
        return observations, rewards.astype(np.float32), ended, infos

    def get_images(self) -> list[NDArray[np.uint8]]:
        """Return a picture of each environment, or [] if the environments do not render."""
        return [*(self.batch.render() or ())]

    def close(self) -> None:
        """Close the batch."""
        self.batch.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return the value of an attribute of the batch for each environment in `indices`."""
        value = getattr(self.batch.unwrapped, attr_name)
        return [value for _ in self._get_indices(indices)]

    def env_method(self, *args: Any, **kwargs: Any) -> NoReturn:
        """Raise a NotImplementedError: there are no single environments to call or change."""
        raise NotImplementedError("a GymnasiumVecEnv has no single environments: use `batch`")

    set_attr = env_method

    def env_is_wrapped(
        self, wrapper_class: type[Any], indices: VecEnvIndices = None
    ) -> list[bool]:
        """Return whether `wrapper_class` is `Monitor`, for each environment in `indices`.

        The single environments have no wrappers, but infos like those of a `Monitor`.
        """
        return [wrapper_class is Monitor for _ in self._get_indices(indices)]


def _infos_of_one(infos: Mapping[str, Any], row: int) -> dict[str, Any]:
    """Return the info of environment number `row` in a vector environment, as a dict.

    As in all vector environments of Gymnasium, `infos` holds an array under "name", and under
    "_name" a mask that says which environments have the info.
    """
    infos_of_one = {}
    for name, values in infos.items():
        mask = infos.get(f"_{name}")
        # "final_obs" and "final_info" belong to the episode that has ended, not to the new one.
        if mask is not None and mask[row] and not name.startswith("final_"):
            value = values[row]
            infos_of_one[name] = value.item() if isinstance(value, np.generic) else value
    return infos_of_one


def make_vec_env(
    env: str | EnvSpec = "MiddlePoint-v0",
    n_envs: int = 1,
    *,
    seed: int | None = None,
    group: int = 1,
    **arguments: Any,
) -> GymnasiumVecEnv:
    """Return `n_envs` plants, stepped at once, as a `VecEnv` of Stable-Baselines3.

    Parameters
    ----------
    env
        Id or `EnvSpec` of the environment, without wrappers. For wrapped environments, use
        `stable_baselines3.common.env_util.make_vec_env`.
    n_envs
        Number of plants, each of which is one environment.
    seed
        Seed of the first plant at the first reset; plant i has the seed `seed + i // group`, so
        that `group` successive plants share a seed. A model that is made with a seed, as in
        `PPO(..., seed=1)`, replaces the argument `seed` by the model's seed. If `seed` is None,
        the seed is random.
    group
        Number of successive plants that share a seed. Plants with the same seed have the same
        parameter values, noise, load and set points, and differ only in the random part of the
        policy's actions.
    **arguments
        Further arguments of the plants, as in `gymnasium.make_vec`. The argument `render_mode`
        may be "rgb_array".

    Raises
    ------
    ValueError
        If an argument is out of range.
    """
    batch = gymnasium.make_vec(env, n_envs, autoreset_mode="SameStep", **arguments)
    plants = GymnasiumVecEnv(batch, group=group)
    plants.seed(seed)
    return plants


def like(
    model: BaseAlgorithm,
    env: str | EnvSpec = "MiddlePoint-v0",
    n_envs: int = 1,
    **arguments: Any,
) -> VecEnv:
    """Return new environments with the interface and the statistics of a model's training.

    The plants are those of `env`. The observation windows, the action form (`action`,
    `max_move` and `compensated_dead_zone`), the Gymnasium wrappers, the `VecFrameStack` and a
    frozen copy of the statistics of the `VecNormalize` are those of the model's training.
    Wrappers that only record or check are left out.

    Parameters
    ----------
    model
        Model of Stable-Baselines3 that has its training environments, as after
        `PPO.load(path, env=...)`.
    env
        Id or `EnvSpec` of the environment. Wrappers of an `EnvSpec` are left out.
    n_envs
        Number of plants.
    **arguments
        Further arguments of the environment, as in `gymnasium.make`, which replace those of
        `env` and of the training.

    Raises
    ------
    ValueError
        If the model has no environments, or if its environments have no `EnvSpec`, or are in a
        wrapper that cannot be made again: another wrapper of Stable-Baselines3 than those
        above, a wrapper of Gymnasium that does not record its arguments, or a wrapper of
        Gymnasium around a vector environment.
    """
    training = model.get_env()
    if training is None:
        raise ValueError("model must have its environments, as after PPO.load(path, env=...)")
    spec = training.get_attr("spec")[0]  # an element for each environment, all alike
    if spec is None:
        raise ValueError(
            "the model's environments must come from gymnasium.make or make_vec_env, whose "
            "spec records the wrappers: pass evaluate a function that makes such environments"
        )
    parameters = parameters_of(training)
    interface = {name: getattr(parameters, name) for name in INTERFACE}
    # Made for its spec alone, into which `make` writes the arguments.
    single = gymnasium.make(env, disable_env_checker=True, **{**interface, **arguments})
    wrappers = [
        wrapper for wrapper in spec.additional_wrappers if wrapper.name not in _RECORDERS
    ]
    spec = dataclasses.replace(
        cast("EnvSpec", single.spec), additional_wrappers=tuple(wrappers)
    )
    plants: VecEnv
    if wrappers:
        plants = DummyVecEnv([partial(gymnasium.make, spec)] * n_envs)
    else:
        # Without a seed, Stable-Baselines3 draws one from `np.random`, which the training uses.
        plants = make_vec_env(spec, n_envs, seed=0)
    return _in_layers_of(training, plants)


def _in_layers_of(training: VecEnv, plants: VecEnv) -> VecEnv:
    """Return plants in the wrappers of Stable-Baselines3 that are around `training`."""
    if isinstance(training, GymnasiumVecEnv) and isinstance(training.batch, VectorWrapper):
        _refuse(training.batch)
    if not isinstance(training, VecEnvWrapper):
        return plants
    plants = _in_layers_of(training.venv, plants)
    if isinstance(training, VecNormalize):
        frozen = copy.deepcopy(training)  # without environments, as if read from a file
        frozen.set_venv(plants)
        frozen.training = False
        return frozen
    if isinstance(training, VecFrameStack):
        return VecFrameStack(plants, training.stacked_obs.n_stack)
    # A wrapper that only records is left out, and any other cannot be made again.
    if not isinstance(training, _VEC_RECORDERS):
        _refuse(training)
    return plants


def _refuse(wrapper: Any) -> NoReturn:
    """Raise a ValueError that names a wrapper around the environments of a training run."""
    raise ValueError(
        f"the model's environments are in a {type(wrapper).__name__}, which cannot be made "
        "again: pass evaluate a function that makes such environments"
    )
