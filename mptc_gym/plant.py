"""The plant and its actuator: arithmetic on state, input and parameters, nothing else.

It stands here twice, side by side: `Plant` in plain floats, which are fastest for one plant,
and `Plants` in arrays. Both do the same operations in the same order, and agree to the bit.
"""

from __future__ import annotations

from collections import deque
from operator import mul

import numpy as np
from numpy.typing import NDArray

from mptc_gym.parameters import Parameters

Values = NDArray[np.float64]  # one a plant, shape (n,)


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
        u_min, u_max = parameters.u_min, parameters.u_max
        self._actuator = parameters.dead_zone, u_min, u_max, (u_max - u_min) / 2.0
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
        dead_zone, u_min, u_max, half_range = self._actuator
        command = u_min + (action + 1.0) * half_range  # Section 4, last formula
        applied = command  # (29) from here on
        if -dead_zone < command < dead_zone:
            applied = 0.0
        elif command < u_min:
            applied = u_min
        elif command > u_max:
            applied = u_max
        inputs, outputs = self._inputs, self._outputs
        inputs.appendleft(applied)
        response = 0.0  # to the input: B of (28)
        for lag, beta in self._beta:
            response += beta * inputs[lag]
        output = noise + response
        for lag, alpha in self._alpha:
            output += alpha * outputs[lag]  # A of (28)
        outputs.appendleft(output)
        return command, applied, output


class Plants:
    """Many plants side by side, with the same parameters: `Plant` in arrays.

    Parameters
    ----------
    parameters
        Uses `a`, `b`, `delay`, `dead_zone`, `u_min` and `u_max`.
    num_envs
        n, number of plants.
    """

    def __init__(self, parameters: Parameters, num_envs: int) -> None:
        # An array of one number costs less in arithmetic than a number does. Where arrays are
        # compared, full ones cost less still.
        u_min, u_max = parameters.u_min, parameters.u_max
        numbers = 0.0, 1.0, (u_max - u_min) / 2.0, u_min, parameters.dead_zone
        limits = np.full(num_envs, u_min), np.full(num_envs, u_max)
        self._actuator = (*map(np.array, numbers), *limits)
        self._alpha = tuple(np.array(-coefficient) for coefficient in parameters.a[1:])
        self._beta = tuple(parameters.b)
        self._outputs = deque(np.zeros((len(self._alpha), num_envs)), maxlen=len(self._alpha))
        # Because of the delay d, the response to the inputs of d + 1 samples can be worked out
        # at once. Inputs lie here with the oldest first; before those of the d + 1 samples come
        # the older ones that B also needs.
        self._older = len(self._beta) - 1
        self._samples = parameters.delay + 1
        self._inputs = np.zeros((self._older + self._samples, num_envs))
        self._response = np.zeros((self._samples, num_envs))
        self._place = self._samples - 1  # of the next input among the d + 1

    def rest(self, which: NDArray[np.intp]) -> None:
        """Bring some of the plants to rest, given by their indices."""
        self._inputs[:, which] = 0.0
        self._response[:, which] = 0.0
        for outputs in self._outputs:
            outputs[which] = 0.0

    def step(self, action: Values, noise: Values) -> tuple[Values, Values, Values]:
        """Move all plants from sample k to k+1.

        Parameters
        ----------
        action
            a(k), shape (n,).
        noise
            n(k+1), degC, shape (n,).

        Returns
        -------
        command, applied, output
            u(k) and u_a(k), t/h, and y(k+1), degC; each of shape (n,). The last is kept here
            and must not be changed.
        """
        zero, one, half_range, offset, dead_zone, u_min, u_max = self._actuator
        command = action + one
        command *= half_range
        command += offset
        applied = np.minimum(command, u_max)  # (29) from here on
        np.maximum(applied, u_min, out=applied)
        # A product, as processors are slow at masks, whose bits they cannot foresee. It turns
        # some numbers into -0, which + 0 turns into 0.
        applied *= np.abs(command) >= dead_zone
        applied += zero
        place = self._place
        self._inputs[self._older + place] = applied
        place += 1
        if place == self._samples:
            self._respond()
            place = 0
        self._place = place
        output: Values = noise + self._response[place]
        for term in map(mul, self._alpha, self._outputs):  # A of (28)
            output += term
        self._outputs.appendleft(output)
        return command, applied, output

    def _respond(self) -> None:
        """Work out the response to the inputs of d + 1 samples."""
        inputs, older, samples = self._inputs, self._older, self._samples
        self._response[:] = 0.0
        for lag, beta in enumerate(self._beta):  # B of (28)
            self._response += beta * inputs[older - lag : older - lag + samples]
        inputs[:older] = inputs[samples:].copy()


def _at_rest(samples: int) -> deque[float]:
    return deque([0.0] * samples, maxlen=samples)
