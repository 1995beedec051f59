"""Wrap many environments at once so that actions change the flow instead of setting it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorActionWrapper, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from mptc_gym.checks import many_actions, reject
from mptc_gym.layers import plant_groups
from mptc_gym.wrappers import NUMBERS, Actuator


class IncrementalAction(VectorActionWrapper):
    """The action changes the flow: `mptc_gym.wrappers.IncrementalAction` for many plants.

    Every plant has its own wanted flow. Everything that `reset` and `step` return equals what
    the same number of single wrapped environments return.

    `env` is a `MiddlePointVectorEnv`, or another vector environment of `MiddlePointEnv` in
    NumPy, such as Gymnasium's `SyncVectorEnv`. All three autoreset modes and partial resets
    work. Arguments and errors are those of the wrapper of one environment; `step` also raises a
    ValueError if the shape of the actions is not (num_envs, 1).
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
        self._flows = np.zeros(self.num_envs)  # wanted, t/h
        self._ended = np.zeros(self.num_envs, np.bool_)  # to be reset by the next step

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> Any:
        """Reset all environments, or those of `reset_mask`, and their wanted flows to 0."""
        # Read first, as Gymnasium's own environments remove it from the options.
        mask = options.get("reset_mask") if isinstance(options, Mapping) else None
        observations, infos = self.env.reset(seed=seed, options=options)
        self._begin(np.ones(self.num_envs, np.bool_) if mask is None else mask, infos)
        return observations, infos

    def step(self, actions: Any) -> Any:
        """Move the wanted flows by actions, shape (num_envs, 1), and step the environments."""
        moves = many_actions(actions, self.num_envs, self._ended)
        actuator = self._actuator
        flows = self._flows + actuator.move * moves.clip(-1.0, 1.0)
        flows = flows.clip(actuator.u_min, actuator.u_max)
        returned = self.env.step(actuator.action(flows).astype(np.float32)[:, np.newaxis])
        _, _, terminations, truncations, infos = returned
        self._flows = flows
        ended = terminations | truncations
        begun = ended if self._mode is AutoresetMode.SAME_STEP else self._ended.copy()
        if begun.any():
            self._begin(begun, infos)
        if self._mode is AutoresetMode.NEXT_STEP:
            self._ended = ended
        return returned

    def _begin(self, begun: NDArray[np.bool_], infos: dict[str, Any]) -> None:
        """Set the wanted flow to 0 where an episode has begun, and store what was drawn."""
        for name in {*NUMBERS} & {*infos}:
            self._numbers[name][begun] = infos[name][begun]
        self._actuator = Actuator(self._numbers, *self.increments)
        self._flows[begun] = 0.0
        self._ended = self._ended & ~begun
