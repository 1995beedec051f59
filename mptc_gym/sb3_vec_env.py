"""Step whole batches of environments for Stable-Baselines3."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn


class GymnasiumVecEnv(VecEnv):
    """Step whole batches at once, where `DummyVecEnv` steps one environment after another.

    Observations, rewards, episode ends, terminal observations, and the infos of the last sample
    and of a reset are bit for bit those of `DummyVecEnv` with the same environments.

    Parameters
    ----------
    batches
        One or more vector environments of autoreset mode "SameStep" and with the same spaces;
        their environments are numbered one batch after another.
    spec
        Spec of one environment with its wrappers, if all are alike.
    group
        Number of neighbouring environments that share a seed, and thus what is drawn.

    Attributes
    ----------
    infos : dict
        The latest infos in Gymnasium's form, as arrays. The list that `step` returns holds
        infos only where an episode ends, as dicts would take longer than the step.
    """

    def __init__(
        self, *batches: VectorEnv, spec: EnvSpec | None = None, group: int = 1
    ) -> None:
        spaces = batches[0].single_observation_space, batches[0].single_action_space
        for batch in batches:
            if (mode := batch.metadata.get("autoreset_mode")) is not AutoresetMode.SAME_STEP:
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
        # A batch takes one seed per environment, despite its annotation.
        resets = [batch.reset(seed=cast("int", self._seeds[own])) for batch, own in self._parts]
        self._reset_seeds()
        self._returns[:], self._lengths[:] = 0.0, 0
        counts = [range(batch.num_envs) for batch in self.batches]
        pairs = zip(resets, counts, strict=True)
        self.reset_infos = [_alone(infos, i) for (_, infos), count in pairs for i in count]
        return self._joined(resets)[0]

    def step_async(self, actions: NDArray[Any]) -> None:
        """Store the actions, shape (num_envs, action size)."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Step with the stored actions."""
        steps = [batch.step(self._actions[own]) for batch, own in self._parts]
        observations, rewards, terminated, truncated = self._joined(steps)
        ended = terminated | truncated
        self._returns += rewards
        self._lengths += 1
        infos: list[dict[str, Any]] = [{} for _ in ended]
        for (_, own), (*_, found) in zip(self._parts, steps, strict=True):
            for j in np.flatnonzero(ended[own]).tolist():
                i = own.start + j
                self.reset_infos[i] = _alone(found, j)
                episode = {"r": float(self._returns[i]), "l": int(self._lengths[i])}
                infos[i] = {
                    **_alone(found["final_info"], j),
                    "terminal_observation": found["final_obs"][j],
                    "TimeLimit.truncated": bool(truncated[i] and not terminated[i]),
                    "episode": {**episode, "t": round(time.time() - self._began, 6)},
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
        """Return an attribute of each environment's batch, but its own `spec`."""
        of_each = [batch for batch in self.batches for _ in range(batch.num_envs)]
        if attr_name == "spec":
            return [self.spec for _ in self._get_indices(indices)]
        return [getattr(of_each[i], attr_name) for i in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Refuse: an environment of a batch has no attributes of its own."""
        raise NotImplementedError(f"{attr_name} can be set on `batches` only, for all at once")

    def env_method(
        self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any
    ) -> list[Any]:
        """Refuse: an environment of a batch has no methods of its own."""
        raise NotImplementedError(f"{method_name} can be called on `batches` only")

    def env_is_wrapped(
        self, wrapper_class: type[Any], indices: VecEnvIndices = None
    ) -> list[bool]:
        """Return False for each index: a batch holds no wrapped environments."""
        return [False for _ in self._get_indices(indices)]


def _alone(infos: Mapping[str, Any], i: int) -> dict[str, Any]:
    """Return the infos of environment i of a batch, as it would give them alone."""
    return {
        name: values[i].item() if isinstance(values[i], np.generic) else values[i]
        for name, values in infos.items()
        if f"_{name}" in infos and infos[f"_{name}"][i] and not name.startswith("final_")
    }
