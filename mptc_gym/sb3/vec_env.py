"""Run vector environments of Gymnasium (batches) as one `VecEnv` of Stable-Baselines3."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NoReturn, cast

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn


class GymnasiumVecEnv(VecEnv):
    """A `VecEnv` of Stable-Baselines3 that steps vector environments of Gymnasium (batches).

    All environments of a batch are stepped at once, whereas a `DummyVecEnv` steps one
    environment after another. `reset` and `step` return bit for bit what a `DummyVecEnv`
    returns for the same environments and seeds in `Monitor` wrappers, except for the infos of
    `step`. To save time, `step` returns an empty info for each environment whose episode has
    not ended. `env_method` and `set_attr` raise an error.

    Parameters
    ----------
    *batches
        Vector environments of Gymnasium with autoreset mode "SameStep" and with equal spaces.
        The environments of all batches are numbered in the order of the batches.
    group
        Number of successive environments that share a seed, and thus all random numbers.

    Attributes
    ----------
    infos : dict
        Infos of the latest `reset` or `step`: a dict from names to arrays of shape (num_envs,).
    """

    def __init__(self, *batches: VectorEnv[Any, Any, Any], group: int = 1) -> None:
        modes = {batch.metadata.get("autoreset_mode") for batch in batches}
        if modes != {AutoresetMode.SAME_STEP}:
            raise ValueError(f"batches must have autoreset_mode 'SameStep', got {modes}")
        self.batches: tuple[Any, ...] = batches
        self.group = group
        self.infos: dict[str, Any] = {}
        self._slices: list[slice] = []  # indices of the environments of each batch
        num_envs = 0
        for batch in batches:
            self._slices.append(slice(num_envs, num_envs + batch.num_envs))
            num_envs += batch.num_envs
        # The seed of each environment at the next reset; None continues the random numbers.
        self._next_seeds: list[int | None] = [None] * num_envs
        # Sum of rewards and number of samples in the present episode of each environment.
        self._returns = np.zeros(num_envs)
        self._lengths = np.zeros(num_envs, np.int64)
        super().__init__(
            num_envs, batches[0].single_observation_space, batches[0].single_action_space
        )

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Set and return the seeds of the next reset: environment i gets `seed + i // group`.

        If `seed` is None, the first seed is random.
        """
        first = cast("int", super().seed(seed)[0])  # which replaces None by a random seed
        seeds = [first + index // self.group for index in range(self.num_envs)]
        self.set_seeds(seeds)
        return seeds

    def set_seeds(self, seeds: Sequence[int]) -> None:
        """Set the seeds of the next reset, one integer for each environment."""
        self._next_seeds = [*seeds]

    def reset(self) -> NDArray[Any]:
        """Reset all environments, and return the observations, shape (num_envs, size).

        If no seeds have been set since the latest reset, the random number generators continue
        without a new seed.
        """
        observations = []
        batch_infos = []
        self.reset_infos = []
        for batch, numbers in zip(self.batches, self._slices, strict=True):
            observations_of_batch, infos = batch.reset(seed=self._next_seeds[numbers])
            observations.append(observations_of_batch)
            batch_infos.append(infos)
            self.reset_infos += [_infos_of_one(infos, row) for row in range(batch.num_envs)]
        self.infos = _joined(batch_infos)
        self._next_seeds = [None] * self.num_envs
        self._returns[:] = 0.0
        self._lengths[:] = 0
        return np.concatenate(observations)

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
        returned = [
            batch.step(self._actions[numbers])
            for batch, numbers in zip(self.batches, self._slices, strict=True)
        ]
        # `zip` collects the observations of all batches, the rewards of all batches, and so on.
        *arrays, batch_infos = zip(*returned, strict=True)
        observations, rewards, terminated, truncated = map(np.concatenate, arrays)
        self.infos = _joined(batch_infos)
        ended = terminated | truncated
        self._returns += rewards
        self._lengths += 1
        infos: list[dict[str, Any]] = [{} for _ in ended]
        for infos_of_batch, numbers in zip(batch_infos, self._slices, strict=True):
            for row in np.flatnonzero(ended[numbers]).tolist():
                index = numbers.start + row
                infos[index] = {
                    **_infos_of_one(infos_of_batch["final_info"], row),
                    "terminal_observation": infos_of_batch["final_obs"][row],
                    "TimeLimit.truncated": bool(truncated[index] and not terminated[index]),
                    "episode": {
                        "r": self._returns[index].item(),
                        "l": self._lengths[index].item(),
                    },
                }
                self.reset_infos[index] = _infos_of_one(infos_of_batch, row)
        self._returns[ended] = 0.0
        self._lengths[ended] = 0
        return observations, rewards.astype(np.float32), ended, infos

    def get_images(self) -> list[NDArray[np.uint8]]:
        """Return a picture of each environment, or [] if the environments do not render."""
        images: list[NDArray[np.uint8]] = []
        for batch in self.batches:
            images += batch.render() or ()
        return images

    def close(self) -> None:
        """Close the batches."""
        for batch in self.batches:
            batch.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return the value of an attribute for each environment in `indices`.

        The attribute is taken from the vector environment that holds the environment.
        """
        values: list[Any] = []
        for batch in self.batches:
            value = getattr(batch.unwrapped, attr_name)
            values += [value] * batch.num_envs
        return [values[index] for index in self._get_indices(indices)]

    def env_method(self, *args: Any, **kwargs: Any) -> NoReturn:
        """Raise a NotImplementedError: there are no single environments to call or change."""
        raise NotImplementedError(
            "a GymnasiumVecEnv holds no single environments to call or change: use "
            f"`batches`, the vector environments of the GymnasiumVecEnv, got {args or kwargs}"
        )

    set_attr = env_method

    def env_is_wrapped(
        self, wrapper_class: type[Any], indices: VecEnvIndices = None
    ) -> list[bool]:
        """Return False for each environment in `indices`: wrappers are around batches only."""
        return [False for _ in self._get_indices(indices)]


def _joined(infos: Sequence[Mapping[str, Any]]) -> dict[str, NDArray[Any]]:
    """Return the infos of all vector environments by name, in arrays of shape (num_envs,).

    An info is left out if any of the vector environments lacks this info, or if the info is not
    an array, as `final_info`.
    """
    common_names = set(infos[0]).intersection(*infos[1:])
    joined = {}
    for name, values in infos[0].items():
        if name in common_names and isinstance(values, np.ndarray):
            joined[name] = np.concatenate([of_batch[name] for of_batch in infos])
    return joined


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
