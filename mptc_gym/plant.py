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
    `rounding` bounds their sum, as a share of the largest numbers involved.
    """
    return dead_zone - rounding * (u_max - u_min + abs(u_max) + abs(u_min))


def float32_action(command: Any, u_min: Any, u_max: Any, dead_zone: Any) -> NDArray[np.float32]:
    """Scale commands (t/h) to the float32 actions that an agent passes to the environment.

    Rounding to float32 can move a command from the edge of the dead zone into it: float32(0.7)
    stands for 6.99999988 t/h. Such an action is moved outwards by the float32 spacing near 1.
    The arguments broadcast, and the actions have their shape.
    """
    commands = np.asarray(command, float)
    actions = np.asarray(action_from_command(commands, u_min, u_max)).astype(np.float32)
    half_range = (u_max - u_min) / 2.0
    rounded = (actions.astype(float) + 1.0) * half_range + u_min  # as the plant does
    lost_its_effect = (np.abs(commands) >= dead_zone) & ~(np.abs(rounded) >= dead_zone)
    spacing = np.spacing(np.maximum(np.abs(actions), np.float32(1.0)))
    outwards = actions + np.copysign(spacing, commands).astype(np.float32)
    return np.where(lost_its_effect, outwards, actions)


class Dynamics:
    """A and B of (28) as functions of the steady-state gain and the dominant time constant.

    Gain and time constant are given as factors: g times the gain B(1) / A(1) of the paper's
    coefficients, and t times their time constant 1 / (1 - p), where p is the slowest pole and
    A = (1 - p z^-1) Q. The time constant is the area above the step response of
    1 / (1 - p z^-1), scaled to end at 1. For t times as much, 1 - p is divided by t, and Q
    stays. As this divides A(1) = (1 - p) Q(1) by t, too, B is multiplied by g / t.
    """

    def __init__(self, parameters: Parameters) -> None:
        self._drift_samples = parameters.drift_samples
        self._alpha = tuple(-coefficient for coefficient in parameters.a[1:])
        self._sum_of_a = sum(parameters.a)  # A(1)
        self._quotient: tuple[float, ...] | None = None  # Q, if the time constant changes
        if parameters.changes_time_constant:
            pole = slowest_pole(parameters.a).real  # a real one, as Parameters has checked
            self._rate = 1.0 - pole
            # A / (1 - p z^-1) by Horner's scheme.
            quotient = accumulate(
                parameters.a[:-1], lambda previous, coefficient: coefficient + pole * previous
            )
            self._quotient = (*quotient, 0.0)

    def share(self, age: Any) -> Any:
        """Return the completed share of the drifts at k = `age`, from 0 to 1."""
        share = age / self._drift_samples
        return share * (share < 1.0) + (share >= 1.0)  # at most 1, for arrays of any library

    def factors(self, numbers: PlantNumbers[Any], age: Any) -> tuple[Any, Any]:
        """Return g and t at k = `age`: floats, or arrays or tensors for many plants."""
        share = self.share(age)
        gain = numbers.gain_factor
        time_constant = numbers.time_constant_factor
        return (
            gain + gain * (numbers.gain_drift - 1.0) * share,
            time_constant + time_constant * (numbers.time_constant_drift - 1.0) * share,
        )

    def coefficients(self, gain: Any, time_constant: Any) -> tuple[list[Any], Any, Any]:
        """Return the coefficients of (28) for g = `gain` and t = `time_constant`.

        Returns
        -------
        alpha : list
            Factors of y(k-1), y(k-2), ...: the coefficients of A from z^-1 on, negated.
        scale : float or array
            Factor g / t of B.
        load_gain : float or array
            Factor A(1) of the load w(k).
        """
        alpha: list[Any] = list(self._alpha)
        if self._quotient is not None:
            pole = 1.0 - self._rate / time_constant
            # -(1 - p z^-1) Q, from z^-1 on.
            alpha = [
                pole * previous - following for previous, following in pairwise(self._quotient)
            ]
        return alpha, gain / time_constant, self._sum_of_a / time_constant


class Plant:
    """Command scaling, actuator (29) and middle-point temperature (28), initially at rest.

    As printed, (29) compares the magnitude of u with U_min in one of its cases. The intended
    meaning is: a command inside the dead zone has no effect, and any other, also one on its
    edge, is limited to [U_min, U_max].

    Attributes
    ----------
    factors : tuple of float
        The present gain and time constant, as multiples of those of A and B.
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
        # (29)
        applied = command
        if -edge < command < edge:
            applied = 0.0
        elif command < u_min:
            applied = u_min
        elif command > u_max:
            applied = u_max
        # (28): the response to the inputs by B, the load, and the past outputs by A.
        inputs = self._inputs
        inputs.appendleft(applied)
        response = 0.0
        for lag, beta in self._beta:
            response += beta * inputs[lag]
        if load:
            noise += self._load_gain * load
        output = noise + self._scale * response
        outputs = self._outputs
        for lag, alpha in self._alpha:
            output += alpha * outputs[lag]
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

    Attributes
    ----------
    factors : tuple of ndarray of float64
        Those of `Plant`, of shape (n,) if they drift or are drawn, otherwise ().
    """

    def __init__(self, parameters: Parameters, num_envs: int) -> None:
        # In array arithmetic, an array of one number is faster than a number. In comparisons,
        # an array of full length is faster still.
        self._num_envs = num_envs
        self._drawn_names = parameters.ranges  # names of the plant numbers that are drawn
        numbers: dict[str, Values] = {}
        for name in PLANT_NUMBERS:
            lowest, _ = parameters.range_of(name)
            shape = (num_envs,) if name in self._drawn_names else ()
            numbers[name] = np.full(shape, lowest, float)
        self._numbers: PlantNumbers[Values] = PlantNumbers(**numbers)
        self._update_actuator()

        self._dynamics = Dynamics(parameters)
        self._drifts = parameters.drifts
        self._changes_dynamics = parameters.changes_dynamics
        # Samples since the plants were created, and at the start of each plant's episode.
        self._clock = 0
        self._starts = np.zeros(num_envs if self._drifts else (), np.int64)
        self._next_update = 0  # the clock when the dynamics change next
        self._update_dynamics()
        order = len(self._alpha)
        self._outputs = deque(np.zeros((order, num_envs)), maxlen=order)  # newest first
        self._input_response = _InputResponse(parameters, num_envs)

    def reset(self, which: NDArray[np.intp], numbers: PlantNumbers[Values]) -> None:
        """Bring some plants to rest.

        `which` are their indices. `numbers` are their new plant numbers: those that are drawn
        have the shape (len(which),), and the others the shape ().
        """
        for outputs in self._outputs:
            outputs[which] = 0.0
        self._input_response.reset(which, numbers.delay)
        for name, values in numbers.chosen(self._drawn_names).items():
            getattr(self._numbers, name)[which] = values
        if self._drawn_names:
            self._update_actuator()
        if self._drifts:
            self._starts[which] = self._clock
        if self._drawn_names or self._drifts:
            self._update_dynamics()

    def step(
        self, action: Values, noise: Values, load: Values | None = None
    ) -> tuple[Values, Values, Values]:
        """Move all plants from sample k to k+1, like `Plant.step`, in arrays of shape (n,).

        The plants keep the output, so the caller must not modify it.
        """
        if self._drifts:
            self._clock += 1
            if self._clock >= self._next_update:
                self._update_dynamics()
        zero, one, half_range, offset, edge, u_min, u_max = self._actuator
        command = action + one
        command *= half_range
        command += offset
        # (29)
        applied = np.minimum(command, u_max)
        np.maximum(applied, u_min, out=applied)
        # A product is faster than a mask, whose branches are unpredictable. It can give -0,
        # which adding 0 turns into 0.
        applied *= np.abs(command) >= edge
        applied += zero
        # (28): the response to the inputs by B, the load, and the past outputs by A.
        response = self._input_response.add(applied)
        if self._changes_dynamics:
            response = self._scale * response
        if load is not None:
            noise = noise + self._load_gain * load
        output: Values = noise + response
        for term in map(mul, self._alpha, self._outputs):
            output += term
        self._outputs.appendleft(output)
        return command, applied, output

    def _update_actuator(self) -> None:
        """Compute what a step needs of the actuator's numbers."""
        u_min = self._numbers.u_min
        u_max = self._numbers.u_max
        self._actuator = (
            np.array(0.0),
            np.array(1.0),
            np.array((u_max - u_min) / 2.0),
            np.array(u_min),
            np.array(least_effective(self._numbers.dead_zone, u_min, u_max)),
            np.full(self._num_envs, u_min),
            np.full(self._num_envs, u_max),
        )

    def _update_dynamics(self) -> None:
        """Update the dynamics to the ages of the plants, in steps of `DRIFT_INTERVAL`."""
        ages = self._clock - self._starts
        last_changes = ages // DRIFT_INTERVAL * DRIFT_INTERVAL
        self.factors = self._dynamics.factors(self._numbers, last_changes)
        alpha, self._scale, self._load_gain = self._dynamics.coefficients(*self.factors)
        self._alpha = tuple(map(np.asarray, alpha))
        samples_to_change = last_changes + DRIFT_INTERVAL - ages
        self._next_update = self._clock + int(samples_to_change.min())


