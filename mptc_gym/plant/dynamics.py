"""Step the plant and its actuator, without set point, reward and Gymnasium.

There are two implementations: `Plant` in Python floats, which is fastest for one plant, and
`PlantBatch` in NumPy arrays for many plants. Both classes do the same operations in the same
order, so the results of both classes are equal bit for bit.

Equations (28) and (29) of the paper (see `MiddlePointEnv`) are the plant and the actuator::

    (28)  A(z^-1) y(k) = B(z^-1) u_a(k - d) + C(z^-1) xi(k)
    (29)  u_a = 0 where |u| < dead_zone, otherwise u limited to [u_min, u_max]

with temperature y, commanded flow u, applied flow u_a, delay d in samples and white noise xi.
"""

from collections import deque
from itertools import pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mptc_gym.plant.parameters import Parameters, PlantNumbers, slowest_pole

Values = NDArray[np.float64]  # one element per plant, shape (n,)
# In NumPy arithmetic, an array of one element is faster than a Python number.
_ZERO = np.array(0.0)
_ONE = np.array(1.0)
# Samples between two changes of drifting dynamics: drifts are slow, and a change takes time.
DRIFT_INTERVAL: Final = 10
FACTORS: Final = "gain_factor", "time_constant_factor"  # keys of the drift factors in infos


def action_from_command(command: Any, u_min: Any, u_max: Any) -> Any:
    """Return the normalised action, -1 at `u_min` and 1 at `u_max`, for a flow command in t/h.

    The arguments and the result are floats, or arrays or tensors that broadcast. A command
    beyond the limits gives an action beyond -1 or 1.
    """
    return 2.0 * (command - u_min) / (u_max - u_min) - 1.0


def least_effective_command(
    dead_zone: Any, u_min: Any, u_max: Any, rounding: float = 2.0**-50
) -> Any:
    """Return the smallest magnitude of a flow command that passes the dead zone, in t/h.

    The result is a few rounding errors smaller than `dead_zone`, so that a command on the edge
    of the dead zone still has an effect after it was scaled to an action and back.

    Parameters
    ----------
    dead_zone
        Half width of the dead zone, t/h: a float, an array or a tensor.
    u_min, u_max
        Limits of the actuator, t/h.
    rounding
        Bound of the accumulated rounding error, as a share of the sum of range and limits. The
        default, 2^-50, covers 8 roundings of 2^-53 in float64.
    """
    return dead_zone - rounding * (u_max - u_min + abs(u_max) + abs(u_min))


def float32_action(command: Any, u_min: Any, u_max: Any, dead_zone: Any) -> NDArray[np.float32]:
    """Return the float32 actions that make the environment apply flow commands in t/h.

    Rounding to float32 can move a command from the edge of the dead zone into the dead zone:
    float32(0.7) stands for 6.99999988 t/h. An action that has lost its effect by rounding is
    moved away from the dead zone, by the spacing of float32 numbers near 1.

    Parameters
    ----------
    command
        Commanded flows, t/h, of any shape.
    u_min, u_max
        Limits of the actuator, t/h.
    dead_zone
        Half width of the dead zone, t/h.

    Returns
    -------
    ndarray of float32
        Normalised actions, of the shape to which the four arguments broadcast.
    """
    commands = np.asarray(command, float)
    actions = np.asarray(action_from_command(commands, u_min, u_max)).astype(np.float32)
    half_range = (u_max - u_min) / 2.0
    # The commands that the plant computes from the rounded actions, t/h.
    rounded_commands = (actions.astype(float) + 1.0) * half_range + u_min
    had_effect = np.abs(commands) >= dead_zone
    has_effect = np.abs(rounded_commands) >= dead_zone
    spacing = np.spacing(np.maximum(np.abs(actions), np.float32(1.0)))
    moved_actions = actions + np.copysign(spacing, commands).astype(np.float32)
    return np.where(had_effect & ~has_effect, moved_actions, actions)


