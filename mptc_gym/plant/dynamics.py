"""Simulate the plant with its actuator, without set point, reward and Gymnasium.

`Plant` simulates one plant in Python floats, which is the fastest way for one plant.
`PlantBatch` simulates many plants in NumPy arrays. `Plant` and `PlantBatch` do the same
operations in the same order, so that the results are equal bit for bit.

The paper that the docstring of `MiddlePointEnv` cites describes the plant by equation (28)::

    (28)  A(z^-1) y(k) = B(z^-1) u_a(k - d) + C(z^-1) xi(k)

In equation (28), y is the temperature, u_a the applied flow, d the delay in samples and xi
white noise. The actuator, equation (29), is defined in `mptc_gym.plant.actuator`. For speed,
`Plant.step` and `PlantBatch.step` have the lines of `command_from_action` and `applied_flow`
written out, with equal results.
"""

from collections import deque
from itertools import pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mptc_gym.plant.actuator import least_effective_command
from mptc_gym.plant.parameters import Parameters, PlantNumbers, slowest_pole

Values = NDArray[np.float64]  # one element per plant, shape (n,)
# In NumPy arithmetic, an array of shape () is faster than a Python number.
_ARRAY_OF_0 = np.array(0.0)
_ARRAY_OF_1 = np.array(1.0)
# Number of samples between two changes of a drifting gain or time constant: drifts are slow,
# and computing a change takes time.
DRIFT_INTERVAL: Final = 10
FACTORS: Final = "gain_factor", "time_constant_factor"  # keys of the drift factors in infos


class Dynamics:
    """The coefficients of the plant for a given steady-state gain and time constant.

    The plant is equation (28) of the paper, A(z^-1) y(k) = B(z^-1) u_a(k - d) + C(z^-1) xi(k),
    with temperature y, applied flow u_a, delay d and white noise xi. The polynomial A is the
    product of 1 - p z^-1, where p is the slowest pole, and of a polynomial Q with the other
    poles.

    A gain factor g multiplies the steady-state gain, which is B(1) / A(1) for the polynomials A
    and B of the arguments. A time constant factor t multiplies the dominant time constant,
    which is 1 / (1 - p) samples for the slowest pole p. The time constant 1 / (1 - p) is the
    area above the step response of the filter (1 - p) z^-1 / (1 - p z^-1), which rises from 0
    to 1.

    A time constant factor t replaces the slowest pole p of the plant by 1 - (1 - p) / t, and
    leaves the other poles unchanged. The new pole divides A(1), the sum of the coefficients of
    the polynomial A, by t. To multiply the steady-state gain B(1) / A(1) by the gain factor g
    alone, the polynomial B is therefore multiplied by g / t.

    Parameters
    ----------
    parameters
        Arguments of the environment.
    """

    def __init__(self, parameters: Parameters) -> None:
        self._drift_samples = parameters.drift_samples
        self._negated_a = [-coefficient for coefficient in parameters.a[1:]]  # from z^-1 on
        self._sum_of_a = sum(parameters.a)  # A(1)
        # The coefficients of Q, with A = Q times 1 - p z^-1, followed by a 0 that makes them as
        # long as A. The list is empty if the time constant never changes.
        self._quotient: list[float] = []
        if parameters.changes_time_constant:
            pole = slowest_pole(parameters.a).real  # a real one, as Parameters has checked
            self._rate = 1.0 - pole  # 1 / time constant, per sample
            quotient, _remainder = np.polydiv(parameters.a, [1.0, -pole])
            self._quotient = [*quotient.tolist(), 0.0]

    def factors(self, numbers: PlantNumbers[Any], k: Any) -> tuple[Any, Any]:
        """Return the gain factor g and the time constant factor t at sample k.

        g is the steady-state gain divided by the gain of the arguments `a` and `b`, and t is
        the time constant divided by the time constant of the argument `a`. g and t are floats,
        or arrays or tensors of shape (n,) for n plants.

        Parameters
        ----------
        numbers
            Parameter values of the plants, such as `gain_factor` and `gain_drift`.
        k
            Number of samples since the start of the episode: a number, or an array or tensor
            with one element per plant.
        """
        # The share of the drift that is complete: it grows linearly to 1 at `drift_samples`.
        share = k / self._drift_samples
        share = share * (share < 1.0) + (share >= 1.0)  # at most 1, for arrays of any library
        gain = numbers.gain_factor
        time_constant = numbers.time_constant_factor
        return (
            gain + gain * (numbers.gain_drift - 1.0) * share,
            time_constant + time_constant * (numbers.time_constant_drift - 1.0) * share,
        )

    def coefficients(self, gain: Any, time_constant: Any) -> tuple[list[Any], Any, Any]:
        """Return the plant's coefficients for a given gain factor g and time constant factor t.

        Parameters
        ----------
        gain, time_constant
            Gain factor g and time constant factor t: multiples of the steady-state gain and of
            the time constant of the polynomials A and B, as floats, or as arrays or tensors of
            shape (n,) for n plants.

        Returns
        -------
        alpha : list
            Factors of the temperatures y(k-1), y(k-2), ... in equation (28): the negated
            coefficients of the polynomial A from z^-1 on.
        scale : float or array
            Gain factor divided by time constant factor, g / t, by which the polynomial B is
            multiplied.
        load_gain : float or array
            Factor of the load disturbance w(k), which is not in the paper and is added to the
            right side of equation (28): the sum of the coefficients of the polynomial A for the
            given time constant, so that a constant load w adds w to the steady-state
            temperature.
        """
        alpha: list[Any] = self._negated_a
        if self._quotient:  # the time constant can change
            # The coefficients of -(1 - p z^-1) Q, with p = `pole`, from z^-1 on.
            pole = 1.0 - self._rate / time_constant
            alpha = [
                pole * previous - following for previous, following in pairwise(self._quotient)
            ]
        return alpha, gain / time_constant, self._sum_of_a / time_constant


