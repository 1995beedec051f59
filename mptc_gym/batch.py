"""Define the base class of the vector environments in NumPy and PyTorch.

`BatchEnv` handles the arguments, resets, time limits and infos of a vector environment.
`MiddlePointVectorEnv` implements the plants with NumPy, and `MiddlePointTorchEnv` with PyTorch.
A mask is a bool array, shape (num_envs,), which is True for the selected plants.
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
from mptc_gym.plant.checks import count, reject
from mptc_gym.plant.dynamics import FACTORS
from mptc_gym.plant.parameters import Parameters
from mptc_gym.plant.signals import UNLIMITED

Array = Any  # a NumPy array or a PyTorch tensor, depending on the environment
Infos = dict[str, Any]
Mask = NDArray[np.bool_]  # True for the selected plants, shape (num_envs,)


class BatchEnv(HasJsonSpec, VectorEnv[Array, Array, Array], ABC):
    """Base class of the environments that step n plants at once, in NumPy or in PyTorch.

    Parameters
    ----------
    num_envs
        Number n of plants.
    max_episode_steps
        Number of samples after which an episode is truncated; None or -1 means no limit.
    autoreset_mode
        When to reset a plant whose episode has ended: an `AutoresetMode` of Gymnasium, or the
        value of an `AutoresetMode`, such as "NextStep".
    arguments
        Keyword arguments of `MiddlePointEnv`, by name, except `render_mode`.

    Attributes
    ----------
    _where : callable
        The function `numpy.where` or `torch.where`, which a subclass sets.
    _as_array : callable
        A function or method of a subclass, which copies a NumPy array, shape (num_envs,), to a
        new NumPy array or PyTorch tensor.
    _window
        The object that stores the observations, which a subclass of `BatchEnv` sets.
        `_window.present()` returns a copy of the present observations, shape (num_envs, size).
    _zeros : array
        Constant zeros, shape (num_envs,), in an array or a tensor that a subclass sets.
    """

    _where: Any
    _as_array: Any
    _window: Any
    _zeros: Array

    def __init__(
        self,
        num_envs: int,
        max_episode_steps: int | None,
        autoreset_mode: str | AutoresetMode,
        arguments: Mapping[str, Any],
    ) -> None:
        """Prepare the plants; the docstring of the class describes the arguments."""
        self.parameters = Parameters(**arguments)
        self.num_envs = count("num_envs", num_envs, 1)
        self._episode_length = UNLIMITED  # samples after which an episode is truncated
        if max_episode_steps not in (None, -1):
            self._episode_length = count("max_episode_steps", max_episode_steps, 1, UNLIMITED)
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self.single_action_space = Box(-1.0, 1.0, (1,), np.float32)
        self.single_observation_space = observation_space(self.parameters)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._info_names = [*INFO]  # keys of the infos of every step
        if self.parameters.is_disturbed:
            self._info_names.append("disturbance")
        if self.parameters.drifts:
            self._info_names += FACTORS
        self._was_reset = False
        # Steps of the environment so far, without the steps that reset all plants. The sample
        # k of a plant is the clock minus the start of the plant's episode.
        self._clock = 0
        self._starts = np.zeros(num_envs, np.int64)  # the clock at k = 0 of each plant
        self._next_end = 0  # the clock when an episode ends next
        # Plants whose episode has ended and that have not been reset; None for no plant.
        self._ended: Mask | None = None

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, Infos]:
        """Bring all or some plants to rest, and begin an episode of each of these plants.

        Parameters
        ----------
        seed
            Seed that restarts the random number streams, as the docstring of the subclass
            describes. Without a seed, the random number streams continue.
        options
            `reset_mask`, a bool array of shape (num_envs,), selects the plants to reset. The
            first reset of an environment must include all plants. Unknown options are ignored,
            as in Gymnasium's environments.

        Returns
        -------
        observations : array
            The observations, shape (num_envs, size). For a plant that is not reset, the row of
            the plant holds the plant's last observation.
        infos : dict
            Infos by name, in arrays of shape (num_envs,). For each info `name`, the entry
            `_name` is a mask, a bool array that is True for the plants that have this info. The
            masks of infos are False for plants that are not reset. Several infos may share one
            array as their mask.

        Raises
        ------
        ValueError
            If an argument is invalid. A ValueError leaves the environment unchanged.
        ResetNeeded
            If the first reset does not include all plants.
        """
        mask = self._checked_mask(options or {})
        if not self._was_reset and not mask.all():
            raise ResetNeeded("the first reset must include all environments")
        self._prepare(mask, seed)  # checks and applies the seed
        infos = self._begin_episodes(mask, infos={})
        self._was_reset = True
        return self._window.present(), infos

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, Infos]:
        """Apply one normalised action to each plant for one sample.

        Parameters
        ----------
        actions
            Actions a(k), shape (num_envs, 1): -1 commands the flow `u_min`, and 1 commands
            `u_max`.

        Returns
        -------
        observations : array
            The observations at sample k+1, shape (num_envs, size).
        rewards, terminations, truncations : array
            Rewards for the control errors e(k+1), and flags of episodes that have terminated or
            were truncated, each of shape (num_envs,). No episode terminates; the time limit
            truncates episodes.
        infos : dict
            Infos at sample k+1 by name, in arrays of shape (num_envs,). For each info `name`,
            the entry `_name` is a mask, a bool array that is True for the plants that have this
            info. Several infos may share one array as their mask.

        Raises
        ------
        ValueError
            If the actions do not have the shape (num_envs, 1), or if an action is not finite. A
            ValueError leaves the environment unchanged.
        ResetNeeded
            If `step` is called before the first `reset`; with the autoreset mode "Disabled",
            also if an episode has ended and its plant was not reset.
        """
        if not self._was_reset:
            raise ResetNeeded("call reset before step")
        reset_now = self._ended  # plants to reset in the mode "NextStep"; None for no plant
        if reset_now is not None and self.autoreset_mode is AutoresetMode.DISABLED:
            ended_plants = np.flatnonzero(reset_now)
            raise ResetNeeded(f"reset environments {ended_plants}, whose episodes have ended")
        a = self._checked_actions(actions)
        if reset_now is not None and reset_now.all():  # no plant advances
            infos = self._begin_episodes(reset_now, infos={})
            rewards = self._zeros + 0.0  # a copy, as the caller may overwrite the rewards
            terminations = self._as_array(~reset_now)  # all False
            truncations = self._as_array(~reset_now)
            return self._window.present(), rewards, terminations, truncations, infos

        self._clock += 1
        observations, rewards, terminations, truncations, infos = self._advance(a)
        # The usual case: no episode ends. No plant waits for a reset either, because
        # `_next_end` counts from the earliest start, which stays until that plant is reset.
        if self._clock < self._next_end:
            return observations, rewards, terminations, truncations, infos
        if reset_now is not None:  # replaces what `_advance` returned for these plants
            rewards = self._where(self._as_array(reset_now), 0, rewards)
            self._begin_episodes(reset_now, infos)
            observations = self._window.present()
        ended = self._clock - self._starts >= self._episode_length
        truncations = self._as_array(ended)
        if self.autoreset_mode is AutoresetMode.SAME_STEP:  # in which an episode has ended
            self._add_final(ended, observations, infos)
            self._begin_episodes(ended, infos)
            observations = self._window.present()
        elif ended.any():
            self._ended = ended
        return observations, rewards, terminations, truncations, infos

    def _add_final(self, ended: Mask, observations: Array, infos: Infos) -> None:
        """Add `final_obs` and `final_info` to the infos of a step for the plants in `ended`.

        `observations`, shape (num_envs, size), and `infos` hold the last observation and the
        last infos of each episode that has ended. `ended` is a mask.
        """
        flags = self._as_array(ended)
        final_info: Infos = {}
        for name in self._info_names:
            final_info[name] = self._where(flags, infos[name], 0)
            final_info[f"_{name}"] = flags
        infos["final_info"] = final_info
        infos["_final_info"] = flags
        infos["final_obs"] = self._final_observations(ended, observations)
        infos["_final_obs"] = flags

    def _begin_episodes(self, mask: Mask, infos: Infos) -> Infos:
        """Begin an episode of each plant in `mask`, and return infos at sample k = 0.

        The dict `infos` holds the infos of a step, or is empty. `infos` is changed in place and
        returned; the elements of plants outside `mask` do not change.
        """
        self._starts[mask] = self._clock
        self._next_end = int(self._starts.min()) + self._episode_length
        if self._ended is not None:
            still_ended = self._ended & ~mask
            self._ended = still_ended if still_ended.any() else None
        flags = self._as_array(mask)
        first_infos = self._begin(mask)
        # The masks of a step, which are True for all plants, stay as they are. Infos that
        # `first_infos` lacks are 0 at k = 0, and infos that a step lacks, such as a sampled
        # delay, are 0 for plants outside `mask`. A dict lists the names and not a set, whose
        # order would differ from process to process.
        for name in dict.fromkeys([*self._info_names, *first_infos]):
            values = first_infos.get(name, self._zeros)
            infos[name] = self._where(flags, values, infos.get(name, 0))
            infos.setdefault(f"_{name}", flags)
        return infos

    def _checked_mask(self, options: Mapping[str, Any]) -> Mask:
        """Return the mask of the plants to reset: `options["reset_mask"]`, or all plants."""
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
    def _prepare(self, mask: Mask, seed: Any) -> None:
        """Check the seed of a `reset` of the plants in `mask`, and apply the seed.

        A ValueError is raised if the seed is invalid.
        """

    @abstractmethod
    def _begin(self, mask: Mask) -> dict[str, Array]:
        """Begin an episode of each plant in `mask`, and return infos at sample k = 0.

        The returned dict lacks infos that are always 0 at k = 0, such as `output`. Every info
        is an array of shape (num_envs,), whose elements for plants outside `mask` have no
        meaning.
        """

    @abstractmethod
    def _checked_actions(self, actions: Any) -> Array:
        """Return the actions, shape (num_envs,), with 0 for plants whose episode has ended.

        A ValueError is raised if the actions do not have the shape (num_envs, 1), or if an
        action is not finite.
        """

    @abstractmethod
    def _advance(self, a: Array) -> tuple[Array, Array, Array, Array, Infos]:
        """Advance all plants by one sample, and return what `step` returns if no episode ends.

        `a` holds the actions that `_checked_actions` returned, shape (num_envs,).
        """

    @abstractmethod
    def _final_observations(self, ended: Mask, observations: Array) -> Array:
        """Return the rows of `observations`, shape (num_envs, size), of plants in `ended`."""