class Dynamics:
    """The coefficients of the plant as functions of steady-state gain and time constant.

    The plant is equation (28) of the paper, A(z^-1) y(k) = B(z^-1) u_a(k - d) + C(z^-1) xi(k),
    with temperature y, applied flow u_a, delay d and white noise xi. The polynomial A is (1 - p
    z^-1) Q, where p is the slowest pole. Two factors, g and t, change the plant: the
    steady-state gain is g B(1) / A(1), and the time constant is t / (1 - p) samples. The time
    constant is the area above the step response of 1 / (1 - p z^-1), scaled to end at 1. To
    multiply the time constant by t, the slowest pole p moves so that 1 - p is divided by t; the
    polynomial Q, which holds the other poles, stays. As A(1) = (1 - p) Q(1) is then divided by
    t, the polynomial B is multiplied by g / t.

    Parameters
    ----------
    parameters
        The arguments of the environment.
    """

    def __init__(self, parameters: Parameters) -> None:
        self._drift_samples = parameters.drift_samples
        self._negated_a = [-coefficient for coefficient in parameters.a[1:]]
        self._sum_of_a = sum(parameters.a)  # A(1)
        # The coefficients of Q from z^0 on, and a 0; empty if the time constant never changes.
        self._quotient: list[float] = []
        if parameters.changes_time_constant:
            pole = slowest_pole(parameters.a).real  # a real one, as Parameters has checked
            self._rate = 1.0 - pole
            quotient, _remainder = np.polydiv(parameters.a, [1.0, -pole])
            self._quotient = [*quotient.tolist(), 0.0]

    def drift_share(self, age: Any) -> Any:
        """Return which share of the drifts of gain and time constant is complete at k = `age`.

        The share of a drift that is complete grows linearly from 0 at sample k = 0 to 1 at
        sample k = `drift_samples`, and then stays 1. `age` and the result are numbers, or
        arrays or tensors with an element for each plant.
        """
        share = age / self._drift_samples
        return share * (share < 1.0) + (share >= 1.0)  # at most 1, for arrays of any library

    def factors(self, numbers: PlantNumbers[Any], age: Any) -> tuple[Any, Any]:
        """Return the gain factor g and the time constant factor t at sample k = `age`.

        g and t are multiples of the gain and of the time constant that the arguments `a` and
        `b` give: two floats, or two arrays or tensors of shape (n,) for n plants.

        Parameters
        ----------
        numbers
            The plant numbers, which hold the factors at k = 0 and the drifts.
        age
            Samples since the start of the episode: a number, or one element for each plant.
        """
        share = self.drift_share(age)
        gain = numbers.gain_factor
        time_constant = numbers.time_constant_factor
        return (
            gain + gain * (numbers.gain_drift - 1.0) * share,
            time_constant + time_constant * (numbers.time_constant_drift - 1.0) * share,
        )

    def coefficients(self, gain: Any, time_constant: Any) -> tuple[list[Any], Any, Any]:
        """Return the coefficients of the plant, equation (28) of the paper, for given factors.

        Parameters
        ----------
        gain, time_constant
            g and t, as multiples of the gain and of the time constant of the polynomials A and
            B: floats, or arrays or tensors of shape (n,) for n plants.

        Returns
        -------
        alpha : list
            Factors of the outputs y(k-1), y(k-2), ...: the coefficients of A from z^-1 on,
            negated.
        scale : float or array
            Factor g / t of the polynomial B.
        load_gain : float or array
            A(1) after the change of the time constant: the factor of the load w(k), with which
            a constant load w adds w to the steady-state temperature.
        """
        alpha: list[Any] = self._negated_a
        if self._quotient:
            # The coefficients of -(1 - p z^-1) Q, with p = `pole`, from z^-1 on.
            pole = 1.0 - self._rate / time_constant
            alpha = [
                pole * previous - following for previous, following in pairwise(self._quotient)
            ]
        return alpha, gain / time_constant, self._sum_of_a / time_constant