class Plant:
    """One plant with its actuator, initially at rest: equations (28) and (29) of the paper.

    Parameters
    ----------
    parameters
        Arguments of the environment.
    numbers
        Parameter values of the plant in this episode, in place of the ranges in `parameters`.

    Attributes
    ----------
    factors : dict of float
        Values of "gain_factor" and "time_constant_factor" at the present sample, as multiples
        of the gain and of the time constant of the polynomials `a` and `b` in `parameters`.
        `factors` is empty if neither gain nor time constant drifts.
    """

    def __init__(self, parameters: Parameters, numbers: PlantNumbers[float]) -> None:
        self._numbers = numbers
        self._u_min = numbers.u_min
        self._u_max = numbers.u_max
        self._half_range = (numbers.u_max - numbers.u_min) / 2.0
        self._least_effective_command = least_effective_command(
            numbers.dead_zone, numbers.u_min, numbers.u_max
        )
        self._drifts = parameters.drifts
        self.factors: dict[str, float] = {}
        self._k = 0  # the present sample, counted only if the plant drifts
        self._dynamics = Dynamics(parameters)
        self._update_dynamics()  # which sets `_alpha`, `_scale` and `_load_gain`
        # Past temperatures and applied flows, the newest first. When `step` computes y(k+1),
        # the first flow is u_a(k).
        delay = int(numbers.delay)
        past_flows = delay + len(parameters.b)
        self._outputs = deque([0.0] * len(self._alpha), maxlen=len(self._alpha))
        self._flows = deque([0.0] * past_flows, maxlen=past_flows)
        # Pairs of the index of a past flow in `_flows` and the coefficient of B for this flow.
        self._beta = tuple(enumerate(parameters.b, start=delay))

    def __copy__(self) -> "Plant":
        """Return a plant in the same state, whose steps do not change this plant."""
        duplicate = object.__new__(Plant)
        vars(duplicate).update(vars(self))
        # All else is replaced by `step` and never changed in place.
        duplicate._outputs = self._outputs.copy()
        duplicate._flows = self._flows.copy()
        return duplicate

    def step(self, action: float, noise: float, load: float) -> tuple[float, float, float]:
        """Move the plant from sample k to sample k+1.

        Parameters
        ----------
        action
            Normalised action a(k): -1 commands the flow `u_min`, and 1 commands the flow
            `u_max`.
        noise
            Coloured noise C(z^-1) xi(k+1) of equation (28) of the paper, degC.
        load
            Load disturbance w(k+1), degC.

        Returns
        -------
        tuple of float
            Commanded flow u(k) and applied flow u_a(k), t/h, and temperature y(k+1), degC.
        """
        if self._drifts:
            self._k += 1
            if self._k % DRIFT_INTERVAL == 0:
                self._update_dynamics()
        # `command_from_action` of `mptc_gym.plant.actuator`, written out for speed.
        u_min = self._u_min
        command = u_min + (action + 1.0) * self._half_range
        # Equation (29): `applied_flow` of `mptc_gym.plant.actuator`, written out for speed.
        applied = command
        if -self._least_effective_command < command < self._least_effective_command:
            applied = 0.0
        elif command < u_min:
            applied = u_min
        elif command > self._u_max:
            applied = self._u_max
        # Equation (28), and the load, which is not in the paper.
        flows = self._flows
        flows.appendleft(applied)
        response = 0.0
        for lag, beta in self._beta:
            response += beta * flows[lag]
        if load:  # With its gain, a constant load w adds w to the steady temperature.
            noise += self._load_gain * load
        output = noise + self._scale * response
        outputs = self._outputs
        for lag, alpha in self._alpha:
            output += alpha * outputs[lag]
        outputs.appendleft(output)
        return command, applied, output

    def _update_dynamics(self) -> None:
        """Update the plant's coefficients and drift factors to the present sample.

        This sample is k = 0, or the latest multiple of `DRIFT_INTERVAL`.
        """
        factors = self._dynamics.factors(self._numbers, self._k)
        if self._drifts:
            self.factors = dict(zip(FACTORS, factors, strict=True))
        alpha, self._scale, self._load_gain = self._dynamics.coefficients(*factors)
        # Pairs of the index of a past temperature in `_outputs` and the factor of this
        # temperature.
        self._alpha = tuple(enumerate(alpha))


