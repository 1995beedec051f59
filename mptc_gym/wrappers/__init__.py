"""Wrap an environment so that the action changes the feedwater flow instead of setting it.

`mptc_gym.wrappers.vector` has the same wrapper for vector environments.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from mptc_gym.plant.checks import is_number, one_action, reject
from mptc_gym.plant.dynamics import action_from_command, float32_action
from mptc_gym.plant.parameters import Parameters

# The arguments of the environment that describe the actuator, t/h.
ACTUATOR_NUMBERS = "dead_zone", "u_min", "u_max"


class IncrementalAction(gymnasium.ActionWrapper[Any, Any, Any], RecordConstructorArgs):
    """Wrapper whose action changes the feedwater flow instead of setting the flow.

    In process control, changing the flow at each step is called the velocity form. The wrapper
    stores a wanted flow v, t/h, which is the flow that the policy asks for, and 0 after
    `reset`. An action w, from -1 to 1, changes v::

        v(k) = v(k-1) + w(k) max_move (u_max - u_min) / 2,   limited to [u_min, u_max]

    The actuator's limits are u_min and u_max, t/h. Without compensation of the dead zone, the
    commanded flow is u(k) = v(k). Changing the flow, instead of setting the flow, wears the
    valve less and makes exploration effective, because every change of the flow lasts.

    With `compensate_dead_zone`, the commanded flow u skips the dead zone, whose half width is
    z, t/h::

        v > 0:   u =  z + (u_max - z) v / u_max
        v = 0:   u =  0
        v < 0:   u = -z + (u_min + z) v / u_min

    If z is the half width of the plant's own dead zone, u_min is below -z and u_max is above z,
    every change of the wanted flow v changes the applied flow, and each flow that the actuator
    can apply results from some v. If u_min is at most 0 and u_max at least 0, the wanted flow
    is 0 from `reset` until the first nonzero action.

    The action space is `Box(-1, 1, (1,), float32)`; actions beyond +-1 are clipped. The wrapped
    environment receives an action that sets the flow, and computes observation, reward (with
    `move_weight`) and info from that action. A policy must know the wanted flow v, which
    follows from the newest past action in the observation, so the environment needs an
    `action_window` of at least 1. With a constant set point and otherwise default arguments,
    such as a delay of 18 samples and no noise, `action_window=20` makes the control problem a
    Markov decision process.

    Parameters
    ----------
    env
        A `MiddlePointEnv`, wrapped or not.
    max_move
        Change of the wanted flow that an action of 1 causes, as a share of (u_max - u_min) / 2:
        a number above 0, up to 2.
    compensate_dead_zone
        Whether commands skip the dead zone. True compensates the dead zone of the plant, or of
        the present episode if `dead_zone` is a range. False compensates no dead zone. A number
        is the half width, t/h, of the dead zone to compensate.

    Attributes
    ----------
    increments : (float, bool or float)
        The arguments `max_move` and `compensate_dead_zone`.

    Raises
    ------
    ValueError
        If an argument is invalid. `step` raises a ValueError if the action is not one finite
        number, and leaves the wrapper and the environment unchanged.

    Examples
    --------
    >>> import gymnasium, mptc_gym
    >>> from mptc_gym.wrappers import IncrementalAction
    >>> env = gymnasium.make("MiddlePoint-v0", action_window=20)
    >>> env = IncrementalAction(env, max_move=0.4, compensate_dead_zone=True)
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        *,
        max_move: float = 0.4,
        compensate_dead_zone: bool | float = False,
    ) -> None:
        """Wrap one environment; the docstring of the class describes the arguments."""
        parameters = getattr(getattr(env, "unwrapped", None), "parameters", None)
        if isinstance(env, VectorEnv) or not isinstance(parameters, Parameters):
            allowed = "a MiddlePointEnv, wrapped or not; mptc_gym.wrappers.vector takes many"
            reject("env", env, allowed)
        RecordConstructorArgs.__init__(
            self, max_move=max_move, compensate_dead_zone=compensate_dead_zone
        )
        gymnasium.ActionWrapper.__init__(self, env)
        self.action_space = Box(-1.0, 1.0, (1,), np.float32)
        self.increments = max_move, compensate_dead_zone
        # Dead zone and limits, t/h; for a range, from which `reset` draws, the lowest value.
        self._numbers = {name: parameters.range_of(name)[0] for name in ACTUATOR_NUMBERS}
        self._actuator = Actuator(self._numbers, max_move, compensate_dead_zone)
        self._flow = 0.0  # wanted flow v, t/h

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Reset the environment, and set the wanted flow to 0 t/h.

        `seed` and `options` go to the wrapped environment, whose observation and info are
        returned.
        """
        observation, info = self.env.reset(seed=seed, options=options)
        drawn_numbers = {name: info[name] for name in ACTUATOR_NUMBERS if name in info}
        self._actuator = Actuator(self._numbers | drawn_numbers, *self.increments)
        self._flow = 0.0
        return observation, info

    def __str__(self) -> str:
        return f"<{type(self).__name__}{self.increments}{self.env}>"

    def action(self, action: Any) -> NDArray[np.float32]:
        """Change the wanted flow by an action, and return the action that sets the new flow.

        `action`, and the returned action of the wrapped environment, have the shape (1,). A
        ValueError is raised if `action` is not one finite number.
        """
        move = max(-1.0, min(1.0, one_action(action)))
        actuator = self._actuator
        flow = self._flow + actuator.flow_per_action * move
        self._flow = max(actuator.u_min, min(actuator.u_max, flow))
        return np.array([actuator.action(self._flow)], np.float32)


class Actuator:
    """Dead zone and limits of one or n actuators, to convert a wanted flow to an action.

    Parameters
    ----------
    numbers
        Values of `dead_zone`, `u_min` and `u_max`, t/h, by name: floats for one plant, or
        arrays of shape (n,) for n plants.
    max_move, compensate_dead_zone
        The arguments of `IncrementalAction`.

    Attributes
    ----------
    u_min, u_max : float or array
        The limits of the actuator, t/h.
    flow_per_action : float or array
        Change of the wanted flow that an action of 1 causes, t/h.

    Raises
    ------
    ValueError
        If `max_move` or `compensate_dead_zone` is out of range.
    """

    def __init__(
        self, numbers: Mapping[str, Any], max_move: float, compensate_dead_zone: bool | float
    ) -> None:
        if not is_number(max_move) or not 0.0 < max_move <= 2.0:
            reject("max_move", max_move, "a number above 0, up to 2")
        zone = compensate_dead_zone
        if not isinstance(zone, bool) and not (is_number(zone) and zone >= 0.0):
            reject("compensate_dead_zone", zone, "True, False or a number from 0 to 1e9")
        self.u_min = numbers["u_min"]
        self.u_max = numbers["u_max"]
        self.flow_per_action = max_move * ((self.u_max - self.u_min) / 2.0)
        self._compensates = zone is not False
        # Half width of the dead zone that the commands skip, t/h; unused without compensation.
        self._zone: Any = numbers["dead_zone"] if zone is True else zone
        # The slopes du/dv of the commanded flow u over the wanted flow v, for v > 0 and v < 0.
        self._slope_above = self._slope(self.u_max)
        self._slope_below = self._slope(-self.u_min)

    def _slope(self, limit: Any) -> Any:
        """Return du/dv, the slope of the commanded flow u over the wanted flow v.

        `limit` is the magnitude of the actuator's limit, t/h: u_max for flows above 0, and
        -u_min for flows below 0. For a limit inside the dead zone, the slope is 0: every
        command is at the edge of the dead zone, beyond the limit, and the actuator applies the
        limit itself.
        """
        return np.maximum(limit - self._zone, 0.0) / np.where(limit > 0.0, limit, 1.0)

    def action(self, flow: Any) -> Any:
        """Return the action of the wrapped environment that commands a wanted flow, t/h.

        `flow` and the returned action are floats, or arrays of shape (n,). With compensation of
        the dead zone, the action commands a flow outside the dead zone unless the wanted flow
        is 0.
        """
        if not self._compensates:
            return action_from_command(flow, self.u_min, self.u_max)
        above = (flow > 0.0) * (self._zone + self._slope_above * flow)
        below = (flow < 0.0) * (self._zone - self._slope_below * flow)
        return float32_action(above - below, self.u_min, self.u_max, self._zone)
