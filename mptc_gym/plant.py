"""Step the plant and its actuator: arithmetic on state, input and parameters, nothing else.

There are two implementations, side by side: `Plant` in plain floats, which is fastest for one
plant, and `PlantBatch` in arrays. Both do the same operations in the same order, so their
results are equal bit for bit.
"""

from collections import deque
from itertools import accumulate, pairwise
from operator import mul
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mptc_gym.parameters import Parameters, PlantNumbers, slowest_pole

Values = NDArray[np.float64]  # one per plant, shape (n,)
DRIFT_INTERVAL: Final = 10  # samples between changes of drifting dynamics
FACTORS: Final = "gain_factor", "time_constant_factor"


def action_from_command(command: Any, u_min: Any, u_max: Any) -> Any:
    """Scale a command (t/h) to a normalised action in float64: -1 at `u_min`, 1 at `u_max`."""
    return 2.0 * (command - u_min) / (u_max - u_min) - 1.0


def least_effective(dead_zone: Any, u_min: Any, u_max: Any, rounding: float = 2.0**-50) -> Any:
    """Return the smallest magnitude of a command that passes the dead zone, t/h.

    A command on the edge of the dead zone passes. Scaled to an action and back, the command may
    shrink by a few roundings, each of at most 2^-53 of the rounded number, and must still pass.
    `rounding` bounds the sum of these roundings, as a share of the largest numbers involved.
    """
    return dead_zone - rounding * (u_max - u_min + abs(u_max) + abs(u_min))


