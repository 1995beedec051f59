"""Hold what the vector environments share: arguments, masks, time limits, autoresets, infos.

`MiddlePointVectorEnv` in NumPy and `MiddlePointTorchEnv` in PyTorch each add how their plants
move, in arrays or in tensors of their own.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from mptc_gym.checks import MOST_NUMBERS, MOST_PLANTS, count, is_count, reject
from mptc_gym.env import action_space, observation_space
from mptc_gym.parameters import Parameters
from mptc_gym.signals import FOREVER

Array = Any  # of NumPy or PyTorch, as the environment has them
Infos = dict[str, Any]
Mask = NDArray[np.bool_]  # of plants, shape (num_envs,)

INFO = ("output", "setpoint", "error", "command", "applied", "noise")
FACTORS = ("gain_factor", "time_constant_factor")


class BatchEnv(VectorEnv[Array, Array, Array]):
    """n plants that advance together, without what depends on the library of their arrays."""

    def __init__(
        self,
        num_envs: int,
        max_episode_steps: int | None,
        autoreset_mode: str | AutoresetMode,
        arguments: Mapping[str, Any],
    ) -> None:
        self.parameters = Parameters.of_environment(arguments)
        self.num_envs = _checked_count(num_envs, self.parameters)
        self._limit = _checked_limit(max_episode_steps)
        self.autoreset_mode = _checked_mode(autoreset_mode)
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self.single_action_space = action_space()
        self.single_observation_space = observation_space(self.parameters)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._factors = FACTORS if self.parameters.drifts else ()
        load = ("disturbance",) if self.parameters.is_disturbed else ()
        self._names = (*INFO, *load, *self._factors)  # of what infos hold
        self._masks = tuple(f"_{name}" for name in self._names)
        # Each plant's k is the clock less where it started.
        self._clock = 0
        self._starts = np.zeros(num_envs, np.int64)
        self._first_end = 0
        self._was_reset = False
        self._ended: Mask | None = None  # those still to be reset, if any

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, Infos]:
        """Bring all plants, or some, to rest and start an episode of each.

        Parameters
        ----------
        seed
            Starts the random numbers anew; see the class docstring. Without it, they go on.
        options
            `reset_mask`, an array of bool, shape (num_envs,), says which plants are reset.

        Returns
        -------
        observations
            Shape (num_envs, observation_size); the last one of a plant that was not reset.
        infos
            Arrays of shape (num_envs,), and a mask of the plants that were reset with each,
            which may be one array.

        Raises
        ------
        ValueError
            If an argument does not fit. Nothing is changed then.
        ResetNeeded
            If the first reset is not one of all plants.
        """
        if options is not None and not isinstance(options, Mapping):
            reject("options", options, "a dict or None")
        mask = self._checked_mask(options or {})
        if not self._was_reset and not mask.all():
            raise ResetNeeded("reset all environments before some of them")
        self._prepare(mask, seed, options or {})
        self._was_reset = True
        infos: Infos = {}
        self._restart(mask, infos)
        return self._observations(), infos

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, Infos]:
        """Apply normalised actions for one sample.

        Parameters
        ----------
        actions
            a(k) of each plant, shape (num_envs, 1).

        Returns
        -------
        observations
            Shape (num_envs, observation_size).
        rewards
            Shape (num_envs,).
        terminations, truncations
            Shape (num_envs,), bool.
        infos
            Arrays of shape (num_envs,) and their masks, which may be one array.

        Raises
        ------
        ValueError
            If the actions have another shape, or one is not finite. The plants are untouched
            then.
        ResetNeeded
            If the environments have never been reset, or, with autoreset disabled, if one has
            ended.
        """
        if not self._was_reset:
            raise ResetNeeded("call reset before step")
        ended = self._ended
        if ended is not None and self.autoreset_mode is AutoresetMode.DISABLED:
            which = np.flatnonzero(ended)
            raise ResetNeeded(f"episodes of environments {which} have ended: reset them")
        a = self._checked_actions(actions)
        if ended is not None and ended.all():
            infos: Infos = {}
            self._restart(ended, infos)
            none = [self._flags(~ended) for _ in range(2)]
            return self._observations(), self._zeros + 0, *none, infos
        self._clock += 1
        observations, rewards, terminations, truncations, infos = self._advance(a)
        if self._clock >= self._first_end:
            observations, rewards, truncations = self._end(observations, rewards, infos)
        return observations, rewards, terminations, truncations, infos

    def _end(self, observations: Array, rewards: Array, infos: Infos) -> tuple[Array, ...]:
        """Do what the end of an episode asks for, also to the infos; return what it changes."""
        ended = self._clock - self._starts >= self._limit
        flags = self._flags(ended)
        if self.autoreset_mode is AutoresetMode.SAME_STEP:
            final = {name: self._where(flags, infos[name], 0) for name in self._names}
            final |= dict.fromkeys(self._masks, flags)
            infos |= {"final_info": final, "final_obs": self._final(ended, observations)}
            infos |= {"_final_info": flags, "_final_obs": flags}
            self._restart(ended, infos)
            return self._observations(), rewards, self._flags(ended)
        if self._ended is not None:  # at the step before this one
            rewards = self._where(self._flags(self._ended), 0, rewards)
            self._restart(self._ended, infos)
            observations = self._observations()
            ended = self._clock - self._starts >= self._limit
        self._ended = ended if ended.any() else None
        return observations, rewards, self._flags(ended)

    def _restart(self, mask: Mask, infos: Infos) -> None:
        """Begin an episode of some plants, and put their infos of k = 0 in."""
        self._starts[mask] = self._clock
        self._first_end = int(self._starts.min()) + self._limit
        if self._ended is not None:
            left = self._ended & ~mask
            self._ended = left if left.any() else None
        flags, first = self._flags(mask), self._begin(mask)
        for name in {*self._names, *first}:
            values = first.get(name, self._zeros)
            infos[name] = self._where(flags, values, infos.get(name, 0))
            infos.setdefault(f"_{name}", flags)

    def _checked_mask(self, options: Mapping[str, Any]) -> Mask:
        """Return which plants a reset is of."""
        if "reset_mask" not in options:
            return np.ones(self.num_envs, np.bool_)
        given = options["reset_mask"]
        mask = self._on_host(given)
        if (
            not isinstance(mask, np.ndarray)
            or mask.dtype != np.bool_
            or mask.shape != (self.num_envs,)
            or not mask.any()
        ):
            allowed = f"an array of bool, shape ({self.num_envs},), at least one of them True"
            reject("options['reset_mask']", given, allowed)
        return mask.copy()

    # What an environment adds.

    _where: Any  # numpy.where or torch.where
    _zeros: Array  # one a plant; only to be read

    def _on_host(self, mask: Any) -> Any:
        """Return a mask as an array of NumPy, if it is one of the library."""
        return mask

    def _flags(self, mask: Mask) -> Array:
        """Return a new array of the library."""
        raise NotImplementedError

    def _prepare(self, mask: Mask, seed: Any, options: Mapping[str, Any]) -> None:
        """Check the other arguments of `reset`, then do what they say."""
        raise NotImplementedError

    def _checked_actions(self, actions: Any) -> Array:
        """Return the actions, shape (num_envs,); 0 where they are ignored."""
        raise NotImplementedError

    def _begin(self, mask: Mask) -> dict[str, Array]:
        """Begin an episode of some plants; return their infos of k = 0 that are not 0."""
        raise NotImplementedError

    def _advance(self, a: Array) -> tuple[Array, Array, Array, Array, Infos]:
        """Move all plants by a sample, and return what `step` does where no episode ends."""
        raise NotImplementedError

    def _observations(self) -> Array:
        """Return the present observations, which the caller may overwrite."""
        raise NotImplementedError

    def _final(self, ended: Mask, observations: Array) -> Array:
        """Return `final_obs`."""
        raise NotImplementedError


def _checked_count(num_envs: int, parameters: Parameters) -> int:
    """Return the number of plants, if they fit in the memory of usual machines."""
    num_envs = count("num_envs", num_envs, 1, MOST_PLANTS)
    inputs = parameters.range_of("delay")[1] + len(parameters.b)
    most = int(MOST_NUMBERS // (3 * inputs + parameters.observation_size))
    if num_envs > most:
        reject("num_envs", num_envs, f"at most {most:,} with this delay and these windows")
    return num_envs


def _checked_limit(max_episode_steps: int | None) -> int:
    """Return the samples of an episode; `FOREVER` if there is no limit, None or -1."""
    if max_episode_steps is None:
        return FOREVER
    if not is_count(max_episode_steps, -1) or max_episode_steps == 0:
        allowed = "an integer of at least 1, or None or -1 for no limit"
        reject("max_episode_steps", max_episode_steps, allowed)
    return FOREVER if max_episode_steps == -1 else min(FOREVER, int(max_episode_steps))


def _checked_mode(autoreset_mode: str | AutoresetMode) -> AutoresetMode:
    """Return an autoreset mode that is given by itself or by its value."""
    try:
        return AutoresetMode(autoreset_mode)
    except ValueError:
        allowed = ", ".join(repr(mode.value) for mode in AutoresetMode)
        reject("autoreset_mode", autoreset_mode, f"one of {allowed}")
