"""Implement what the vector environments share: arguments, masks, time limits, resets, infos.

`MiddlePointVectorEnv` adds the plants in NumPy arrays, and `MiddlePointTorchEnv` in PyTorch
tensors.
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
    """n plants that advance together: the part that does not depend on the array library."""

    _where: Any  # numpy.where or torch.where
    _shown: Any  # the observations; `present()` returns copies of them
    _zeros: Array  # shape (num_envs,), read-only

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
        # Keys of the infos of every step, and of their masks.
        names = [*INFO]
        if self.parameters.is_disturbed:
            names.append("disturbance")
        self._factor_names: tuple[str, ...] = ()
        if self.parameters.drifts:
            self._factor_names = FACTORS
        self._names = (*names, *self._factor_names)
        self._masks = tuple(f"_{name}" for name in self._names)
        self._drawn_numbers: dict[str, Array] = {}  # the arguments that are ranges, by name
        # Steps of the environment. A plant's k is the clock minus the start of its episode.
        self._clock = 0
        self._starts = np.zeros(num_envs, np.int64)
        self._first_end = 0  # the clock when an episode ends next; 0 before the first reset
        self._ended: Mask | None = None  # plants whose episode has ended; None for no plant

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
            first reset must include all plants.

        Returns
        -------
        observations : array
            Shape (num_envs, size). Those of plants that are not reset are their last ones.
        infos : dict
            Arrays of shape (num_envs,), and their masks, which are False for plants that are
            not reset. Several masks may be the same array.

        Raises
        ------
        ValueError
            If an argument is invalid. Nothing is then changed.
        ResetNeeded
            If the first reset does not include all plants.
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
        """Apply normalised actions for one sample.

        Parameters
        ----------
        actions
            Shape (num_envs, 1).

        Returns
        -------
        observations : array
            Shape (num_envs, size).
        rewards, terminations, truncations : array
            Shape (num_envs,). No episode terminates.
        infos : dict
            Arrays of shape (num_envs,), and their masks. Several masks may be the same array.

        Raises
        ------
        ValueError
            If the actions have another shape or are not finite. Nothing is then changed.
        ResetNeeded
            Before the first reset; with autoreset disabled, also if an episode has ended.
        """
        if not self._first_end:
            raise ResetNeeded("call reset before step")
        ended = self._ended
        if ended is not None and self.autoreset_mode is AutoresetMode.DISABLED:
            which = np.flatnonzero(ended)
            raise ResetNeeded(f"episodes of environments {which} have ended: reset them")
        a = self._checked_actions(actions)
        if ended is not None and ended.all():
            infos = self._restart(ended, {})
            rewards = self._zeros + 0  # a copy
            terminations = self._flags(~ended)
            truncations = self._flags(~ended)
            return self._shown.present(), rewards, terminations, truncations, infos
        self._clock += 1
        step = self._advance(a)
        if self._clock < self._first_end:
            return step
        return self._end_episodes(*step)

    def _end_episodes(
        self, observations: Array, rewards: Array, terminations: Array, _: Array, infos: Infos
    ) -> tuple[Array, Array, Array, Array, Infos]:
        """Return what a step returns, where episodes end or have ended at the previous step.

        The arguments are what it would return if no episode ended.
        """
        ended = self._clock - self._starts >= self._limit
        if self.autoreset_mode is AutoresetMode.SAME_STEP:
            flags = self._flags(ended)
            final_info = {name: self._where(flags, infos[name], 0) for name in self._names}
            final_info |= dict.fromkeys(self._masks, flags)
            infos["final_info"] = final_info
            infos["_final_info"] = flags
            infos["final_obs"] = self._final(ended, observations)
            infos["_final_obs"] = flags
            self._restart(ended, infos)
            return self._shown.present(), rewards, terminations, self._flags(ended), infos
        if self._ended is not None:  # since the previous step: this step resets them
            rewards = self._where(self._flags(self._ended), 0, rewards)
            self._restart(self._ended, infos)
            observations = self._shown.present()
            ended = self._clock - self._starts >= self._limit
        self._ended = ended if ended.any() else None
        return observations, rewards, terminations, self._flags(ended), infos

    def _restart(self, mask: Mask, infos: Infos) -> Infos:
        """Begin an episode of some plants; put their infos at k = 0 in the infos of a step."""
        self._starts[mask] = self._clock
        self._first_end = int(self._starts.min()) + self._limit
        if self._ended is not None:
            still_ended = self._ended & ~mask
            self._ended = still_ended if still_ended.any() else None
        flags = self._flags(mask)
        first_infos = self._begin(mask)
        for name in self.parameters.ranges:
            present = self._drawn_numbers.get(name, 0)
            self._drawn_numbers[name] = self._where(flags, first_infos[name], present)
        for name in {*self._names, *first_infos}:
            values = first_infos.get(name, self._zeros)
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
        """Return the mask of the plants to reset: all, unless the options say otherwise."""
        if "reset_mask" not in options:
            return np.ones(self.num_envs, np.bool_)
        mask = options["reset_mask"]
        if hasattr(mask, "cpu"):  # a tensor
            mask = mask.cpu().numpy()
        if (
            not isinstance(mask, np.ndarray)
            or mask.dtype != np.bool_
            or mask.shape != (self.num_envs,)
            or not mask.any()
        ):
            allowed = f"an array of bool, shape ({self.num_envs},), at least one of them True"
            reject("options['reset_mask']", options["reset_mask"], allowed)
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
        """Begin an episode of some plants; return those of their infos at k = 0 that are not 0.

        The arrays have the shape (num_envs,); only the elements of these plants are used.
        """

    @abstractmethod
    def _checked_actions(self, actions: Any) -> Array:
        """Return the actions, shape (num_envs,); 0 for plants whose episode has ended.

        A ValueError is raised for actions of another shape and for those that are not finite.
        """

    @abstractmethod
    def _advance(self, a: Array) -> tuple[Array, Array, Array, Array, Infos]:
        """Move all plants by one sample; return what `step` returns if no episode ends."""

    @abstractmethod
    def _final(self, ended: Mask, observations: Array) -> Array:
        """Return `final_obs`: the observations of plants whose episode has just ended."""
