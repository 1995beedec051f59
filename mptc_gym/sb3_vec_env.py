"""Step whole batches of environments for Stable-Baselines3."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any, NoReturn, cast

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
        sizes = [batch.num_envs for batch in batches]
        self._edges = np.cumsum(sizes)[:-1]
        # Of each environment, the number of its batch and its own number there.
        self._places = [(batch, j) for batch, size in enumerate(sizes) for j in range(size)]
        super().__init__(sum(sizes), *spaces)
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
        seeds: Any = np.split(np.array(self._seeds, object), self._edges)
        resets = [
            batch.reset(seed=own.tolist())
            for batch, own in zip(self.batches, seeds, strict=True)
        ]
        self._reset_seeds()
        self._returns[:], self._lengths[:] = 0.0, 0
        self.reset_infos = [_alone(resets[batch][-1], j) for batch, j in self._places]
        return self._joined(resets)[0]

    def step_async(self, actions: NDArray[Any]) -> None:
        """Store the actions, shape (num_envs, action size)."""
        self._actions = np.split(actions, self._edges)

    def step_wait(self) -> VecEnvStepReturn:
        """Step with the stored actions."""
        pairs = zip(self.batches, self._actions, strict=True)
        steps = [batch.step(actions) for batch, actions in pairs]
        observations, rewards, terminated, truncated = self._joined(steps)
        ended = terminated | truncated
        self._returns += rewards
        self._lengths += 1
        infos: list[dict[str, Any]] = [{} for _ in ended]
        for i in np.flatnonzero(ended).tolist():
            batch, j = self._places[i]
            found = steps[batch][-1]
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
        chosen = [self._places[i][0] for i in self._get_indices(indices)]
        if attr_name == "spec":
            return [self.spec] * len(chosen)
        return [getattr(self.batches[batch], attr_name) for batch in chosen]

    def env_method(self, *args: Any, **kwargs: Any) -> NoReturn:
        """Refuse: an environment of a batch has no methods or attributes of its own."""
        raise NotImplementedError(f"use `batches`, for all at once, got {args or kwargs}")

    set_attr = env_method

    def env_is_wrapped(self, wrapper_class: Any, indices: VecEnvIndices = None) -> list[bool]:
        """Return False for each index: a batch holds no wrapped environments."""
        return [False for _ in self._get_indices(indices)]


def _alone(infos: Mapping[str, Any], i: int) -> dict[str, Any]:
    """Return the infos of environment i of a batch, as it would give them alone."""
    return {
        name: values[i].item() if isinstance(values[i], np.generic) else values[i]
        for name, values in infos.items()
        if f"_{name}" in infos and infos[f"_{name}"][i] and not name.startswith("final_")
    }