class Plant:
    """One plant with its actuator, initially at rest: equations (28) and (29) of the paper.

    As printed in the paper, equation (29) compares the magnitude of the command u with U_min in
    one of its cases. The intended meaning is: a command inside the dead zone has no effect, and
    a command on the edge of the dead zone or outside is limited to [U_min, U_max].

    Parameters
    ----------
    parameters
        The arguments of the environment.
    numbers
        The plant numbers of the episode, in place of the ranges in `parameters`.

    Attributes
    ----------
    factors : dict of float
        If gain and time constant drift, the present factors "gain_factor" and
        "time_constant_factor", as multiples of the gain and of the time constant of the
        polynomials A and B. Empty if neither drifts.
    """

    def __init__(self, parameters: Parameters, numbers: PlantNumbers[float]) -> None:
        self._numbers = numbers
        self._u_min = numbers.u_min
        self._u_max = numbers.u_max
        self._half_range = (numbers.u_max - numbers.u_min) / 2.0
        self._edge = least_effective_command(numbers.dead_zone, numbers.u_min, numbers.u_max)
        self._drifts = parameters.drifts
        self.factors: dict[str, float] = {}
        self._age = 0
        self._dynamics = Dynamics(parameters)
        self._update_dynamics()
        # Past temperatures and applied flows, the newest first.
        delay = int(numbers.delay)
        past_flows = delay + len(parameters.b)
        self._outputs = deque([0.0] * len(self._alpha), maxlen=len(self._alpha))
        self._flows = deque([0.0] * past_flows, maxlen=past_flows)
        # Each coefficient of B with the index of its flow in `_flows`.
        self._beta = tuple(enumerate(parameters.b, start=delay))

    def step(self, action: float, noise: float, load: float) -> tuple[float, float, float]:
        """Move the plant from sample k to sample k+1.

        Parameters
        ----------
        action
            Normalised action a(k): -1 commands `u_min`, and 1 commands `u_max`.
        noise
            Coloured noise n(k+1) of equation (28) of the paper, degC.
        load
            Load disturbance w(k+1), degC.

        Returns
        -------
        tuple of float
            Commanded flow u(k) and applied flow u_a(k), t/h, and temperature y(k+1), degC.
        """
        if self._drifts:
            self._age += 1
            if self._age % DRIFT_INTERVAL == 0:
                self._update_dynamics()
        # Last formula of the paper's Section 4, which scales network outputs from 0 to 1, for
        # actions from -1 to 1.
        u_min = self._u_min
        command = u_min + (action + 1.0) * self._half_range
        # Equation (29): dead zone and limits.
        applied = command
        if -self._edge < command < self._edge:
            applied = 0.0
        elif command < u_min:
            applied = u_min
        elif command > self._u_max:
            applied = self._u_max
        # Equation (28): the sum of B times past flows, the load, and A times past temperatures.
        flows = self._flows
        flows.appendleft(applied)
        response = 0.0
        for lag, beta in self._beta:
            response += beta * flows[lag]
        if load:
            noise += self._load_gain * load
        output = noise + self._scale * response
        outputs = self._outputs
        for lag, alpha in self._alpha:
            output += alpha * outputs[lag]
        outputs.appendleft(output)
        return command, applied, output

    def _update_dynamics(self) -> None:
        """Compute coefficients and drift factors for the present sample k of the episode."""
        factors = self._dynamics.factors(self._numbers, self._age)
        if self._drifts:
            self.factors = dict(zip(FACTORS, factors, strict=True))
        alpha, self._scale, self._load_gain = self._dynamics.coefficients(*factors)
        # Each factor of a past temperature, with the index of the temperature in `_outputs`.
        self._alpha = tuple(enumerate(alpha))


