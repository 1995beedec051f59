"""Step the plant and its actuator: arithmetic on state, input and parameters, nothing else.

There are two implementations, side by side: `Plant` in plain floats, fastest for one plant, and
`PlantBatch` in arrays. Both do the same operations in the same order and agree bit for bit.
"""

from collections import deque
from itertools import accumulate, pairwise
from operator import mul
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mptc_gym.parameters import PLANT_NUMBERS, Parameters, PlantNumbers, slowest_pole

Values = NDArray[np.float64]  # one per plant, shape (n,)
DRIFT_INTERVAL: Final = 10  # samples between changes of drifting dynamics


def action_from_command(command: Any, u_min: Any, u_max: Any) -> Any:
    """Scale a command (t/h) to a normalised action in float64: -1 at `u_min`, 1 at `u_max`."""
    return 2.0 * (command - u_min) / (u_max - u_min) - 1.0


def least_effective(dead_zone: Any, u_min: Any, u_max: Any, rounding: float = 2.0**-50) -> Any:
    """Return the smallest magnitude of a command that passes the dead zone, t/h.

    A command on the edge of the dead zone passes. Scaled to an action and back, it may shrink
    by a few roundings, each of at most 2^-53 of the rounded number; it must still pass.
    """
    return dead_zone - rounding * (u_max - u_min + abs(u_max) + abs(u_min))


def float32_action(command: Any, u_min: Any, u_max: Any, dead_zone: Any) -> NDArray[np.float32]:
    """Scale commands (t/h) to the float32 actions that an agent passes to the environment.

    Rounding to float32 can move a command from the edge of the dead zone into it: float32(0.7)
    stands for 6.99999988 t/h. Such an action is moved outwards by the float32 spacing near 1.
    """
    command, half_range = np.asarray(command, float), (u_max - u_min) / 2.0
    action = np.asarray(action_from_command(command, u_min, u_max)).astype(np.float32)
    rounded = (action.astype(float) + 1.0) * half_range + u_min  # as the plant does
    swallowed = (np.abs(command) >= dead_zone) & ~(np.abs(rounded) >= dead_zone)
    step = np.spacing(np.maximum(np.abs(action), np.float32(1.0)))
    return np.where(swallowed, action + np.copysign(step, command).astype(np.float32), action)


class Dynamics:
    """A and B of (28) as functions of the steady-state gain and the dominant time constant.

    The environment's docstring says how. The time constant 1 / (1 - p) is the area above the
    step response of 1 / (1 - p z^-1), scaled to end at 1. As A(1) = (1 - p) Q(1) is divided by
    t, too, B is multiplied by g / t for g times the steady-state gain B(1) / A(1).
    """

    def __init__(self, parameters: Parameters) -> None:
        self._samples = parameters.drift_samples
        self._alpha = tuple(-coefficient for coefficient in parameters.a[1:])
        self._sum = sum(parameters.a)
        self._quotient: tuple[float, ...] | None = None
        if parameters.changes_time_constant:
            pole = slowest_pole(parameters.a).real  # as Parameters has checked
            self._rate = 1.0 - pole
            terms = accumulate(parameters.a[:-1], lambda before, here: here + pole * before)
            self._quotient = (*terms, 0.0)  # Q, by Horner's scheme

    def share(self, age: Any) -> Any:
        """Return the completed share of the drifts at k = `age`, from 0 to 1."""
        share = age / self._samples
        return share * (share < 1.0) + (share >= 1.0)  # at most 1, for arrays of any library

    def factors(self, numbers: PlantNumbers[Any], age: Any) -> tuple[Any, Any]:
        """Return g and t at k = `age`: floats, or arrays or tensors for many plants."""
        share = self.share(age)
        gain, time_constant = numbers.gain_factor, numbers.time_constant_factor
        return (
            gain + gain * (numbers.gain_drift - 1.0) * share,
            time_constant + time_constant * (numbers.time_constant_drift - 1.0) * share,
        )

    def coefficients(self, gain: Any, time_constant: Any) -> tuple[list[Any], Any, Any]:
        """Return the coefficients of (28) for g and t.

        These are the negated coefficients of A from z^-1 on, the factor of B, and A(1).
        """
        alpha: list[Any] = list(self._alpha)
        if self._quotient is not None:
            pole = 1.0 - self._rate / time_constant
            alpha = [pole * before - here for before, here in pairwise(self._quotient)]
        return alpha, gain / time_constant, self._sum / time_constant