class PlantBatch:
    """n plants with actuators in NumPy arrays, with the same results as n objects `Plant`.

    Parameters
    ----------
    parameters
        Arguments of the environment.
    num_envs
        Number n of plants.

    Attributes
    ----------
    numbers : PlantNumbers
        Parameter values of the plants in the present episodes: float64 arrays, of shape (n,)
        for the arguments that are ranges, and of shape () for all other arguments.
    factors : dict of ndarray of float64
        Values of "gain_factor" and "time_constant_factor" at the present sample, shape (n,), as
        multiples of the gain and of the time constant of the polynomials `a` and `b` in
        `parameters`. `factors` is empty if neither gain nor time constant drifts.
    """

    def __init__(self, parameters: Parameters, num_envs: int) -> None:
        self._parameters = parameters
        self._num_envs = num_envs
        numbers: dict[str, Values] = {}
        for name, lowest in vars(parameters.lowest).items():
            shape = (num_envs,) if name in parameters.ranges else ()
            # For a range, its low end, until `reset` sets the sampled numbers.
            numbers[name] = np.full(shape, lowest, float)
        self.numbers: PlantNumbers[Values] = PlantNumbers(**numbers)
        self._update_actuator()

        self._dynamics = Dynamics(parameters)
        # Times in samples since the plants were created: the present time, the start of each
        # plant's episode, and the time at which the next drifting gain or time constant
        # changes. The time is counted only if the plants drift.
        self._clock = 0
        self._starts = np.zeros(num_envs, np.int64)
        self._next_update = 0
        self.factors: dict[str, Values] = {}
        self._update_dynamics()  # which sets `_alpha`, `_scale` and `_load_gain`
        order = len(self._alpha)
        self._outputs = deque(np.zeros((order, num_envs)), maxlen=order)  # newest first
        self._input_response = _InputResponse(parameters, num_envs)

    def reset(self, plants: NDArray[np.intp], numbers: PlantNumbers[Values]) -> None:
        """Bring the plants with the indices `plants` to rest, and set the parameter values.

        `numbers` holds the parameter values of the plants `plants`: arrays of shape
        (len(plants),) for the arguments that are ranges, and of shape () for all other
        arguments.
        """
        for outputs in self._outputs:
            outputs[plants] = 0.0
        self._input_response.reset(plants, numbers.delay)
        ranges = self._parameters.ranges
        for name, values in numbers.select(ranges).items():
            getattr(self.numbers, name)[plants] = values
        if ranges:
            self._update_actuator()
        self._starts[plants] = self._clock
        if ranges or self._parameters.drifts:  # other numbers, or a drift that begins again
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
        # `command_from_action` of `mptc_gym.plant.actuator`, written out for speed:
        # `_ARRAY_OF_0` and `_ARRAY_OF_1` stand for 0 and 1, as NumPy adds arrays faster.
        command = action + _ARRAY_OF_1
        command *= self._half_range
        command += self.numbers.u_min
        # Equation (29): `applied_flow` of `mptc_gym.plant.actuator`, written out for speed.
        applied = np.minimum(command, self._u_max)
        np.maximum(applied, self._u_min, out=applied)
        # A product is faster than a mask, whose branches are unpredictable. The product can be
        # -0, which adding 0 turns into 0.
        applied *= np.abs(command) >= self._least_effective_command
        applied += _ARRAY_OF_0
        # Equation (28), and the load, which is not in the paper.
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
        """Update limits and dead zones of the actuators after parameter values have changed."""
        u_min = self.numbers.u_min
        u_max = self.numbers.u_max
        self._half_range = np.array((u_max - u_min) / 2.0)
        self._least_effective_command = np.array(
            least_effective_command(self.numbers.dead_zone, u_min, u_max)
        )
        # In comparisons, an array of shape (n,) is faster than an array of one number.
        self._u_min = np.full(self._num_envs, u_min)
        self._u_max = np.full(self._num_envs, u_max)

    def _update_dynamics(self) -> None:
        """Update coefficients and drift factors to the present sample of each plant."""
        k = self._clock - self._starts  # the present sample of each plant's episode
        k_of_change = k // DRIFT_INTERVAL * DRIFT_INTERVAL  # the sample of the latest change
        factors = self._dynamics.factors(self.numbers, k_of_change)
        if self._parameters.drifts:
            self.factors = dict(zip(FACTORS, factors, strict=True))
        alpha, self._scale, self._load_gain = self._dynamics.coefficients(*factors)
        self._alpha = tuple(map(np.asarray, alpha))  # arrays, as for `_ARRAY_OF_0`
        samples_to_change = k_of_change + DRIFT_INTERVAL - k
        self._next_update = self._clock + int(samples_to_change.min())