class _InputResponse:
    """The response of many plants to their inputs: B of (28), for a block of samples at once.

    With d the shortest delay that can be drawn, the inputs of d + 1 samples affect no output
    before the last of them is known. So the response to such a block is computed when it is
    complete, and then read sample by sample.

    The inputs lie in rows, one per sample, the oldest first. A window of the rows holds the
    block and, before it, the older inputs that B and longer delays also need. After each block
    the window moves on by the length of a block. At the end of the rows it moves back to the
    first, and the older inputs are copied there.
    """

    def __init__(self, parameters: Parameters, num_envs: int) -> None:
        self._num_envs = num_envs
        self._beta = tuple(parameters.b)
        shortest, self._longest = map(int, parameters.range_of("delay"))
        self._block = shortest + 1  # samples
        self._older = len(self._beta) - 1 + self._longest - shortest
        # If the delays differ, many inputs are older. Spare rows make copies of them rare.
        self._delays_differ = self._longest > shortest
        spare = max(self._older, self._block) if self._delays_differ else 0
        self._inputs = np.zeros((self._older + self._block + spare, num_envs))
        self._first_row = 0  # of the window
        self._response = np.zeros((self._block, num_envs))
        self._place = self._block - 1  # of the next input in the block: the first completes it
        # If the delays differ: the inputs of the window at the delay of each plant, and their
        # indices in the flattened window.
        rows = len(self._beta) - 1 + self._block if self._delays_differ else 0
        self._delayed = np.zeros((rows, num_envs))
        self._delayed_at = np.zeros((rows, num_envs), np.intp)

    def reset(self, which: NDArray[np.intp], delays: Values) -> None:
        """Begin an episode of some plants, whose inputs have been 0 so far.

        `delays` have the shape (len(which),) if they are drawn, otherwise ().
        """
        self._inputs[:, which] = 0.0
        self._response[:, which] = 0.0
        if self._delays_differ:
            first_rows = self._longest - delays.astype(np.intp)
            rows = np.arange(len(self._delayed))[:, np.newaxis] + first_rows
            self._delayed_at[:, which] = rows * self._num_envs + which

    def add(self, applied: Values) -> Values:
        """Add u_a(k), t/h, and return the response in y(k+1), degC; only to be read."""
        place = self._place
        self._inputs[self._first_row + self._older + place] = applied
        place += 1
        if place == self._block:
            self._respond()
            place = 0
        self._place = place
        response: Values = self._response[place]
        return response

    def _respond(self) -> None:
        """Compute the response to a complete block of inputs, and move the window on."""
        end = self._first_row + self._older + self._block
        inputs = self._inputs[self._first_row : end]
        if self._delays_differ:
            inputs = inputs.take(self._delayed_at, out=self._delayed, mode="clip")
        self._response[:] = 0.0
        for lag, beta in enumerate(self._beta):
            first = len(self._beta) - 1 - lag
            self._response += beta * inputs[first : first + self._block]
        self._first_row += self._block
        if end + self._block > len(self._inputs):
            self._inputs[: self._older] = self._inputs[self._first_row : end]
            self._first_row = 0