class Plant:
    """Command scaling, actuator (29) and middle-point temperature (28), initially at rest.

    As printed, (29) compares the magnitude of u with U_min in one of its cases. The intended
    meaning is: a command inside the dead zone has no effect, and any other, also one on its
    edge, is limited to [U_min, U_max].

    `factors` are gain and time constant, as multiples of those of A and B.
    """

    def __init__(self, parameters: Parameters, numbers: PlantNumbers[float]) -> None:
        u_min, u_max = numbers.u_min, numbers.u_max
        edge = least_effective(numbers.dead_zone, u_min, u_max)
        self._actuator = edge, u_min, u_max, (u_max - u_min) / 2.0
        self._numbers = numbers
        self._drifts = parameters.drifts
        self._age = 0
        self._dynamics = Dynamics(parameters)
        self._update_dynamics()
        # Each coefficient is paired with its index in its history. Both histories have the
        # newest sample first: y(k), y(k-1), ... and u_a(k), u_a(k-1), ...
        delay = int(numbers.delay)
        self._beta = tuple(enumerate(parameters.b, start=delay))
        self._outputs = deque([0.0] * len(self._alpha), len(self._alpha))
        self._inputs = deque([0.0] * (delay + len(self._beta)), delay + len(self._beta))

    def step(self, action: float, noise: float, load: float) -> tuple[float, float, float]:
        """Move from sample k to k+1, given a(k), n(k+1) and the load w(k+1).

        Returns u(k) and u_a(k), t/h, and y(k+1), degC.
        """
        if self._drifts:
            self._age += 1
            if self._age % DRIFT_INTERVAL == 0:
                self._update_dynamics()
        edge, u_min, u_max, half_range = self._actuator
        # Section 4, last formula, for actions from -1 to 1 in place of outputs from 0 to 1.
        command = u_min + (action + 1.0) * half_range
        applied = command  # (29) from here on
        if -edge < command < edge:
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
        if load:
            noise += self._load_gain * load
        output = noise + self._scale * response
        for lag, alpha in self._alpha:
            output += alpha * outputs[lag]  # A of (28)
        outputs.appendleft(output)
        return command, applied, output

    def _update_dynamics(self) -> None:
        """Update the dynamics to the plant's age."""
        gain, time_constant = map(float, self._dynamics.factors(self._numbers, self._age))
        alpha, self._scale, self._load_gain = self._dynamics.coefficients(gain, time_constant)
        self._alpha = tuple(enumerate(alpha))
        self.factors = gain, time_constant


