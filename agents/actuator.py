"""Model the actuator, equation (29) of the paper, and choose commands that have an effect."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def applied_flow(command: Any, dead_zone: Any, u_min: Any, u_max: Any) -> Array:
    """Return the flow u_a that the actuator applies, t/h: equation (29) of the paper.

    A command inside the dead zone gives a flow of 0, and other commands are clipped to the flow
    limits. All arguments broadcast as in NumPy.

    Parameters
    ----------
    command
        The command u, t/h.
    dead_zone
        Half width of the dead zone, t/h. A command on the edge of the dead zone gives a flow.
    u_min, u_max
        Lower and upper limit of the flow, t/h.
    """
    return np.where(np.abs(command) < dead_zone, 0.0, np.clip(command, u_min, u_max))


def float32_action(command: Any, u_min: Any, u_max: Any, dead_zone: Any) -> NDArray[np.float32]:
    """Return the float32 actions for commands: -1 for the command `u_min`, and 1 for `u_max`.

    Rounding to float32 can move a command on the edge of the dead zone into the dead zone,
    where the command has no effect. An action that rounding moved into the dead zone is moved
    out again by the spacing of float32 numbers near 1, or near the action if its size is above
    1. All arguments broadcast as in NumPy.

    Parameters
    ----------
    command
        The command u, t/h.
    u_min, u_max
        Lower and upper limit of the flow, t/h.
    dead_zone
        Half width of the dead zone, t/h; 0 to accept any rounding of the actions.
    """
    action = np.asarray(2.0 * (command - u_min) / (u_max - u_min) - 1.0, dtype=np.float32)
    if np.ndim(dead_zone) == 0 and dead_zone <= 0.0:  # a shortcut, as there is no dead zone
        return action
    # The command that the plant computes from the action.
    rounded = u_min + (action.astype(np.float64) + 1.0) * (u_max - u_min) / 2.0
    lost_its_effect = (np.abs(command) >= dead_zone) & (np.abs(rounded) < dead_zone)
    # The plant adds 1 to the action, so the rounding of the sum can remove a step that is much
    # smaller than the float32 spacing near 1.
    spacing = np.spacing(np.maximum(np.abs(action), np.float32(1)))
    outwards = action + np.copysign(spacing, command)
    return np.where(lost_its_effect, outwards, action).astype(np.float32)


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