class PlantBatch:
    """Many plants with their actuators, in NumPy arrays; the results equal those of `Plant`.

    Parameters
    ----------
    parameters
        The arguments of the environment.
    num_envs
        Number n of plants.

    Attributes
    ----------
    numbers : PlantNumbers
        The plant numbers of the present episodes, in arrays of float64: of shape (n,) for the
        arguments that are ranges, and of shape () for the other arguments.
    factors : dict of ndarray of float64
        If gain and time constant drift, the present factors "gain_factor" and
        "time_constant_factor", shape (n,), as multiples of the gain and of the time constant of
        the polynomials A and B of equation (28) of the paper. Empty if neither drifts.
    """

    def __init__(self, parameters: Parameters, num_envs: int) -> None:
        self._parameters = parameters
        self._num_envs = num_envs
        numbers: dict[str, Values] = {}
        for name, lowest in vars(parameters.lowest).items():
            shape = (num_envs,) if name in parameters.ranges else ()
            numbers[name] = np.full(shape, lowest, float)
        self.numbers: PlantNumbers[Values] = PlantNumbers(**numbers)
        self._update_actuator()

        self._dynamics = Dynamics(parameters)
        # Times of the drifts, in samples since the plants were created: the present time, the
        # start of each plant's episode, and when the dynamics of some plant change next.
        self._clock = 0
        self._starts: NDArray[np.int64] = np.zeros((), np.int64)
        if parameters.drifts:
            self._starts = np.zeros(num_envs, np.int64)
        self._next_update = 0
        self.factors: dict[str, Values] = {}
        self._update_dynamics()
        order = len(self._alpha)
        self._outputs = deque(np.zeros((order, num_envs)), maxlen=order)  # newest first
        self._input_response = _InputResponse(parameters, num_envs)

    def reset(self, plants: NDArray[np.intp], numbers: PlantNumbers[Values]) -> None:
        """Bring the plants with the indices `plants` to rest, and set their plant numbers.

        `numbers` holds arrays of shape (len(plants),) for the arguments that are ranges, and of
        shape () for the other arguments.
        """
        for outputs in self._outputs:
            outputs[plants] = 0.0
        self._input_response.reset(plants, numbers.delay)
        ranges = self._parameters.ranges
        for name, values in numbers.select(ranges).items():
            getattr(self.numbers, name)[plants] = values
        if ranges:
            self._update_actuator()
        if self._parameters.drifts:
            self._starts[plants] = self._clock
        if ranges or self._parameters.drifts:
            self._update_dynamics()

    def step(
        self, action: Values, noise: Values, load: Values | None = None
    ) -> tuple[Values, Values, Values]:
        """Move all plants from sample k to sample k+1; all arrays have the shape (n,).

        Parameters
        ----------
        action
            Normalised actions a(k).
        noise
            Coloured noise n(k+1) of equation (28) of the paper, degC.
        load
            Load disturbance w(k+1), degC; None if the plants have no load disturbance.

        Returns
        -------
        tuple of ndarray
            Commanded flows u(k) and applied flows u_a(k), t/h, and temperatures y(k+1), degC.
            The caller must not modify the array of temperatures.
        """
        if self._parameters.drifts:
            self._clock += 1
            if self._clock >= self._next_update:
                self._update_dynamics()
        command = action + _ONE
        command *= self._half_range
        command += self.numbers.u_min
        # Equation (29): limits and dead zone.
        applied = np.minimum(command, self._u_max)
        np.maximum(applied, self._u_min, out=applied)
        # A product is faster than a mask, whose branches are unpredictable. The product can be
        # -0, which adding 0 turns into 0.
        applied *= np.abs(command) >= self._edge
        applied += _ZERO
        # Equation (28): the sum of B times past flows, the load, and A times past temperatures.
        response = self._input_response.add(applied)
        if self._parameters.changes_dynamics:
            response = self._scale * response
        if load is not None:
            noise = noise + self._load_gain * load
        output: Values = noise + response
        for alpha, past_output in zip(self._alpha, self._outputs, strict=True):
            output += alpha * past_output
        self._outputs.appendleft(output)
        return command, applied, output

    def _update_actuator(self) -> None:
        """Compute what `step` needs from limits and dead zones, after these change."""
        u_min = self.numbers.u_min
        u_max = self.numbers.u_max
        self._half_range = np.array((u_max - u_min) / 2.0)
        self._edge = np.array(least_effective_command(self.numbers.dead_zone, u_min, u_max))
        # In comparisons, an array of shape (n,) is faster than an array of one number.
        self._u_min = np.full(self._num_envs, u_min)
        self._u_max = np.full(self._num_envs, u_max)

    def _update_dynamics(self) -> None:
        """Compute coefficients and drift factors for the present sample k of each plant.

        Dynamics that drift change only at samples k that are multiples of `DRIFT_INTERVAL`.
        """
        ages = self._clock - self._starts  # the present sample k of each plant's episode
        ages_at_change = ages // DRIFT_INTERVAL * DRIFT_INTERVAL  # at the latest change
        factors = self._dynamics.factors(self.numbers, ages_at_change)
        if self._parameters.drifts:
            self.factors = dict(zip(FACTORS, factors, strict=True))
        alpha, self._scale, self._load_gain = self._dynamics.coefficients(*factors)
        self._alpha = tuple(map(np.asarray, alpha))
        samples_to_change = ages_at_change + DRIFT_INTERVAL - ages
        self._next_update = self._clock + int(samples_to_change.min())