class _InputResponse:
    """The response of n plants to past flows: the part B(z^-1) u_a(k-d) of the temperature.

    B is the polynomial of equation (28) of the paper, u_a the applied flow and d the delay, in
    samples. With a shortest possible delay of s samples, a flow cannot affect the temperatures
    of the next s samples. The responses to a block of s + 1 successive flows are therefore
    computed at once, after the last flow of the block, and then returned sample by sample.

    The array `_flows` has one row of applied flows per sample, the oldest sample first. The
    last rows of `_flows` are the block of flows that `add` fills. The first rows of `_flows`
    hold older flows, which plants with longer delays and the further coefficients of the
    polynomial B need.
    """

    def __init__(self, parameters: Parameters, num_envs: int) -> None:
        self._num_envs = num_envs
        self._beta = tuple(parameters.b)
        shortest, self._longest = map(int, parameters.range_of("delay"))  # d, samples
        self._block_rows = shortest + 1
        # Number of rows of `_flows` above the block of flows, with the older flows.
        self._older_rows = len(self._beta) - 1 + self._longest - shortest
        self._flows = np.zeros((self._older_rows + self._block_rows, num_envs))
        self._response = np.zeros((self._block_rows, num_envs))
        # Index of the next flow in the block of flows. The first block could begin at any row,
        # as all flows before k = 0 are 0. It has the flow at k = 0 alone.
        self._next_row = self._block_rows - 1
        # Used only if the delays of the plants differ. `_delayed_indices` selects, in the
        # flattened `_flows`, the flows to which each plant responds after the plant's own
        # delay, and `_delayed_flows` holds these flows.
        self._delays_differ = self._longest > shortest
        delayed_rows = len(self._beta) - 1 + self._block_rows
        self._delayed_flows = np.zeros((delayed_rows, num_envs))
        self._delayed_indices = np.zeros((delayed_rows, num_envs), np.intp)

    def reset(self, plants: NDArray[np.intp], delays: Values) -> None:
        """Begin an episode of the plants with the indices `plants`, with past flows of 0 t/h.

        `delays` holds the delays of the plants `plants` in samples, shape (len(plants),), or
        shape () for one delay of all plants.
        """
        self._flows[:, plants] = 0.0
        # What `add` returns until the present block of flows is full: flows of the new episode
        # have no effect before that.
        self._response[:, plants] = 0.0
        if self._delays_differ:
            # With a shorter delay, a plant responds to later flows, in later rows.
            first_rows = self._longest - delays.astype(np.intp)
            rows = np.arange(len(self._delayed_flows))[:, np.newaxis] + first_rows
            self._delayed_indices[:, plants] = rows * self._num_envs + plants

    def add(self, applied: Values) -> Values:
        """Store the applied flows u_a(k), and return the part of y(k+1) from past flows, degC.

        `applied` holds the flows u_a(k) of the plants in t/h, shape (n,). The returned
        response, shape (n,), is the part B(z^-1) u_a(k+1-d) of the temperatures y(k+1), with
        the polynomial B of equation (28) of the paper and the delay d. The caller must not
        modify the returned array.
        """
        self._flows[self._older_rows + self._next_row] = applied
        self._next_row += 1
        if self._next_row == self._block_rows:
            self._respond()
            self._next_row = 0
        # Computed when the latest block was full: no later flow changes it.
        response: Values = self._response[self._next_row]
        return response

    def _respond(self) -> None:
        """Compute the responses of the plants to a full block of flows, and drop old flows."""
        flows = self._flows
        if self._delays_differ:
            # "clip" is faster than a check of the indices, which are always valid.
            flows = flows.take(self._delayed_indices, out=self._delayed_flows, mode="clip")
        self._response[:] = 0.0
        for lag, beta in enumerate(self._beta):
            first_row = len(self._beta) - 1 - lag  # a further coefficient needs older flows
            self._response += beta * flows[first_row : first_row + self._block_rows]
        # The latest rows become the older flows of the next block.
        self._flows[: self._older_rows] = self._flows[self._block_rows :]
