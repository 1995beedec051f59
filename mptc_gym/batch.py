"""Implement what the vector environments share: arguments, masks, time limits, resets, infos.

`MiddlePointVectorEnv` adds plants in NumPy arrays, and `MiddlePointTorchEnv` adds plants in
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
from mptc_gym.plant import FACTORS
from mptc_gym.plant_state import PlantState, plant_state
from mptc_gym.signals import FOREVER

Array = Any  # of NumPy or PyTorch, depending on the environment
Infos = dict[str, Any]
Mask = NDArray[np.bool_]  # of plants, shape (num_envs,)


class BatchEnv(HasPlainSpec, VectorEnv[Array, Array, Array], ABC):
    """n plants that advance together: the part that does not depend on the array library.

    A subclass sets these attributes:

    Attributes
    ----------
    _where : callable
        `numpy.where` or `torch.where`.
    _window
        The observations; `_window.present()` returns a copy of the present ones.
    _zeros : array
        Zeros of the library, shape (num_envs,), only to be read.
    """

    _where: Any
    _window: Any
    _zeros: Array

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
        self._limit = FOREVER if limit == -1 else min(FOREVER, int(limit))  # samples
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
        self._names = [*INFO]
        if self.parameters.is_disturbed:
            self._names.append("disturbance")
        if self.parameters.drifts:
            self._names += FACTORS
        self._masks = [f"_{name}" for name in self._names]
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
            Restarts the random numbers; see the docstring of the class. Without a seed, the
            random numbers continue.
        options
            `reset_mask`, a bool array of shape (num_envs,), selects the plants to reset. The
            first reset must include all plants. `MiddlePointTorchEnv` also takes `signals`.

        Returns
        -------
        observations : array
            The observations, shape (num_envs, size). Plants that are not reset keep their last
            observation.
        infos : dict
            The infos, in arrays of shape (num_envs,), and their masks, which are False for
            plants that are not reset. Several masks may be the same array.

        Raises
        ------
        ValueError
            If an argument is invalid. The environment is then unchanged.
        ResetNeeded
            If the first reset does not include all plants.
        """
        if options is not None and not isinstance(options, Mapping):
            reject("options", options, "a dict or None")
        mask = self._checked_mask(options or {})
        if not self._first_end and not mask.all():
            raise ResetNeeded("the first reset must include all environments")
        self._prepare(mask, seed, options or {})
        infos = self._restart(mask, {})
        return self._window.present(), infos

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, Infos]:
        """Apply normalised actions for one sample.

        Parameters
        ----------
        actions
            The actions a(k), shape (num_envs, 1).

        Returns
        -------
        observations : array
            The observations at k+1, shape (num_envs, size).
        rewards, terminations, truncations : array
            The rewards of e(k+1) and the flags, shape (num_envs,). No episode terminates.
        infos : dict
            The infos at k+1, in arrays of shape (num_envs,), and their masks. Several masks may
            be the same array.

        Raises
        ------
        ValueError
            If the actions have another shape or are not finite. The environment is then
            unchanged.
        ResetNeeded
            Before the first reset; with autoreset disabled, also if an episode has ended.
        """
        if not self._first_end:
            raise ResetNeeded("call reset before step")
        ended = self._ended
        if ended is not None and self.autoreset_mode is AutoresetMode.DISABLED:
            which = np.flatnonzero(ended)
            raise ResetNeeded(f"reset environments {which}, whose episodes have ended")
        a = self._checked_actions(actions)
        if ended is not None and ended.all():
            infos = self._restart(ended, {})
            no_rewards = self._zeros + 0  # a copy
            terminations, truncations = self._as_array(~ended), self._as_array(~ended)
            return self._window.present(), no_rewards, terminations, truncations, infos
        self._clock += 1
        returned = self._advance(a)
        if self._clock < self._first_end:
            return returned
        return self._end_episodes(*returned)

    def _end_episodes(
        self, observations: Array, rewards: Array, terminations: Array, _: Array, infos: Infos
    ) -> tuple[Array, Array, Array, Array, Infos]:
        """Return what a step returns where episodes end, or have ended at the previous step.

        The arguments are what the step would return if no episode ended.
        """
        ended = self._clock - self._starts >= self._limit
        if self.autoreset_mode is AutoresetMode.SAME_STEP:
            flags = self._as_array(ended)
            final_info = {name: self._where(flags, infos[name], 0) for name in self._names}
            infos["final_info"] = final_info | dict.fromkeys(self._masks, flags)
            infos["_final_info"] = flags
            infos["final_obs"] = self._final(ended, observations)
            infos["_final_obs"] = flags
            self._restart(ended, infos)
            return self._window.present(), rewards, terminations, self._as_array(ended), infos
        if self._ended is not None:  # at the previous step: this step resets these plants
            rewards = self._where(self._as_array(self._ended), 0, rewards)
            self._restart(self._ended, infos)
            observations = self._window.present()
            ended = self._clock - self._starts >= self._limit
        self._ended = ended if ended.any() else None
        return observations, rewards, terminations, self._as_array(ended), infos

    def _restart(self, mask: Mask, infos: Infos) -> Infos:
        """Begin an episode of some plants, and return infos that hold k = 0 for these plants.

        `infos` are the infos of a step, which go on for the other plants, or an empty dict.
        """
        self._starts[mask] = self._clock
        self._first_end = int(self._starts.min()) + self._limit
        if self._ended is not None:
            still_ended = self._ended & ~mask
            self._ended = still_ended if still_ended.any() else None
        flags = self._as_array(mask)
        first_infos = self._begin(mask)
        for name in {*self._names, *first_infos}:
            values = first_infos.get(name, self._zeros)
            infos[name] = self._where(flags, values, infos.get(name, 0))
            infos.setdefault(f"_{name}", flags)
        return infos

    def plant_state(self) -> PlantState:
        """Return what a teacher may know of each plant at the present sample.

        The state holds delay (samples), dead zone (t/h), gain (degC per t/h) and time constant
        (s), as they have drifted, and the load (degC), each of shape (num_envs,). A policy
        cannot see this state, but a critic or a teacher in training may. The present sample is
        that of the observation which `step` or `reset` has just returned.

        Raises
        ------
        ResetNeeded
            Before the first reset.
        """
        if not self._first_end:
            raise ResetNeeded("call reset before plant_state")
        ages = self._zeros + self._as_array(self._clock - self._starts)
        numbers, load = self._hidden_state()
        return plant_state(self.parameters, numbers, ages, load)

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
    def _as_array(self, values: NDArray[Any]) -> Array:
        """Return a mask or integers, shape (num_envs,), in a new array of the library."""

    @abstractmethod
    def _hidden_state(self) -> tuple[dict[str, Array], Array]:
        """Return what infos and observations of the present sample do not show.

        These are the plant numbers that are ranges, by name, and the load w, degC, in arrays of
        shape (num_envs,).
        """

    @abstractmethod
    def _prepare(self, mask: Mask, seed: Any, options: Mapping[str, Any]) -> None:
        """Check seed and options of a `reset` of the plants in the mask, then apply both."""

    @abstractmethod
    def _begin(self, mask: Mask) -> dict[str, Array]:
        """Begin an episode of the plants in the mask; return the infos at k = 0 that are not 0.

        The arrays have the shape (num_envs,); only the elements of the mask are of use.
        """

    @abstractmethod
    def _checked_actions(self, actions: Any) -> Array:
        """Return the actions, shape (num_envs,); 0 for plants whose episode has ended.

        Actions of another shape and actions that are not finite raise a ValueError.
        """

    @abstractmethod
    def _advance(self, a: Array) -> tuple[Array, Array, Array, Array, Infos]:
        """Move all plants by one sample; return what `step` returns if no episode ends."""

    @abstractmethod
    def _final(self, ended: Mask, observations: Array) -> Array:
        """Return `final_obs`: the observations of plants whose episode has just ended."""
