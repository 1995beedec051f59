"""Model the actuator (29), and choose commands that it passes."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def applied_flow(command: Any, dead_zone: Any, u_min: Any, u_max: Any) -> Array:
    """Return the flow u_a that the actuator applies for a command, (29), all in t/h.

    A command inside the dead zone has no effect, and any other is limited. Arguments broadcast.
    """
    return np.where(np.abs(command) < dead_zone, 0.0, np.clip(command, u_min, u_max))


def float32_action(command: Any, u_min: Any, u_max: Any, dead_zone: Any) -> NDArray[np.float32]:
    """Scale commands (t/h) to normalised float32 actions: -1 at `u_min` and 1 at `u_max`.

    Rounding can move a command from the edge of the dead zone to its inside, where it has no
    effect. Such an action is moved outwards by one float. Arguments broadcast.
    """
    action = np.asarray(2.0 * (command - u_min) / (u_max - u_min) - 1.0, dtype=np.float32)
    if np.ndim(dead_zone) or dead_zone > 0.0:
        arrives = u_min + (action.astype(np.float64) + 1.0) * (u_max - u_min) / 2.0
        lost = (np.abs(command) >= dead_zone) & (np.abs(arrives) < dead_zone)
        if lost.any():
            # The plant adds 1, which rounds away steps finer than the float spacing at 1.
            step = np.spacing(np.maximum(np.abs(action), np.float32(1)))
            action = np.where(lost, action + np.copysign(step, command), action)
            action = action.astype(np.float32)
    return action


def avoid_dead_zone(command: Any, edge: Any, xp: Any = np) -> Any:
    """Move commands closer to 0 than `edge` to this edge or to 0, whichever is nearer.

    `xp` is the array module, NumPy or PyTorch.
    """
    size = abs(command)
    return xp.where(size < edge, edge * xp.sign(command) * (size >= edge / 2.0), command)
