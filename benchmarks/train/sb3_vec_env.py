"""A Gymnasium vector environment as a vector environment of Stable-Baselines3."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, cast

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
    batches
        One or more, of autoreset mode "SameStep" and with the same spaces; their environments
        are numbered one batch after the other.

    Attributes
    ----------
    infos : dict
        The last infos as Gymnasium gives them, in arrays; those that all batches have. The list
        that `step` returns holds only what Stable-Baselines3 itself reads, as dicts for each
        environment and step would take longer than the step.

    Raises
    ------
    ValueError
        If an autoreset mode is another one, or spaces differ.
    """

    def __init__(self, *batches: VectorEnv) -> None:
        for batch in batches:
            mode = batch.metadata.get("autoreset_mode")
            if mode is not AutoresetMode.SAME_STEP:
                raise ValueError(f"batches must have autoreset_mode 'SameStep', got {mode}")
        observation_space = batches[0].single_observation_space
        action_space = batches[0].single_action_space
        for batch in batches:
            spaces = batch.single_observation_space, batch.single_action_space
            if spaces != (observation_space, action_space):
                raise ValueError(f"batches must have the same spaces, got {batches}")
        self.batches = batches
        self.infos: dict[str, Any] = {}
        sizes = [batch.num_envs for batch in batches]
        starts = np.cumsum([0, *sizes]).tolist()
        self._parts = list(itertools.starmap(slice, itertools.pairwise(starts)))
        super().__init__(sum(sizes), observation_space, action_space)

    def reset(self) -> NDArray[Any]:
        """Reset all environments, with the seeds that were set by `seed`."""
        if any(self._options):
            raise ValueError(f"options must be empty, got {self._options!r}")
        observations, infos = zip(
            *(
                # It takes a seed for each environment, whatever its annotation says.
                batch.reset(seed=cast("int", list(self._seeds[part])))
                for batch, part in zip(self.batches, self._parts, strict=True)
            ),
            strict=True,
        )
        self.infos = _joined(infos)
        self._reset_seeds()
        return np.concatenate(observations)

    def step_async(self, actions: NDArray[Any]) -> None:
        """Take note of the actions, shape (num_envs, action size)."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Step with them."""
        steps = [
            batch.step(self._actions[part])
            for batch, part in zip(self.batches, self._parts, strict=True)
        ]
        told: list[dict[str, Any]] = []
        for _, _, terminated, truncated, infos in steps:
            told += [{} for _ in terminated]
            for i in np.flatnonzero(terminated | truncated):
                told[i - len(terminated)] = {
                    "terminal_observation": infos["final_obs"][i],
                    "TimeLimit.truncated": bool(truncated[i] and not terminated[i]),
                }
        observations, rewards, terminated, truncated = map(
            np.concatenate, list(zip(*steps, strict=True))[:4]
        )
        self.infos = _joined([infos for *_, infos in steps])
        return observations, rewards.astype(np.float32), terminated | truncated, told

    def get_images(self) -> list[NDArray[np.uint8]]:
        """Return a picture of each environment, if the batch has the mode "rgb_array"."""
        pictures = itertools.chain.from_iterable(batch.render() or () for batch in self.batches)
        return cast("list[NDArray[np.uint8]]", list(pictures))

    def close(self) -> None:
        """Close the batches."""
        for batch in self.batches:
            batch.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of each environment's batch."""
        of_each = [batch for batch in self.batches for _ in range(batch.num_envs)]
        return [getattr(of_each[i], attr_name) for i in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Refuse: an environment of a batch has no attributes of its own."""
        raise NotImplementedError(f"{attr_name} can be set on `batches` only, for all at once")

    def env_method(
        self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any
    ) -> list[Any]:
        """Refuse: an environment of a batch has no methods of its own."""
        raise NotImplementedError(
            f"{method_name} can be called on `batches` only, for all at once"
        )

    def env_is_wrapped(self, wrapper_class: Any, indices: VecEnvIndices = None) -> list[bool]:
        """Return False for each index: a batch holds no wrapped environments."""
        return [False for _ in self._get_indices(indices)]


def _joined(infos: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Put the arrays of several batches one after the other."""
    names = set.intersection(*map(set, infos))
    return {
        name: np.concatenate([each[name] for each in infos])
        for name in names
        if isinstance(infos[0][name], np.ndarray)
    }
