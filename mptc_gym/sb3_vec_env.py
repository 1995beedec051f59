"""Step batches of plants as one `VecEnv` of Stable-Baselines3; see `mptc_gym.sb3`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NoReturn, cast

import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from mptc_gym.checks import MOST_PLANTS, count, reject
from mptc_gym.making import make_batch, make_one
from mptc_gym.wrappers import IncrementalAction


class GymnasiumVecEnv(VecEnv):
    """Step whole batches at once, where `DummyVecEnv` steps one environment after another.

    All that it returns is bit for bit that of `DummyVecEnv` with the same environments, each in
    a `Monitor`, except for infos: `step` fills the infos of an environment only where its
    episode ends, as making all these dicts would take longer than the step. The attribute
    `infos` holds the infos of all environments in Gymnasium's form, as arrays.

    Parameters
    ----------
    *batches
        Vector environments of autoreset mode "SameStep" and with the same spaces. Their
        environments are numbered one batch after another.
    spec
        The spec of one environment with its wrappers, if all environments are alike.
    group
        Number of neighbouring environments that share a seed, and thus all random numbers.
    """

    def __init__(
        self, *batches: VectorEnv[Any, Any, Any], spec: EnvSpec | None = None, group: int = 1
    ) -> None:
        modes = {batch.metadata.get("autoreset_mode") for batch in batches}
        if modes != {AutoresetMode.SAME_STEP}:
            raise ValueError(f"batches must have autoreset_mode 'SameStep', got {modes}")
        self.batches: tuple[Any, ...] = batches
        self.spec = spec
        self.group = group
        self.infos: dict[str, Any] = {}
        self._slices: list[slice] = []  # the numbers of the environments of each batch
        num_envs = 0
        for batch in batches:
            self._slices.append(slice(num_envs, num_envs + batch.num_envs))
            num_envs += batch.num_envs
        self._next_seeds: list[int | None] = [None] * num_envs
        self._returns = np.zeros(num_envs)  # of the episode so far
        self._lengths = np.zeros(num_envs, np.int64)  # of the episode so far, samples
        super().__init__(
            num_envs, batches[0].single_observation_space, batches[0].single_action_space
        )

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Set the seeds of the next reset: environment i has `seed + i // group`."""
        first = cast("int", super().seed(seed)[0])  # a random seed if `seed` is None
        seeds = [first + index // self.group for index in range(self.num_envs)]
        self.set_seeds(seeds)
        return seeds

    def set_seeds(self, seeds: Sequence[int]) -> None:
        """Set the seeds of the next reset, one for each environment."""
        self._next_seeds = [*seeds]

    def reset(self) -> NDArray[Any]:
        """Reset all environments, with the seeds set by `seed` or `set_seeds`."""
        returned = [
            batch.reset(seed=self._next_seeds[numbers])
            for batch, numbers in zip(self.batches, self._slices, strict=True)
        ]
        self._next_seeds = [None] * self.num_envs
        self._returns[:] = 0.0
        self._lengths[:] = 0
        observations, infos = zip(*returned, strict=True)
        self.infos = _joined(infos)
        self.reset_infos = []
        for infos_of_batch, batch in zip(infos, self.batches, strict=True):
            rows = range(batch.num_envs)
            self.reset_infos += [_infos_of_one(infos_of_batch, row) for row in rows]
        return np.concatenate(observations)

    def step_async(self, actions: NDArray[Any]) -> None:
        """Store the actions, shape (num_envs, action size)."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Step with the stored actions."""
        returned = [
            batch.step(self._actions[numbers])
            for batch, numbers in zip(self.batches, self._slices, strict=True)
        ]
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
        """Return a picture of each environment, if the batches render."""
        images: list[NDArray[np.uint8]] = []
        for batch in self.batches:
            images += batch.render() or ()
        return images

    def close(self) -> None:
        """Close the batches."""
        for batch in self.batches:
            batch.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of each environment's batch, or the spec of one environment."""
        values = [self.spec] * self.num_envs
        if attr_name != "spec":
            values = []
            for batch in self.batches:
                values += [getattr(batch, attr_name)] * batch.num_envs
        return [values[index] for index in self._get_indices(indices)]

    def env_method(self, *args: Any, **kwargs: Any) -> NoReturn:
        """Refuse: an environment of a batch has no methods or attributes for itself."""
        raise NotImplementedError(f"use `batches`, for all at once, got {args or kwargs}")

    set_attr = env_method

    def env_is_wrapped(
        self, wrapper_class: type[Any], indices: VecEnvIndices = None
    ) -> list[bool]:
        """Return False for each index: a batch holds no wrapped environments."""
        return [False for _ in self._get_indices(indices)]


def _joined(infos: Sequence[Mapping[str, Any]]) -> dict[str, NDArray[Any]]:
    """Concatenate the arrays in the infos of batches that all batches have, by name."""
    common_names = set(infos[0]).intersection(*infos[1:])
    joined = {}
    for name, values in infos[0].items():
        if name in common_names and isinstance(values, np.ndarray):
            joined[name] = np.concatenate([of_batch[name] for of_batch in infos])
    return joined


def _infos_of_one(infos: Mapping[str, Any], row: int) -> dict[str, Any]:
    """Return the infos of one environment of a batch, as the environment alone returns them."""
    infos_of_one = {}
    for name, values in infos.items():
        is_of_plant = not name.startswith("final_") and f"_{name}" in infos
        if is_of_plant and infos[f"_{name}"][row]:
            value = values[row]
            infos_of_one[name] = value.item() if isinstance(value, np.generic) else value
    return infos_of_one


def make_vec_env(
    env: str | EnvSpec = "MiddlePoint-v0",
    n_envs: int = 1,
    *,
    seed: int | None = None,
    group: int = 1,
    wrapper: Mapping[str, Any] | Callable[..., Any] | None = None,
    **arguments: Any,
) -> GymnasiumVecEnv:
    """Make plants that are stepped together, for the algorithms of Stable-Baselines3.

    Parameters
    ----------
    env, **arguments
        An id or an `EnvSpec`, and further arguments for it, as in `gymnasium.make`.
        `render_mode` may be "rgb_array".
    n_envs
        Number of plants.
    seed
        Seed of the first plant at the first reset; plant i has `seed + i // group`. The seed of
        a model, if it has one, replaces this seed.
    group
        Number of neighbouring plants that share a seed: they have the same noise, load and
        set points, and differ only in the actions that a policy explores.
    wrapper
        Adds `IncrementalAction`: its arguments, or the class itself for its defaults. Other
        wrappers cannot take a batch: use `stable_baselines3.common.env_util.make_vec_env`.

    Raises
    ------
    ValueError
        If `env` is not of this package, or an argument is out of range.
    """
    n_envs = count("n_envs", n_envs, 1, MOST_PLANTS)
    group = count("group", group, 1, n_envs)
    render_mode = arguments.pop("render_mode", None)  # of the batch alone, not of its spec
    single = make_one(env, arguments)
    if isinstance(wrapper, Mapping):
        single = IncrementalAction(single, **wrapper)
    elif wrapper is not None:
        single = wrapper(single)
    mode = AutoresetMode.SAME_STEP
    batch = make_batch(single, n_envs, autoreset_mode=mode, render_mode=render_mode)
    if batch is None:
        reject("env", single, "of this package, in no wrapper other than IncrementalAction")
    plants = GymnasiumVecEnv(batch, spec=single.spec, group=group)
    plants.seed(seed)
    return plants
