"""Step batches of environments as a vector environment of Stable-Baselines3."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any, cast

import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn


class GymnasiumVecEnv(VecEnv):
    """Step whole batches at once, where `DummyVecEnv` steps one environment after another.

    Observations, rewards, episode ends and terminal observations are bit for bit those of
    `DummyVecEnv` with the same environments.

    Parameters
    ----------
    batches
        One or more vector environments of autoreset mode "SameStep" and with the same spaces;
        their environments are numbered one batch after another.
    spec
        Spec of one environment with its wrappers, if all are alike: a model trained on them
        records it.
    group
        Number of neighbouring environments that share a seed, and thus what is drawn.

    Attributes
    ----------
    infos : dict
        The latest infos in Gymnasium's form, as arrays; those that all batches have. The list
        that `step` returns holds only what Stable-Baselines3 itself reads at the end of an
        episode, as a dict for each environment and step would take longer than the step.

    Raises
    ------
    ValueError
        If a batch has another autoreset mode, or spaces differ.
    """

    def __init__(
        self, *batches: VectorEnv, spec: EnvSpec | None = None, group: int = 1
    ) -> None:
        spaces = batches[0].single_observation_space, batches[0].single_action_space
        for batch in batches:
            mode = batch.metadata.get("autoreset_mode")
            if mode is not AutoresetMode.SAME_STEP:
                raise ValueError(f"batches must have autoreset_mode 'SameStep', got {mode}")
            if (batch.single_observation_space, batch.single_action_space) != spaces:
                raise ValueError(f"batches must have the same spaces, got {batches}")
        self.batches, self.spec, self.group = batches, spec, group
        self.infos: dict[str, Any] = {}
        starts = np.cumsum([0, *(batch.num_envs for batch in batches)]).tolist()
        self._parts = list(zip(batches, map(slice, starts, starts[1:]), strict=True))
        super().__init__(starts[-1], *spaces)
        self._began = time.time()
        self._returns = np.zeros(self.num_envs)
        self._lengths = np.zeros(self.num_envs, np.int64)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Set the seeds of the next reset: environment i has `seed + i // group`."""
        first, *_ = super().seed(seed)
        self._seeds = [cast("int", first) + i // self.group for i in range(self.num_envs)]
        return self._seeds

    def reset(self) -> NDArray[Any]:
        """Reset all environments, with the seeds set by `seed`."""
        if any(self._options):
            raise ValueError(f"options must be empty, got {self._options!r}")
        resets = [
            # It takes one seed per environment, despite its annotation.
            batch.reset(seed=cast("int", list(self._seeds[part])))
            for batch, part in self._parts
        ]
        self._reset_seeds()
        self._returns[:], self._lengths[:] = 0.0, 0
        return self._joined(resets)[0]

    def step_async(self, actions: NDArray[Any]) -> None:
        """Store the actions, shape (num_envs, action size)."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Step with the stored actions."""
        steps = [batch.step(self._actions[part]) for batch, part in self._parts]
        observations, rewards, terminated, truncated = self._joined(steps)
        ended = terminated | truncated
        self._returns += rewards
        self._lengths += 1
        infos: list[dict[str, Any]] = [{} for _ in ended]
        if ended.any():
            last = np.concatenate(
                [found.get("final_obs", [None] * len(flags)) for *_, flags, found in steps]
            )
            seconds = round(time.time() - self._began, 6)
            for i in np.flatnonzero(ended).tolist():
                episode = {"r": float(self._returns[i]), "l": int(self._lengths[i])}
                infos[i] = {
                    "terminal_observation": last[i],
                    "TimeLimit.truncated": bool(truncated[i] and not terminated[i]),
                    "episode": {**episode, "t": seconds},
                }
            self._returns[ended], self._lengths[ended] = 0.0, 0
        return observations, rewards.astype(np.float32), ended, infos

    def _joined(self, returned: list[tuple[Any, ...]]) -> list[NDArray[Any]]:
        """Concatenate what the batches returned, and store the infos in `infos`."""
        *arrays, infos = zip(*returned, strict=True)
        self.infos = {
            name: np.concatenate([each[name] for each in infos])
            for name in set.intersection(*map(set, infos))
            if isinstance(infos[0][name], np.ndarray)
        }
        return [np.concatenate(each) for each in arrays]

    def get_images(self) -> list[NDArray[np.uint8]]:
        """Return a picture of each environment, if the batch has the mode "rgb_array"."""
        return [image for batch in self.batches for image in cast("Any", batch.render() or ())]

    def close(self) -> None:
        """Close the batches."""
        for batch in self.batches:
            batch.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of each environment's batch."""
        if attr_name == "spec" and self.spec is not None:
            return [self.spec for _ in self._get_indices(indices)]
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
