"""Implement what the vector environments share: arguments, masks, time limits, resets, infos.

`MiddlePointVectorEnv` adds the motion of plants in NumPy arrays, and `MiddlePointTorchEnv` in
PyTorch tensors.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from mptc_gym.checks import MOST_PLANTS, count, is_count, reject
from mptc_gym.env import INFO, HasPlainSpec, observation_space
from mptc_gym.parameters import Parameters
from mptc_gym.plant_state import PlantState, plant_state
from mptc_gym.signals import FOREVER

Array = Any  # of NumPy or PyTorch, depending on the environment
Infos = dict[str, Any]
Mask = NDArray[np.bool_]  # of plants, shape (num_envs,)

FACTORS = ("gain_factor", "time_constant_factor")


class BatchEnv(HasPlainSpec, VectorEnv[Array, Array, Array], ABC):
    """n plants that advance together, without what depends on the array library."""

    _where: Any  # numpy.where or torch.where
    _shown: Any  # the observations: `present()` returns them, and the caller may overwrite them
    _zeros: Array  # one per plant, read-only

    def __init__(
        self,
        num_envs: int,
        max_episode_steps: int | None,
        autoreset_mode: str | AutoresetMode,
        arguments: Mapping[str, Any],
    ) -> None:
        self.parameters = Parameters.of_environment(arguments)
        self.num_envs = count("num_envs", num_envs, 1, MOST_PLANTS)
        limit = -1 if max_episode_steps is None else max_episode_steps
        if not is_count(limit, -1) or limit == 0:
            allowed = "an integer of at least 1, or None or -1 for no limit"
            reject("max_episode_steps", max_episode_steps, allowed)
        self._limit = FOREVER if limit == -1 else min(FOREVER, int(limit))
        try:
            self.autoreset_mode = AutoresetMode(autoreset_mode)
        except ValueError:
            allowed = ", ".join(repr(mode.value) for mode in AutoresetMode)
            reject("autoreset_mode", autoreset_mode, f"one of {allowed}")
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self.single_action_space = Box(-1.0, 1.0, (1,), np.float32)
        self.single_observation_space = observation_space(self.parameters)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._factor_names = FACTORS if self.parameters.drifts else ()
        load = ("disturbance",) if self.parameters.is_disturbed else ()
        self._names = (*INFO, *load, *self._factor_names)  # keys of the infos
        self._masks = tuple(f"_{name}" for name in self._names)
        self._drawn_numbers: dict[str, Array] = {}  # the arguments that are ranges, by name
        # Each plant's k is the clock minus its start.
        self._clock = 0
        self._starts = np.zeros(num_envs, np.int64)
        self._first_end = 0  # until the first reset
        self._ended: Mask | None = None  # plants still to be reset, if any

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, Infos]:
        """Bring all or some plants to rest and start an episode of each.

        Parameters
        ----------
        seed
            Restarts the random numbers; see the class docstring. Without it, they continue.
        options
            `reset_mask`, a bool array of shape (num_envs,), selects the plants to reset. The
            first reset must include all. Plants that are not reset return their last
            observation, and are False in the infos' masks, which may be one array.

        An argument that is invalid is a ValueError; nothing is then changed.
        """
        if options is not None and not isinstance(options, Mapping):
            reject("options", options, "a dict or None")
        mask = self._checked_mask(options or {})
        if not self._first_end and not mask.all():
            raise ResetNeeded("reset all environments before some of them")
        self._prepare(mask, seed, options or {})
        infos = self._restart(mask, {})
        return self._shown.present(), infos

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, Infos]:
        """Apply normalised actions, shape (num_envs, 1), for one sample.

        Returns observations, shape (num_envs, size), then rewards, terminations,
        truncations and infos, shape (num_envs,). The masks of the infos may be one array.
        Actions of another shape or not finite are a ValueError; nothing is then changed. Plants
        never reset or, with autoreset disabled, ended plants raise a `ResetNeeded`.
        """
        if not self._first_end:
            raise ResetNeeded("call reset before step")
        ended = self._ended
        if ended is not None and self.autoreset_mode is AutoresetMode.DISABLED:
            which = np.flatnonzero(ended)
            raise ResetNeeded(f"episodes of environments {which} have ended: reset them")
        a = self._checked_actions(actions)
        if ended is not None and ended.all():
            infos, nobody = self._restart(ended, {}), [self._flags(~ended) for _ in range(2)]
            return self._shown.present(), self._zeros + 0, *nobody, infos
        self._clock += 1
        returned = self._advance(a)
        return returned if self._clock < self._first_end else self._end(*returned)

    def _end(
        self, observations: Array, rewards: Array, nobody: Array, _: Array, infos: Infos
    ) -> tuple[Array, Array, Array, Array, Infos]:
        """Handle the end of episodes in what a step returns."""
        ended = self._clock - self._starts >= self._limit
        flags = self._flags(ended)
        if self.autoreset_mode is AutoresetMode.SAME_STEP:
            final = {name: self._where(flags, infos[name], 0) for name in self._names}
            final |= dict.fromkeys(self._masks, flags)
            infos |= {"final_info": final, "final_obs": self._final(ended, observations)}
            infos |= {"_final_info": flags, "_final_obs": flags}
            self._restart(ended, infos)
            return self._shown.present(), rewards, nobody, self._flags(ended), infos
        if self._ended is not None:  # at the previous step
            rewards = self._where(self._flags(self._ended), 0, rewards)
            self._restart(self._ended, infos)
            observations = self._shown.present()
            ended = self._clock - self._starts >= self._limit
        self._ended = ended if ended.any() else None
        return observations, rewards, nobody, self._flags(ended), infos

    def _restart(self, mask: Mask, infos: Infos) -> Infos:
        """Begin an episode of some plants, and return the infos with theirs at k = 0."""
        self._starts[mask] = self._clock
        self._first_end = int(self._starts.min()) + self._limit
        if self._ended is not None:
            left = self._ended & ~mask
            self._ended = left if left.any() else None
        flags, first = self._flags(mask), self._begin(mask)
        for name in self.parameters.ranges:
            present = self._drawn_numbers.get(name, 0)
            self._drawn_numbers[name] = self._where(flags, first[name], present)
        for name in {*self._names, *first}:
            values = first.get(name, self._zeros)
            infos[name] = self._where(flags, values, infos.get(name, 0))
            infos.setdefault(f"_{name}", flags)
        return infos

    def plant_state(self) -> PlantState:
        """Return what a teacher may know of each plant at the present sample.

        These are delay (samples), dead zone (t/h), gain (degC per t/h) and time constant (s),
        with their drift, and the load (degC), each of shape (num_envs,). A policy cannot see
        them, but a critic or a teacher in training may. They are of the episode that `step` or
        `reset` has just returned an observation of. Before the first reset, a `ResetNeeded` is
        raised.
        """
        if not self._first_end:
            raise ResetNeeded("call reset before plant_state")
        ages = self._from_host(self._clock - self._starts)
        return plant_state(self.parameters, self._drawn_numbers, ages, self._present_load())

    def _checked_mask(self, options: Mapping[str, Any]) -> Mask:
        """Return the mask of the plants to reset."""
        if "reset_mask" not in options:
            return np.ones(self.num_envs, np.bool_)
        given = options["reset_mask"]
        mask = given.cpu().numpy() if hasattr(given, "cpu") else given  # of tensors
        if (
            not isinstance(mask, np.ndarray)
            or mask.dtype != np.bool_
            or mask.shape != (self.num_envs,)
            or not mask.any()
        ):
            allowed = f"an array of bool, shape ({self.num_envs},), at least one of them True"
            reject("options['reset_mask']", given, allowed)
        return mask.copy()

    @abstractmethod
    def _flags(self, mask: Mask) -> Array:
        """Return a mask as a new array of the environment's library."""

    @abstractmethod
    def _from_host(self, values: NDArray[Any]) -> Array:
        """Return numbers, shape (num_envs,), as an array of the environment's library."""

    @abstractmethod
    def _present_load(self) -> Array:
        """Return the load w at the present sample, degC, shape (num_envs,)."""

    @abstractmethod
    def _prepare(self, mask: Mask, seed: Any, options: Mapping[str, Any]) -> None:
        """Check the other arguments of `reset`, then apply them."""

    @abstractmethod
    def _begin(self, mask: Mask) -> dict[str, Array]:
        """Begin an episode of some plants; return their infos at k = 0 that are not 0."""

    @abstractmethod
    def _checked_actions(self, actions: Any) -> Array:
        """Return the actions, shape (num_envs,); 0 where they are ignored."""

    @abstractmethod
    def _advance(self, a: Array) -> tuple[Array, Array, Array, Array, Infos]:
        """Move all plants by one sample; return what `step` returns if no episode ends."""

    @abstractmethod
    def _final(self, ended: Mask, observations: Array) -> Array:
        """Return `final_obs`, given the plants whose episode has ended."""