def float32_action(command: Any, u_min: Any, u_max: Any, dead_zone: Any) -> NDArray[np.float32]:
    """Scale commands (t/h) to the float32 actions that an agent passes to the environment.

    Rounding to float32 can move a command from the edge of the dead zone into the dead zone:
    float32(0.7) stands for 6.99999988 t/h. Such an action is moved outwards by the float32
    spacing near 1. The arguments broadcast, and the actions have the shape of the result.
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
    1 / (1 - p z^-1), scaled to end at 1. For t times the time constant, 1 - p is divided by t,
    and Q stays. As this also divides A(1) = (1 - p) Q(1) by t, B is multiplied by g / t.
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
        """Return which share of the drifts is complete at k = `age`, from 0 to 1."""
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

    As printed, (29) compares the magnitude of u with U_min in one of the cases. The intended
    meaning is: a command inside the dead zone has no effect, and any other command, also a
    command on the edge of the dead zone, is limited to [U_min, U_max].

    Attributes
    ----------
    factors : dict of float
        If gain and time constant drift, their present values under the names `FACTORS`, as
        multiples of the gain and the time constant of A and B. Otherwise empty.
    """

    def __init__(self, parameters: Parameters, numbers: PlantNumbers[float]) -> None:
        u_min, u_max = numbers.u_min, numbers.u_max
        edge = least_effective(numbers.dead_zone, u_min, u_max)
        self._actuator = edge, u_min, u_max, (u_max - u_min) / 2.0
        self._numbers = numbers
        self._drifts = parameters.drifts
        self.factors: dict[str, float] = {}
        self._age = 0
        self._dynamics = Dynamics(parameters)
        self._update_dynamics()
        # A coefficient is paired with the index of its sample in the history. Both histories
        # have the newest sample first: y(k), y(k-1), ... and u_a(k), u_a(k-1), ...
        delay = int(numbers.delay)
        self._beta = tuple(enumerate(parameters.b, start=delay))
        self._outputs = deque([0.0] * len(self._alpha), len(self._alpha))
        self._inputs = deque([0.0] * (delay + len(self._beta)), delay + len(self._beta))

    def step(self, action: float, noise: float, load: float) -> tuple[float, float, float]:
        """Move from sample k to k+1.

        The arguments are a(k), and n(k+1) and the load w(k+1), degC. The results are u(k) and
        u_a(k), t/h, and y(k+1), degC.
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
        factors = self._dynamics.factors(self._numbers, self._age)
        if self._drifts:
            self.factors = dict(zip(FACTORS, factors, strict=True))
        alpha, self._scale, self._load_gain = self._dynamics.coefficients(*factors)
        self._alpha = tuple(enumerate(alpha))


class PlantBatch:
    """Many plants side by side: `Plant` in arrays.

    Attributes
    ----------
    numbers : PlantNumbers
        The numbers of the present plants, in arrays of float64. Numbers that are drawn have the
        shape (n,), and the others the shape ().
    factors : dict of ndarray of float64
        If gain and time constant drift, their present values under the names `FACTORS`, shape
        (n,), as multiples of the gain and the time constant of A and B. Otherwise empty.
    """

    def __init__(self, parameters: Parameters, num_envs: int) -> None:
        self._parameters = parameters
        self._num_envs = num_envs
        # In array arithmetic, an array of one number is faster than a number.
        numbers: dict[str, Values] = {}
        for name, lowest in vars(parameters.lowest).items():
            shape = (num_envs,) if name in parameters.ranges else ()
            numbers[name] = np.full(shape, lowest, float)
        self.numbers: PlantNumbers[Values] = PlantNumbers(**numbers)
        self._update_actuator()

        self._dynamics = Dynamics(parameters)
        # Samples since the plants were created, and at the start of each plant's episode.
        self._clock = 0
        self._starts = np.zeros(num_envs if parameters.drifts else (), np.int64)
        self._next_update = 0  # the clock when the dynamics change next
        self.factors: dict[str, Values] = {}
        self._update_dynamics()
        order = len(self._alpha)
        self._outputs = deque(np.zeros((order, num_envs)), maxlen=order)  # newest first
        self._input_response = _InputResponse(parameters, num_envs)

    def reset(self, which: NDArray[np.intp], numbers: PlantNumbers[Values]) -> None:
        """Bring some plants to rest.

        Parameters
        ----------
        which
            The indices of the plants.
        numbers
            The new numbers of these plants: numbers that are drawn have the shape
            (len(which),), and the others the shape ().
        """
        for outputs in self._outputs:
            outputs[which] = 0.0
        self._input_response.reset(which, numbers.delay)
        ranges = self._parameters.ranges
        for name, values in numbers.chosen(ranges).items():
            getattr(self.numbers, name)[which] = values
        if ranges:
            self._update_actuator()
        if self._parameters.drifts:
            self._starts[which] = self._clock
        if ranges or self._parameters.drifts:
            self._update_dynamics()

    def step(
        self, action: Values, noise: Values, load: Values | None = None
    ) -> tuple[Values, Values, Values]:
        """Move all plants from sample k to k+1, like `Plant.step`, in arrays of shape (n,).

        Without a load, `load` is None. The plants keep the array of outputs that they return,
        so the caller must not modify this array.
        """
        if self._parameters.drifts:
            self._clock += 1
            if self._clock >= self._next_update:
                self._update_dynamics()
        zero, one, half_range, lowest, edge, u_min, u_max = self._actuator
        command = action + one
        command *= half_range
        command += lowest
        # (29)
        applied = np.minimum(command, u_max)
        np.maximum(applied, u_min, out=applied)
        # A product is faster than a mask, whose branches are unpredictable. The product can be
        # -0, which adding 0 turns into 0.
        applied *= np.abs(command) >= edge
        applied += zero
        # (28): the response to the inputs by B, the load, and the past outputs by A.
        response = self._input_response.add(applied)
        if self._parameters.changes_dynamics:
            response = self._scale * response
        if load is not None:
            noise = noise + self._load_gain * load
        output: Values = noise + response
        for term in map(mul, self._alpha, self._outputs):
            output += term
        self._outputs.appendleft(output)
        return command, applied, output

    def _update_actuator(self) -> None:
        """Compute what a step needs of the actuator's numbers.

        The limits have the shape (num_envs,): in comparisons, an array of full length is faster
        than an array of one number.
        """
        u_min = self.numbers.u_min
        u_max = self.numbers.u_max
        self._actuator = (
            np.array(0.0),
            np.array(1.0),
            np.array((u_max - u_min) / 2.0),
            np.array(u_min),
            np.array(least_effective(self.numbers.dead_zone, u_min, u_max)),
            np.full(self._num_envs, u_min),
            np.full(self._num_envs, u_max),
        )

    def _update_dynamics(self) -> None:
        """Update the dynamics to the ages of the plants, in steps of `DRIFT_INTERVAL`."""
        ages = self._clock - self._starts
        last_changes = ages // DRIFT_INTERVAL * DRIFT_INTERVAL
        factors = self._dynamics.factors(self.numbers, last_changes)
        if self._parameters.drifts:
            self.factors = dict(zip(FACTORS, factors, strict=True))
        alpha, self._scale, self._load_gain = self._dynamics.coefficients(*factors)
        self._alpha = tuple(map(np.asarray, alpha))
        samples_to_change = last_changes + DRIFT_INTERVAL - ages
        self._next_update = self._clock + int(samples_to_change.min())


class _InputResponse:
    """The response of many plants to their inputs: B of (28), for a block of samples at once.

    With d the shortest delay that can be drawn, the inputs of d + 1 samples affect no output
    before the last of these inputs is known. So the response to such a block is computed when
    the block is complete, and then read sample by sample.

    The inputs lie in rows, one per sample, the oldest first: the older inputs that B and longer
    delays also need, and then the block.
    """

    def __init__(self, parameters: Parameters, num_envs: int) -> None:
        self._num_envs = num_envs
        self._beta = tuple(parameters.b)
        shortest, self._longest = map(int, parameters.range_of("delay"))
        self._block = shortest + 1  # samples
        self._older = len(self._beta) - 1 + self._longest - shortest  # samples
        self._inputs = np.zeros((self._older + self._block, num_envs))
        self._response = np.zeros((self._block, num_envs))
        self._place = self._block - 1  # of the next input in the block: the first completes it
        # If the delays differ: the inputs at the delay of each plant, and the indices of these
        # inputs in the flattened inputs.
        self._delays_differ = self._longest > shortest
        rows = len(self._beta) - 1 + self._block if self._delays_differ else 0
        self._delayed = np.zeros((rows, num_envs))
        self._delayed_at = np.zeros((rows, num_envs), np.intp)

    def reset(self, which: NDArray[np.intp], delays: Values) -> None:
        """Begin an episode of some plants, whose inputs have been 0 so far.

        `which` are the indices of the plants. `delays`, in samples, have the shape
        (len(which),) if delays are drawn, otherwise ().
        """
        self._inputs[:, which] = 0.0
        self._response[:, which] = 0.0
        if self._delays_differ:
            first_rows = self._longest - delays.astype(np.intp)
            rows = np.arange(len(self._delayed))[:, np.newaxis] + first_rows
            self._delayed_at[:, which] = rows * self._num_envs + which

    def add(self, applied: Values) -> Values:
        """Add u_a(k), t/h, and return the response in y(k+1), degC; only to be read."""
        self._inputs[self._older + self._place] = applied
        self._place += 1
        if self._place == self._block:
            self._respond()
            self._place = 0
        response: Values = self._response[self._place]
        return response

    def _respond(self) -> None:
        """Compute the response to a complete block of inputs, and make room for the next."""
        inputs = self._inputs
        if self._delays_differ:
            inputs = inputs.take(self._delayed_at, out=self._delayed, mode="clip")
        self._response[:] = 0.0
        for lag, beta in enumerate(self._beta):
            first = len(self._beta) - 1 - lag
            self._response += beta * inputs[first : first + self._block]
        self._inputs[: self._older] = self._inputs[self._block :]
