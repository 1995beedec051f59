"""Wrap a vector environment so that actions change the feedwater flow instead of setting it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorActionWrapper, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from mptc_gym.environments.layers import plant_groups
from mptc_gym.plant.checks import many_actions, reject
from mptc_gym.wrappers import ACTUATOR_NUMBERS, Actuator


class IncrementalAction(VectorActionWrapper):
    """Wrapper whose actions change the feedwater flows of many plants instead of setting them.

    `reset` and `step` return the same values as an `mptc_gym.wrappers.IncrementalAction` around
    each single environment. The wrapper supports all three autoreset modes of Gymnasium, and
    resets of only some plants.

    Parameters
    ----------
    env
        A `MiddlePointVectorEnv`, or another vector environment of `MiddlePointEnv` in NumPy,
        such as Gymnasium's `SyncVectorEnv`.
    max_move, compensate_dead_zone
        The arguments of `mptc_gym.wrappers.IncrementalAction`.

    Raises
    ------
    ValueError
        If `env` holds no `MiddlePointEnv` in NumPy, or if an argument is out of range. `step`
        raises a ValueError if actions are not finite numbers of shape (num_envs, 1).
    """

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        *,
        max_move: float = 0.4,
        compensate_dead_zone: bool | float = False,
    ) -> None:
        """Wrap a vector environment; the docstring of the class describes the arguments."""
        groups = plant_groups(env) if isinstance(env, VectorEnv) else []
        if not groups:
            allowed = (
                "a vector environment of MiddlePointEnv in NumPy; mptc_gym.wrappers takes one"
            )
            reject("env", env, allowed)
        super().__init__(env)
        self.single_action_space = Box(-1.0, 1.0, (1,), np.float32)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.increments = max_move, compensate_dead_zone
        # Dead zones and limits of all plants, t/h, each of shape (num_envs,); for a range, from
        # which `reset` draws, the lowest value.
        self._numbers = {}
        plants_per_group = [group.num_envs for group in groups]
        for name in ACTUATOR_NUMBERS:
            number_of_group = [group.parameters.range_of(name)[0] for group in groups]
            self._numbers[name] = np.repeat(number_of_group, plants_per_group)
        self._actuator = Actuator(self._numbers, max_move, compensate_dead_zone)
        self._mode = AutoresetMode(env.metadata["autoreset_mode"])
        self._flows = np.zeros(self.num_envs)  # wanted flows v, t/h
        # The plants whose episode has ended, and that the next step resets.
        self._ended = np.zeros(self.num_envs, np.bool_)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> Any:
        """Reset all plants, or the plants in `reset_mask`, and set their wanted flows to 0 t/h.

        `seed` and `options` go to the wrapped environment, whose observations and infos are
        returned.
        """
        # The mask is read before the reset, in which Gymnasium's vector environments remove the
        # mask from the options.
        mask = np.ones(self.num_envs, np.bool_)
        if isinstance(options, Mapping) and "reset_mask" in options:
            mask = np.asarray(options["reset_mask"])  # of an array or a tensor
        observations, infos = self.env.reset(seed=seed, options=options)
        self._begin_episodes(mask, infos)
        return observations, infos

    def step(self, actions: Any) -> Any:
        """Change the wanted flows by actions, shape (num_envs, 1), and step the environments.

        The returned values are those of `step` of the wrapped vector environment.
        """
        moves = many_actions(actions, self.num_envs, self._ended)
        actuator = self._actuator
        flows = self._flows + actuator.flow_per_action * moves.clip(-1.0, 1.0)
        flows = flows.clip(actuator.u_min, actuator.u_max)
        absolute_actions = actuator.action(flows).astype(np.float32)[:, np.newaxis]
        returned = self.env.step(absolute_actions)
        _, _, terminations, truncations, infos = returned
        self._flows = flows
        ended = terminations | truncations
        reset_now = ended if self._mode is AutoresetMode.SAME_STEP else self._ended
        if reset_now.any():
            self._begin_episodes(reset_now, infos)
        if self._mode is AutoresetMode.NEXT_STEP:
            self._ended = ended
        return returned

    def _begin_episodes(self, mask: NDArray[np.bool_], infos: dict[str, Any]) -> None:
        """Set the wanted flows of the plants in `mask`, shape (num_envs,), to 0 t/h.

        The infos of the reset hold the new values of dead zones and limits that are random.
        """
        for name in {*ACTUATOR_NUMBERS} & {*infos}:
            self._numbers[name][mask] = infos[name][mask]
        self._actuator = Actuator(self._numbers, *self.increments)
        self._flows[mask] = 0.0
        self._ended = self._ended & ~mask
