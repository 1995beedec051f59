"""A Gymnasium vector environment as a vector environment of Stable-Baselines3."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray
from stable_baselines3.common.vec_env.base_vec_env import (
    VecEnv,
    VecEnvIndices,
    VecEnvStepReturn,
)


class GymnasiumVecEnv(VecEnv):
    """Steps a whole batch at once where `DummyVecEnv` goes from one environment to the next.

    Observations, rewards, ends and terminal observations are, to the bit, those of
    `DummyVecEnv` with the same environments.

    Parameters
    ----------
    envs
        The batch, of autoreset mode "SameStep".

    Attributes
    ----------
    infos : dict
        The last infos as Gymnasium gives them, in arrays. Those in the list that `step` returns
        hold only what Stable-Baselines3 itself reads, as dicts for each environment and step
        would take longer than the step.

    Raises
    ------
    ValueError
        If the autoreset mode is another one.
    """

    def __init__(self, envs: VectorEnv) -> None:
        mode = envs.metadata.get("autoreset_mode")
        if mode is not AutoresetMode.SAME_STEP:
            raise ValueError(f"envs must have autoreset_mode 'SameStep', got {mode}")
        self.envs = envs
        self.infos: dict[str, Any] = {}
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self) -> NDArray[Any]:
        """Reset all environments, with the seeds that were set by `seed`."""
        if any(self._options):
            raise ValueError(f"options must be empty, got {self._options!r}")
        observations, self.infos = self.envs.reset(seed=list(self._seeds))
        self._reset_seeds()
        return observations

    def step_async(self, actions: NDArray[Any]) -> None:
        """Take note of the actions, shape (num_envs, action size)."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Step with them."""
        observations, rewards, terminated, truncated, self.infos = self.envs.step(self._actions)
        dones = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(dones):
            infos[i] = {
                "terminal_observation": self.infos["final_obs"][i],
                "TimeLimit.truncated": bool(truncated[i] and not terminated[i]),
            }
        return observations, rewards.astype(np.float32), dones, infos

    def get_images(self) -> list[NDArray[np.uint8]]:
        """Return a picture of each environment, if the batch has the mode "rgb_array"."""
        return list(self.envs.render() or [])

    def close(self) -> None:
        """Close the batch."""
        self.envs.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of the batch, once for each index."""
        return [getattr(self.envs, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Refuse: an environment of a batch has no attributes of its own."""
        raise NotImplementedError(f"{attr_name} can be set on `envs` only, for all at once")

    def env_method(
        self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any
    ) -> list[Any]:
        """Refuse: an environment of a batch has no methods of its own."""
        raise NotImplementedError(
            f"{method_name} can be called on `envs` only, for all at once"
        )

    def env_is_wrapped(self, wrapper_class: Any, indices: VecEnvIndices = None) -> list[bool]:
        """Return False for each index: a batch holds no wrapped environments."""
        return [False for _ in self._get_indices(indices)]