class PlantBatch:
    """Many plants side by side: `Plant` in arrays.

    `factors` are those of `Plant`, of shape (n,) if they drift or are drawn, otherwise ().
    """

    def __init__(self, parameters: Parameters, num_envs: int) -> None:
        # In array arithmetic, an array of one number is faster than a number. In comparisons,
        # an array of full length is faster still.
        self._num_envs, self._drawn = num_envs, parameters.ranges
        shapes = {name: num_envs if name in self._drawn else () for name in PLANT_NUMBERS}
        self._numbers: PlantNumbers[Values] = PlantNumbers(
            **{n: np.full(s, parameters.range_of(n)[0], float) for n, s in shapes.items()}
        )
        self._update_actuator()

        self._dynamics = Dynamics(parameters)
        self._drifts = parameters.drifts
        self._changes_dynamics = parameters.changes_dynamics
        self._clock = self._next_update = 0
        self._starts = np.zeros(num_envs if self._drifts else (), np.int64)
        self._update_dynamics()
        order = len(self._alpha)
        self._outputs = deque(np.zeros((order, num_envs)), maxlen=order)

        # Because of the delay, the response to the inputs of d + 1 samples can be computed at
        # once, where d is the shortest delay that can be drawn. Inputs lie in a window of these
        # rows, oldest first; before those of the d + 1 samples come the older ones that B and
        # plants with a longer delay also need.
        shortest, self._longest = map(int, parameters.range_of("delay"))
        self._samples = shortest + 1
        self._beta = tuple(parameters.b)
        self._own_delays = self._longest > shortest
        self._older = len(self._beta) - 1 + self._longest - shortest
        # If plants have their own delays, the window moves with the samples, and the older rows
        # are copied back only when it reaches the end of the rows.
        spare = max(self._older, self._samples) if self._own_delays else 0
        self._inputs = np.zeros((self._older + self._samples + spare, num_envs))
        self._first_row = 0  # of the window
        rows = len(self._beta) - 1 + self._samples  # of inputs, at each plant's delay
        self._taken = np.zeros((rows, num_envs) if self._own_delays else 0, np.intp)
        self._delayed = np.zeros(self._taken.shape)
        self._response = np.zeros((self._samples, num_envs))
        self._place = self._samples - 1  # of the next input among the d + 1

    def reset(self, which: NDArray[np.intp], numbers: PlantNumbers[Values]) -> None:
        """Bring some plants to rest, with new numbers: one per plant if drawn."""
        self._inputs[:, which] = 0.0
        self._response[:, which] = 0.0
        for outputs in self._outputs:
            outputs[which] = 0.0
        for name, values in numbers.chosen(self._drawn).items():
            getattr(self._numbers, name)[which] = values
        if self._drawn:
            self._update_actuator()
        if self._own_delays:
            first = self._longest - numbers.delay.astype(np.intp)
            rows = np.arange(len(self._taken))[:, np.newaxis] + first
            self._taken[:, which] = rows * self._num_envs + which
        if self._drifts:
            self._starts[which] = self._clock
        if self._drawn or self._drifts:
            self._update_dynamics()

    def step(
        self, action: Values, noise: Values, load: Values | None = None
    ) -> tuple[Values, Values, Values]:
        """Move all plants from sample k to k+1, like `Plant.step`, in arrays of shape (n,).

        The plants keep the output, so it must not be modified.
        """
        if self._drifts:
            self._clock += 1
            if self._clock >= self._next_update:
                self._update_dynamics()
        zero, one, half_range, offset, edge, u_min, u_max = self._actuator
        command = action + one
        command *= half_range
        command += offset
        applied = np.minimum(command, u_max)  # (29) from here on
        np.maximum(applied, u_min, out=applied)
        # A product is faster than a mask, whose branches are unpredictable. It can give -0,
        # which adding 0 turns into 0.
        applied *= np.abs(command) >= edge
        applied += zero
        place = self._place
        self._inputs[self._first_row + self._older + place] = applied
        place += 1
        if place == self._samples:
            self._respond()
            place = 0
        self._place = place
        response = self._response[place]
        if self._changes_dynamics:
            response = self._scale * response
        if load is not None:
            noise = noise + self._load_gain * load
        output: Values = noise + response
        for term in map(mul, self._alpha, self._outputs):  # A of (28)
            output += term
        self._outputs.appendleft(output)
        return command, applied, output

    def _respond(self) -> None:
        """Compute the response to the inputs of d + 1 samples."""
        first, older, samples = self._first_row, self._older, self._samples
        inputs = self._inputs[first : first + older + samples]
        if self._own_delays:
            inputs = inputs.take(self._taken, out=self._delayed, mode="clip")
        self._response[:] = 0.0
        for lag, beta in enumerate(self._beta):  # B of (28)
            newest = len(self._beta) - 1 - lag
            self._response += beta * inputs[newest : newest + samples]
        first += samples
        if first + older + samples > len(self._inputs):
            self._inputs[:older] = self._inputs[first : first + older]
            first = 0
        self._first_row = first

    def _update_actuator(self) -> None:
        """Update what the scaling of commands and (29) take from the plant numbers."""
        u_min, u_max = self._numbers.u_min, self._numbers.u_max
        edge = least_effective(self._numbers.dead_zone, u_min, u_max)
        numbers = map(np.array, (0.0, 1.0, (u_max - u_min) / 2.0, u_min, edge))
        limits = (np.full(self._num_envs, limit) for limit in (u_min, u_max))
        self._actuator = *numbers, *limits

    def _update_dynamics(self) -> None:
        """Update the dynamics to the plants' ages."""
        ages = self._clock - self._starts
        slow = ages // DRIFT_INTERVAL * DRIFT_INTERVAL
        self.factors = self._dynamics.factors(self._numbers, slow)
        alpha, self._scale, self._load_gain = self._dynamics.coefficients(*self.factors)
        self._alpha = tuple(map(np.asarray, alpha))
        self._next_update = self._clock + int((slow + DRIFT_INTERVAL - ages).min())
