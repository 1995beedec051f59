"""The plant and its actuator: arithmetic on state, input and parameters, nothing else."""

from __future__ import annotations

from collections import deque

from mptc_gym.parameters import Parameters


def action_from_command(command: float, u_min: float, u_max: float) -> float:
    """Scale a command (t/h) to a normalised action: -1 at `u_min`, 1 at `u_max`."""
    return 2.0 * (command - u_min) / (u_max - u_min) - 1.0


class Plant:
    """Command scaling, actuator (29) and middle-point temperature (28), at rest until moved.

    The scaling is the last formula of Section 4, for actions from -1 to 1 in place of network
    outputs from 0 to 1. As printed, (29) compares the magnitude of u with U_min in one of its
    cases. Meant is: no effect inside the dead zone, otherwise the command limited to
    [U_min, U_max]. A command on the edge of the dead zone passes.

    Parameters
    ----------
    parameters
        Uses `a`, `b`, `delay`, `dead_zone`, `u_min` and `u_max`.
    """

    def __init__(self, parameters: Parameters) -> None:
        self._limits = parameters.dead_zone, parameters.u_min, parameters.u_max
        # Each coefficient with its place in the history it is for, and both histories with the
        # newest sample first: y(k), y(k-1), ... and u_a(k), u_a(k-1), ...
        self._alpha = tuple(enumerate(-coefficient for coefficient in parameters.a[1:]))
        self._beta = tuple(enumerate(parameters.b, start=parameters.delay))
        self._outputs = _at_rest(len(self._alpha))
        self._inputs = _at_rest(parameters.delay + len(self._beta))

    def step(self, action: float, noise: float) -> tuple[float, float, float]:
        """Move from sample k to k+1.

        Parameters
        ----------
        action
            a(k), normalised: -1 at U_min and 1 at U_max. An action beyond is a command beyond.
        noise
            n(k+1), degC.

        Returns
        -------
        command
            u(k), t/h.
        applied
            u_a(k), t/h.
        output
            y(k+1), degC.
        """
        dead_zone, u_min, u_max = self._limits
        command = u_min + (action + 1.0) / 2.0 * (u_max - u_min)
        applied = command  # (29) from here on
        if -dead_zone < command < dead_zone:
            applied = 0.0
        elif command < u_min:
            applied = u_min
        elif command > u_max:
            applied = u_max
        inputs, outputs = self._inputs, self._outputs
        inputs.appendleft(applied)
        output = noise  # (28) from here on
        for lag, alpha in self._alpha:
            output += alpha * outputs[lag]
        for lag, beta in self._beta:
            output += beta * inputs[lag]
        outputs.appendleft(output)
        return command, applied, output


def _at_rest(samples: int) -> deque[float]:
    return deque([0.0] * samples, maxlen=samples)