class _InputResponse:
    """The part of the temperature that past flows cause, B(z^-1) u_a(k-d), for many plants.

    B is the polynomial of equation (28) of the paper, u_a the applied flow and d the delay, in
    samples. A flow affects no temperature of the next d samples, where d is the shortest
    possible delay. The effect of a block of d + 1 flows is therefore computed at once, when the
    block is complete, and then read sample by sample.

    The flows lie in rows, one row per sample, the oldest sample first: the older flows that B
    and longer delays also need, and then the flows of the block.

    Parameters
    ----------
    parameters
        The arguments of the plants.
    num_envs
        Number n of plants.
    """

    def __init__(self, parameters: Parameters, num_envs: int) -> None:
        self._num_envs = num_envs
        self._beta = tuple(parameters.b)
        shortest, self._longest = map(int, parameters.range_of("delay"))
        self._block_rows = shortest + 1
        # Rows before the block, with the older flows that B and longer delays need.
        self._older_rows = len(self._beta) - 1 + self._longest - shortest
        self._flows = np.zeros((self._older_rows + self._block_rows, num_envs))
        self._response = np.zeros((self._block_rows, num_envs))
        # Index of the next flow in the block. The first flow completes a block, whose other
        # flows, before k = 0, are 0.
        self._next_row = self._block_rows - 1
        # Used only if the delays differ: the flows in `_flows` that act on the block after the
        # delay of each plant, and the indices of these flows in the flattened `_flows`.
        self._delays_differ = self._longest > shortest
        delayed_rows = len(self._beta) - 1 + self._block_rows
        self._delayed_flows = np.zeros((delayed_rows, num_envs))
        self._delayed_indices = np.zeros((delayed_rows, num_envs), np.intp)

    def reset(self, plants: NDArray[np.intp], delays: Values) -> None:
        """Begin an episode of the plants with the indices `plants`; past flows count as 0.

        `delays` holds the delays of these plants, samples, shape (len(plants),) or ().
        """
        self._flows[:, plants] = 0.0
        self._response[:, plants] = 0.0
        if self._delays_differ:
            first_rows = self._longest - delays.astype(np.intp)
            rows = np.arange(len(self._delayed_flows))[:, np.newaxis] + first_rows
            self._delayed_indices[:, plants] = rows * self._num_envs + plants

    def add(self, applied: Values) -> Values:
        """Add the applied flows of sample k, and return the effect of flows on y(k+1).

        `applied` holds the flows u_a(k), t/h, shape (n,). The result is B(z^-1) u_a(k+1-d), a
        part of y(k+1), degC, shape (n,); the caller must not modify the result.
        """
        self._flows[self._older_rows + self._next_row] = applied
        self._next_row += 1
        if self._next_row == self._block_rows:
            self._respond()
            self._next_row = 0
        response: Values = self._response[self._next_row]
        return response

    def _respond(self) -> None:
        """Compute the effect of a complete block of flows, and make room for the next block."""
        flows = self._flows
        if self._delays_differ:
            # "clip" is faster than a check of the indices, which are always valid.
            flows = flows.take(self._delayed_indices, out=self._delayed_flows, mode="clip")
        self._response[:] = 0.0
        for lag, beta in enumerate(self._beta):
            first_row = len(self._beta) - 1 - lag
            self._response += beta * flows[first_row : first_row + self._block_rows]
        self._flows[: self._older_rows] = self._flows[self._block_rows :]
