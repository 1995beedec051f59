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
from mptc_gym.wrappers import NUMBERS, Actuator


class IncrementalAction(VectorActionWrapper):
    """The action changes the flow: `mptc_gym.wrappers.IncrementalAction` for many plants.

    The wrapper keeps a wanted flow, in t/h, for each plant. `reset` and `step` return what as
    many single environments would return, each in `mptc_gym.wrappers.IncrementalAction`. All
    three autoreset modes, and resets of some of the plants, work.

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
        If `env` is of another kind or an argument is out of range. Also raised by `step`, if
        actions are not finite numbers of shape (num_envs, 1).
    """

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        *,
        max_move: float = 0.4,
        compensate_dead_zone: bool | float = False,
    ) -> None:
        groups = plant_groups(env) if isinstance(env, VectorEnv) else []
        if not groups:
            kind = "a vector environment of MiddlePointEnv in NumPy"
            reject("env", env, f"{kind}; mptc_gym.wrappers takes one")
        super().__init__(env)
        self.single_action_space = Box(-1.0, 1.0, (1,), np.float32)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.increments = max_move, compensate_dead_zone
        counts = [group.num_envs for group in groups]
        self._numbers = {}
        for name in NUMBERS:
            lowest = [group.parameters.range_of(name)[0] for group in groups]
            self._numbers[name] = np.repeat(lowest, counts)
        self._actuator = Actuator(self._numbers, *self.increments)
        self._mode = AutoresetMode(env.metadata["autoreset_mode"])
        self._flows = np.zeros(self.num_envs)  # wanted flows v, t/h
        # The plants whose episode has ended, and that the next step resets.
        self._ended = np.zeros(self.num_envs, np.bool_)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> Any:
        """Reset all environments, or those of `reset_mask`, and their wanted flows to 0 t/h.

        `seed` and `options`, which may hold `reset_mask`, are those of the wrapped environment,
        and so are the observations and infos that are returned.
        """
        # The mask is read before the reset, in which Gymnasium's vector environments remove the
        # mask from the options.
        mask = options.get("reset_mask") if isinstance(options, Mapping) else None
        if mask is None:
            mask = np.ones(self.num_envs, np.bool_)
        observations, infos = self.env.reset(seed=seed, options=options)
        self._begin_episodes(mask, infos)
        return observations, infos

    def step(self, actions: Any) -> Any:
        """Move the wanted flows by actions, shape (num_envs, 1), and step the environments.

        The result is what `step` of the wrapped vector environment returns.
        """
        moves = many_actions(actions, self.num_envs, self._ended)
        actuator = self._actuator
        flows = self._flows + actuator.move * moves.clip(-1.0, 1.0)
        flows = flows.clip(actuator.u_min, actuator.u_max)
        absolute_actions = actuator.action(flows).astype(np.float32)[:, np.newaxis]
        returned = self.env.step(absolute_actions)
        _, _, terminations, truncations, infos = returned
        self._flows = flows
        ended = terminations | truncations
        begins = ended if self._mode is AutoresetMode.SAME_STEP else self._ended.copy()
        if begins.any():
            self._begin_episodes(begins, infos)
        if self._mode is AutoresetMode.NEXT_STEP:
            self._ended = ended
        return returned

    def _begin_episodes(self, begins: NDArray[np.bool_], infos: dict[str, Any]) -> None:
        """Set wanted flows to 0, and take the drawn limits and dead zones from infos.

        `begins` says of which plants an episode begins, shape (num_envs,). `infos` are the
        infos at k = 0 of these plants.
        """
        for name in {*NUMBERS} & {*infos}:
            self._numbers[name][begins] = infos[name][begins]
        self._actuator = Actuator(self._numbers, *self.increments)
        self._flows[begins] = 0.0
        self._ended = self._ended & ~begins
