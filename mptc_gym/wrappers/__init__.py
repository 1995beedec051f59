"""Wrap one environment: the action of `IncrementalAction` changes the flow.

`mptc_gym.wrappers.vector` has the same for vector environments.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from mptc_gym.checks import is_number, one_action, reject, reject_action
from mptc_gym.parameters import Parameters
from mptc_gym.plant import action_from_command, float32_action

__all__ = ["IncrementalAction"]

NUMBERS = "dead_zone", "u_min", "u_max"  # that describe an actuator


class IncrementalAction(gymnasium.ActionWrapper[Any, Any, Any], RecordConstructorArgs):
    """The action changes the flow, instead of setting it: the velocity form of process control.

    The wrapper holds a wanted flow v, in t/h, which is 0 after `reset`. An action w moves it::

        v(k) = v(k-1) + w(k) max_move (u_max - u_min) / 2,   limited to [u_min, u_max]

    and the command is u(k) = v(k). That is kind to the valve, and it lets a policy explore, as
    what it changes lasts.

    With `undo_dead_zone`, the command leaves out the dead zone, of half width z::

        v > 0:   u =  z + (u_max - z) v / u_max
        v = 0:   u =  0
        v < 0:   u = -z + (u_min + z) v / u_min

    Then every change of v has an effect, and all flows that the actuator can apply are still
    there. Above and below 0 the flow moves 1 - z / u_max and 1 + z / u_min times as much as v,
    and where v changes its sign it jumps from -z to z or back. No flow at all is commanded
    from `reset` until the first action that is not 0.

    The action space is `Box(-1, 1, (1,), float32)`; an action beyond it counts as one on its
    edge. Observation, reward (`move_weight`, too) and info are those of the environment, which
    gets absolute actions. A policy has to know v, which the newest action of `action_window`
    tells: with the nominal delay, `action_window=20` makes the noise-free problem Markov while
    the set point holds.

    Parameters
    ----------
    env
        A `MiddlePointEnv`, in other wrappers or not.
    max_move
        How far an action of 1 moves the wanted flow, as a share of half the range: above 0, up
        to 2.
    undo_dead_zone
        False leaves the dead zone as it is. True undoes the plant's own; if that is a range,
        the one of the episode, which the info of `reset` tells. A number undoes as many t/h,
        whatever the plant's are. Limits that are ranges are those of the episode, too.

    Raises
    ------
    ValueError
        From the constructor, if an argument is out of range. From `step`, if the action is not
        one finite number; nothing has changed then.
    ResetNeeded
        From `step`, if the environment has never been reset.

    Examples
    --------
    >>> import gymnasium, mptc_gym
    >>> from mptc_gym.wrappers import IncrementalAction
    >>> env = gymnasium.make("MiddlePoint-v0", action_window=20)
    >>> env = IncrementalAction(env, max_move=0.4, undo_dead_zone=True)
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        *,
        max_move: float = 0.4,
        undo_dead_zone: bool | float = False,
    ) -> None:
        if isinstance(env, VectorEnv):
            allowed = "one environment; mptc_gym.wrappers.vector.IncrementalAction takes many"
            reject("env", env, allowed)
        RecordConstructorArgs.__init__(self, max_move=max_move, undo_dead_zone=undo_dead_zone)
        gymnasium.ActionWrapper.__init__(self, env)
        parameters = getattr(env.unwrapped, "parameters", None)
        if not isinstance(parameters, Parameters):
            reject("env", env, "a MiddlePointEnv, in wrappers or not")
        self.action_space = Box(-1.0, 1.0, (1,), np.float32)
        self._arguments = max_move, undo_dead_zone
        self._numbers = {name: parameters.range_of(name)[0] for name in NUMBERS}
        self._actuator = Actuator(self._numbers, *self._arguments)
        self._flow: float | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Reset the environment, and the wanted flow to 0."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._numbers |= {name: info[name] for name in NUMBERS if name in info}
        self._actuator = Actuator(self._numbers, *self._arguments)
        self._flow = 0.0
        return observation, info

    def action(self, action: Any) -> NDArray[np.float32]:
        """Move the wanted flow by an action, shape (1,), and return the absolute action."""
        if self._flow is None:
            raise ResetNeeded("call reset before step")
        move = one_action(action)
        if not math.isfinite(move):
            reject_action(action)
        actuator = self._actuator
        flow = self._flow + actuator.move * max(-1.0, min(1.0, move))
        self._flow = max(actuator.u_min, min(actuator.u_max, flow))
        return np.array([actuator.action(self._flow)], np.float32)


class Actuator:
    """What the wrappers know of an actuator, and how they make it apply a flow.

    `numbers` are its `dead_zone`, `u_min` and `u_max`, t/h: floats, or arrays for many plants.
    The other arguments are those of the wrappers; ValueError if one is out of range.
    """

    def __init__(
        self, numbers: Mapping[str, Any], max_move: float, undo_dead_zone: bool | float
    ) -> None:
        if not is_number(max_move) or not 0.0 < max_move <= 2.0:
            reject("max_move", max_move, "a number above 0, up to 2")
        if not isinstance(undo_dead_zone, bool) and not (
            is_number(undo_dead_zone) and undo_dead_zone >= 0.0
        ):
            reject("undo_dead_zone", undo_dead_zone, "True, False or a number from 0 to 1e9")
        own, self.u_min, self.u_max = (numbers[name] for name in NUMBERS)
        half_range = (self.u_max - self.u_min) / 2.0
        self.move = max_move * half_range  # of the wanted flow by an action of 1, t/h
        self._undoes = undo_dead_zone is not False
        self._zone = z = own if undo_dead_zone is True else undo_dead_zone
        # A limit within the dead zone is reached by a command on its edge, which (29) limits.
        self._above, self._below = (
            np.maximum(limit - z, 0.0) / np.where(limit > 0.0, limit, 1.0)
            for limit in (self.u_max, -self.u_min)
        )

    def moved(self, flows: NDArray[np.float64], moves: NDArray[Any]) -> NDArray[np.float64]:
        """Return the wanted flows of many plants, t/h, after actions of the wrapper."""
        moved: NDArray[np.float64] = flows + self.move * np.clip(moves, -1.0, 1.0)
        return moved.clip(self.u_min, self.u_max)

    def action(self, flow: Any) -> Any:
        """Return the environment's action for a wanted flow in t/h, a float or an array."""
        if not self._undoes:
            return action_from_command(flow, self.u_min, self.u_max)
        above, below = flow > 0.0, flow < 0.0
        flow = above * (self._zone + self._above * flow) - below * (
            self._zone - self._below * flow
        )
        return float32_action(flow, self.u_min, self.u_max, self._zone)
