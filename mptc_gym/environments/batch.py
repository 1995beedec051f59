"""Implement what the vector environments share: arguments, masks, time limits, resets, infos.

A mask is an array of bool that selects plants. `MiddlePointVectorEnv` adds plants in NumPy
arrays, and `MiddlePointTorchEnv` adds plants in PyTorch tensors.
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

from mptc_gym.env import INFO, HasJsonSpec, observation_space
from mptc_gym.plant.checks import MOST_PLANTS, count, is_count, reject
from mptc_gym.plant.dynamics import FACTORS
from mptc_gym.plant.parameters import Parameters
from mptc_gym.plant.signals import UNLIMITED
from mptc_gym.plant.state import PlantState, plant_state

Array = Any  # a NumPy array or a PyTorch tensor, depending on the environment
Infos = dict[str, Any]
Mask = NDArray[np.bool_]  # True for the selected plants, shape (num_envs,)


class BatchEnv(HasJsonSpec, VectorEnv[Array, Array, Array], ABC):
    """n plants that advance together: the part that does not depend on the array library.

    The array library is NumPy or PyTorch.

    Parameters
    ----------
    num_envs
        Number n of plants.
    max_episode_steps
        Samples after which an episode is truncated; None or -1 for no limit.
    autoreset_mode
        An `AutoresetMode` or its value: when the plant of an ended episode is reset.
    arguments
        The arguments of the plants, by name.

    Attributes
    ----------
    _where : callable
        `numpy.where` or `torch.where`. A subclass sets this attribute.
    _window
        The object that keeps the observations; `_window.present()` returns a copy of the
        present observations, shape (num_envs, size). A subclass sets this attribute.
    _zeros : array
        Zeros in an array of the library, shape (num_envs,), that nobody modifies. A subclass
        sets this attribute.
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
        self._limit = UNLIMITED if limit == -1 else min(UNLIMITED, int(limit))  # samples
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
        # Keys of the infos of every step, and below keys of the masks of these infos.
        self._names = [*INFO]
        if self.parameters.is_disturbed:
            self._names.append("disturbance")
        if self.parameters.drifts:
            self._names += FACTORS
        self._masks = [f"_{name}" for name in self._names]
        # Steps of the environment so far. The sample k of a plant is the clock minus the start
        # of the plant's episode.
        self._clock = 0
        self._starts = np.zeros(num_envs, np.int64)  # the clock at k = 0 of each plant
        self._first_end = 0  # the clock when an episode ends next; 0 before the first reset
        self._ended: Mask | None = None  # plants whose episode has ended; None for no plant

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, Infos]:
        """Bring all or some plants to rest and start an episode of each.

        Parameters
        ----------
        seed
            Restarts the random number streams; see the docstring of the class. Without a seed,
            the next episodes continue the present streams.
        options
            `reset_mask`, a bool array of shape (num_envs,), selects the plants to reset. The
            first reset must include all plants. `MiddlePointTorchEnv` also takes `signals`.

        Returns
        -------
        observations : array
            The observations, shape (num_envs, size). The row of a plant that is not reset is
            the plant's last observation.
        infos : dict
            The infos, in arrays of shape (num_envs,), and the masks of the infos, which are
            False for plants that are not reset. Several masks may be the same array.

        Raises
        ------
        ValueError
            If an argument is invalid. The error leaves the environment unchanged.
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
            The actions a(k), shape (num_envs, 1): -1 commands the flow `u_min`, 1 `u_max`.

        Returns
        -------
        observations : array
            The observations at sample k+1, shape (num_envs, size).
        rewards, terminations, truncations : array
            The rewards of the errors e(k+1), and the flags of ended episodes, shape
            (num_envs,). No episode terminates; the time limit truncates episodes.
        infos : dict
            The infos at sample k+1, in arrays of shape (num_envs,), and the masks of the infos.
            Several masks may be the same array.

        Raises
        ------
        ValueError
            If the actions have another shape or are not finite. The error leaves the
            environment unchanged.
        ResetNeeded
            If `step` is called before the first `reset`; with the autoreset mode "Disabled",
            also if an episode has ended and its plant was not reset.
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
        """Return what `step` returns when episodes end now, or have ended at the previous step.

        The autoreset mode decides whether this method resets the plants of the ended episodes.
        The arguments `observations`, `rewards`, `terminations` and `infos`, and the unused
        truncations, are what `step` would return if no episode ended.
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
        if self._ended is not None:  # plants that ended at the previous step are reset now
            rewards = self._where(self._as_array(self._ended), 0, rewards)
            self._restart(self._ended, infos)
            observations = self._window.present()
            ended = self._clock - self._starts >= self._limit
        self._ended = ended if ended.any() else None
        return observations, rewards, terminations, self._as_array(ended), infos

    def _restart(self, mask: Mask, infos: Infos) -> Infos:
        """Begin an episode of some plants, and return infos with sample k = 0 of these plants.

        Parameters
        ----------
        mask
            The plants.
        infos
            The infos of a step, which stay valid for the other plants, or an empty dict after a
            reset. This dict is filled and returned.
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
        """Return what a teacher in training may know of each plant at the present sample.

        A policy cannot observe the state, but a critic or a teacher in training may use the
        state. The present sample is that of the observation which `step` or `reset` has just
        returned.

        Returns
        -------
        PlantState
            Delay (samples), dead zone (t/h), gain (degC per t/h), time constant (s) and load
            (degC), each of shape (num_envs,). Gain and time constant include drift so far.

        Raises
        ------
        ResetNeeded
            If `plant_state` is called before the first `reset`.
        """
        if not self._first_end:
            raise ResetNeeded("call reset before plant_state")
        ages = self._zeros + self._as_array(self._clock - self._starts)
        numbers, load = self._hidden_state()
        return plant_state(self.parameters, numbers, ages, load)

    def _checked_mask(self, options: Mapping[str, Any]) -> Mask:
        """Return the mask of the plants to reset: `options["reset_mask"]`, or else all plants.

        A ValueError is raised if the mask is not an array of bool with at least one True.
        """
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
        """Return a mask or integers, shape (num_envs,), as a new array of the array library."""

    @abstractmethod
    def _hidden_state(self) -> tuple[dict[str, Array], Array]:
        """Return the plant numbers and the load, which no observation shows, for `plant_state`.

        Returns
        -------
        numbers : dict of array
            The numbers that were drawn for arguments that are ranges, by name, shape
            (num_envs,).
        load : array
            The load w at the present sample, degC, shape (num_envs,).
        """

    @abstractmethod
    def _prepare(self, mask: Mask, seed: Any, options: Mapping[str, Any]) -> None:
        """Check seed and options of a `reset`, restart random numbers, and store the options.

        Parameters
        ----------
        mask
            The plants to reset, shape (num_envs,).
        seed, options
            The arguments of `reset`; a ValueError is raised if one of them is invalid.
        """

    @abstractmethod
    def _begin(self, mask: Mask) -> dict[str, Array]:
        """Begin an episode of the plants in the mask; return the infos at k = 0 that are not 0.

        The arrays have the shape (num_envs,); elements of plants outside the mask have no
        meaning.
        """

    @abstractmethod
    def _checked_actions(self, actions: Any) -> Array:
        """Return the actions, shape (num_envs,), with 0 for plants whose episode has ended.

        Actions of a shape other than (num_envs, 1) and actions that are not finite raise a
        ValueError.
        """

    @abstractmethod
    def _advance(self, a: Array) -> tuple[Array, Array, Array, Array, Infos]:
        """Move all plants by one sample, and return what `step` returns if no episode ends.

        `a` are the checked actions, shape (num_envs,).
        """

    @abstractmethod
    def _final(self, ended: Mask, observations: Array) -> Array:
        """Return `final_obs`, the last observations of the plants whose episode has just ended.

        `ended` is True for these plants, shape (num_envs,), and `observations` are the
        observations of all plants, shape (num_envs, size).
        """
