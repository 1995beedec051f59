"""Model the actuator: equation (29) of the paper, and the commands that actions give.

The docstring of `MiddlePointEnv` cites the paper. With the commanded flow u, the applied flow
u_a and the half width z of the dead zone, all in t/h, and with the normalised action a::

    (29)  u_a = 0 where |u| < z, otherwise u limited to [u_min, u_max]
          u = (a + 1) (u_max - u_min) / 2 + u_min

One case of equation (29), as printed in the paper, compares the magnitude of the command u with
the lower limit u_min. This project implements the intended meaning: a command inside the dead
zone has no effect, and a command on the edge of the dead zone or outside the dead zone is
limited.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mptc_gym.plant.parameters import Parameters

# Spacing of the float32 numbers from 1 to 2.
_FLOAT32_SPACING = 2.0**-23


def command_from_action(action: Any, u_min: Any, u_max: Any) -> Any:
    """Return the flow command of a normalised action: `u_min` for -1, and `u_max` for 1.

    The last formula of the paper's Section 4 scales the outputs of a neural network, from 0 to
    1, to flows. Here, the formula is rewritten for actions from -1 to 1. Flow command and
    limits are in t/h, as floats, arrays or tensors that can be broadcast.
    """
    return (action + 1.0) * ((u_max - u_min) / 2.0) + u_min


def action_from_command(command: Any, u_min: Any, u_max: Any) -> Any:
    """Return the normalised action for a flow command: -1 for `u_min`, and 1 for `u_max`.

    Flow command and limits are in t/h, as floats, arrays or tensors that can be broadcast. A
    command below `u_min` gives an action below -1, and a command above `u_max` an action above
    1.
    """
    return 2.0 * (command - u_min) / (u_max - u_min) - 1.0


def applied_flow(command: Any, dead_zone: Any, u_min: Any, u_max: Any) -> NDArray[np.float64]:
    """Return the flow u_a that the actuator applies, t/h: equation (29) of the paper.

    All arguments broadcast as in NumPy.

    Parameters
    ----------
    command
        The command u, t/h.
    dead_zone
        Half width of the dead zone, t/h. A command on the edge of the dead zone gives a flow.
        The plants use `least_effective_command` instead.
    u_min, u_max
        Lower and upper limit of the flow, t/h.
    """
    return np.where(np.abs(command) < dead_zone, 0.0, np.clip(command, u_min, u_max))


def least_effective_command(
    dead_zone: Any, u_min: Any, u_max: Any, rounding: float = 2.0**-50
) -> Any:
    """Return the smallest magnitude of a flow command, t/h, that the dead zone lets pass.

    The result is a few rounding errors smaller than `dead_zone`, so that a command on the edge
    of the dead zone still has an effect after scaling to an action and back.

    Parameters
    ----------
    dead_zone
        Half width of the dead zone, t/h: a float, an array or a tensor.
    u_min, u_max
        Limits of the actuator, t/h.
    rounding
        Upper bound of the accumulated rounding error, divided by u_max - u_min + |u_max| +
        |u_min|. The default bound, 2^-50, is enough for 8 float64 operations with a relative
        rounding error of 2^-53 each.
    """
    return dead_zone - rounding * (u_max - u_min + abs(u_max) + abs(u_min))


def avoid_dead_zone(command: Any, edge: Any) -> Any:
    """Return commands that are 0 or outside the dead zone of the actuator.

    A command inside the dead zone is moved to the edge of the dead zone or to 0, whichever is
    nearer. A command outside the dead zone is returned unchanged.

    Parameters
    ----------
    command
        Commands in any unit of flow, an array of any shape.
    edge
        Half width of the dead zone in the unit of `command`; a number, or an array that
        broadcasts against `command`.
    """
    magnitude = np.abs(command)
    edge_or_0 = edge * np.sign(command) * (magnitude >= edge / 2.0)
    return np.where(magnitude < edge, edge_or_0, command)


def float32_action(command: Any, u_min: Any, u_max: Any, dead_zone: Any) -> NDArray[np.float32]:
    """Return the float32 actions with which the environment commands given flows in t/h.

    All arguments broadcast as in NumPy. `rounded_action` describes how an action is kept out of
    the dead zone.

    Parameters
    ----------
    command
        Commanded flows, t/h, of any shape.
    u_min, u_max
        Limits of the actuator, t/h.
    dead_zone
        Half width of the dead zone, t/h; 0 to accept any rounding of the actions.

    Returns
    -------
    ndarray of float32
        Normalised actions, of the shape to which the four arguments broadcast.
    """
    commands = np.asarray(command, float)
    if np.ndim(dead_zone) == 0 and dead_zone <= 0.0:  # a shortcut, as there is no dead zone
        return np.asarray(action_from_command(commands, u_min, u_max)).astype(np.float32)
    actions = rounded_action(commands, u_min, u_max, dead_zone, _round_array)
    return np.asarray(actions, np.float32)


def rounded_action(
    command: Any, u_min: Any, u_max: Any, dead_zone: Any, to_float32: Any
) -> Any:
    """Return actions that float32 holds, in the type of the commands, t/h.

    Rounding to float32 can move a command from the edge of the dead zone into the dead zone:
    with the default limits, the action float32(0.7) commands 6.99999988 t/h, which is inside a
    dead zone of 7 t/h. If rounding moves a command into the dead zone, the action is moved out
    of the dead zone by the spacing of float32 numbers near 1, or near the action if its
    magnitude is above 1.

    All operators are those that arrays and tensors of any library share. `to_float32` is a
    function that rounds an array or a tensor to float32, and keeps its type.
    """
    action = to_float32(action_from_command(command, u_min, u_max))
    rounded_command = command_from_action(action, u_min, u_max)
    is_lost = (abs(command) >= dead_zone) & (abs(rounded_command) < dead_zone)
    direction = 2.0 * (command > 0.0) - 1.0
    # The plant adds 1 to the action, so the rounding of the sum could remove a smaller step
    # than the spacing near 1. Where the magnitude is above 4/3, the step is .75 to 1.5 times
    # the spacing near the action, and rounding makes it one spacing.
    step = _FLOAT32_SPACING * (0.75 * abs(action)).clip(1.0)
    return to_float32(action + is_lost * direction * step)


def _round_array(values: Any) -> Any:
    """Round a NumPy array of float64 to float32, and return it in float64."""
    return values.astype(np.float32).astype(np.float64)


class WantedFlows:
    """The wanted flows of n plants, which actions change: the action form "change".

    In process control, a change of the flow at each sample is called the velocity form. An
    action w(k) changes the wanted flow v, t/h, which is 0 before k = 0::

        v(k) = v(k-1) + w(k) max_move (u_max - u_min) / 2,   limited to [u_min, u_max]

    The commanded flow u skips the dead zone with the half width z = `compensated_dead_zone`::

        v > 0:   u =  z + (u_max - z) v / u_max
        v = 0:   u =  0
        v < 0:   u = -z + (u_min + z) v / u_min

    If a limit lies inside the dead zone, all commands towards this limit are on the edge of the
    dead zone, and the actuator applies the limit.

    Parameters
    ----------
    parameters
        Arguments of the environment.
    flows
        Wanted flows before k = 0: zeros, shape (n,), in an array or a tensor, and 0.0 for the
        subclass `WantedFlow`. All operators in `change` are those that arrays and tensors of
        any library share.
    """

    # Rounds an array to float32, and keeps its type.
    _to_float32 = staticmethod(_round_array)

    def __init__(self, parameters: Parameters, flows: Any) -> None:
        # The limits are never ranges, so `lowest` has the limits of every plant.
        self._u_min = parameters.lowest.u_min
        self._u_max = parameters.lowest.u_max
        self._flow_per_action = parameters.max_move * (self._u_max - self._u_min) / 2.0
        self._flows = flows  # v, t/h
        # An array for arrays of flows, as `change` multiplies masks by it: the product of a
        # mask and a float would have the default type of a library.
        self._dead_zone = flows + parameters.compensated_dead_zone
        self._slope_above = _slope(self._u_max, parameters.compensated_dead_zone)
        self._slope_below = _slope(-self._u_min, parameters.compensated_dead_zone)

    def reset(self, plants: Any) -> None:
        """Set the wanted flows of the plants with the indices `plants` to 0 t/h."""
        self._flows[plants] = 0.0

    def change(self, actions: Any) -> Any:
        """Change the wanted flows, and return the actions that set them, shape (n,).

        `actions` are finite and are clipped to +-1. The returned actions are rounded to
        float32, as the actions of a policy are.
        """
        flows = self._flows + self._flow_per_action * actions.clip(-1.0, 1.0)
        self._flows = flows.clip(self._u_min, self._u_max)
        # The formulas for v > 0 and v < 0 in the docstring of the class are added: masks make
        # the terms of the other direction 0.
        is_above = self._flows > 0.0
        is_below = self._flows < 0.0
        edges = is_above * self._dead_zone - is_below * self._dead_zone
        above = is_above * (self._slope_above * self._flows)
        # Not `is_below`, with which the gradient would be 0 where the flow is 0.
        below = ~is_above * (self._slope_below * self._flows)
        return rounded_action(
            edges + above + below, self._u_min, self._u_max, self._dead_zone, self._to_float32
        )


def _slope(limit: float, dead_zone: float) -> float:
    """Return du/dv of `WantedFlows` towards a limit whose magnitude is `limit`, t/h."""
    if limit <= 0.0:  # no wanted flow has this direction
        return 0.0
    return max(limit - dead_zone, 0.0) / limit


class WantedFlow(WantedFlows):
    """The wanted flow of one plant in Python floats, equal bit for bit to `WantedFlows`.

    Each episode has a new object, so `reset` is not used.

    Parameters
    ----------
    parameters
        Arguments of the environment.
    """

    def __init__(self, parameters: Parameters) -> None:
        super().__init__(parameters, 0.0)
        self._half_range = (self._u_max - self._u_min) / 2.0

    def change(self, actions: float) -> float:
        """Change the wanted flow by one finite action, and return the action that sets it."""
        flow = self._flows + self._flow_per_action * max(-1.0, min(1.0, actions))
        self._flows = flow = max(self._u_min, min(self._u_max, flow))
        command = 0.0
        if flow > 0.0:
            command = self._dead_zone + self._slope_above * flow
        elif flow < 0.0:
            command = -self._dead_zone + self._slope_below * flow
        rounded = float(np.float32(action_from_command(command, self._u_min, self._u_max)))
        # `command_from_action`, written out for speed.
        rounded_command = (rounded + 1.0) * self._half_range + self._u_min
        # Rarely, rounding moves a command from the edge of the dead zone into the dead zone,
        # from which `float32_action` moves it out again.
        if abs(command) >= self._dead_zone > abs(rounded_command):
            return float(float32_action(command, self._u_min, self._u_max, self._dead_zone))
        return rounded
