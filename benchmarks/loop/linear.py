"""Describe the plant, and the loop of a controller and the plant, as linear systems.

The functions do a step test on a plant, and compute how robust a loop is. The plant is equation
(28) of the paper with a load:

    y(k) = sum_i alpha_i y(k-1-i) + sum_i beta_i u_a(k-d-1-i) + C(z^-1) xi(k) + A(1) w(k),

where i counts from 0, y is the temperature (degC), u_a the flow that the actuator applies
(t/h), d the delay (samples), xi white noise (degC) and w the load (degC). The coefficients
alpha_i and beta_i are those of the polynomials A and B of equation (28), after the factors and
drifts of gain and time constant. Equation (29) of the paper is the actuator, with a dead zone
and limits.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.polynomial.polynomial import polyadd, polyval
from numpy.typing import NDArray

from mptc_gym import Parameters
from mptc_gym.plant.dynamics import DRIFT_INTERVAL, Dynamics
from mptc_gym.plant.parameters import PLANT_NUMBERS, PlantNumbers

Array = NDArray[np.float64]

# Places of the two parts of the load in a state vector: the piecewise constant part, which
# changes in steps, and the random walk.
LOAD_STEPS, LOAD_WALK = -2, -1
# Smith's method reads the times at which a step response reaches these shares of its final
# value. A lag with the time constant T reaches them after T / 3 and T.
EARLY_LEVEL, LATE_LEVEL = 0.283, 0.632
# Largest magnitude of a pole for which a step test is done: a step test would be too long for a
# slower plant.
SLOWEST_POLE = 1 - 1e-5
TRANSIENT = 1e-5  # share of the slowest transient that may remain at the end of a step test
# Frequencies at which the sensitivity function is computed, rad per sample; pi is the highest
# frequency of a sampled signal.
FREQUENCIES = np.geomspace(1e-4, math.pi, 400)
CIRCLE_POINTS = 1 << 14  # points on the unit circle with which unstable poles are counted
LONGEST_DELAY = 1000  # samples; longer delays are not examined for stability
GRID = 24  # number of time constants that `time_constant_for` tries before the bisection
PRECISION = 1e-5  # relative precision of the time constant that `time_constant_for` returns


class LinearModel:
    """One plant or several plants, equation (28) of the paper, as linear systems at one sample.

    The coefficients of a plant that drifts hold for the step from sample k - 1 to sample k.
    A model can also have one plant at several samples k. In the shapes below, the dots stand
    for the axis of the plants or of the samples, which is missing for one plant at one sample.

    Parameters
    ----------
    parameters
        The arguments of the environment.
    numbers
        Plant numbers, such as the delay: floats for one plant, or arrays of shape (plants,).
    k
        A sample; or, for one plant, several samples, shape (samples,).

    Attributes
    ----------
    alpha
        Factors of the temperatures y(k-1), y(k-2), ... in y(k), shape (..., order of A).
    beta
        Factors of the applied flows u_a(k-d-1), u_a(k-d-2), ... in y(k), degC per t/h, shape
        (..., length of B), where d is the delay in samples.
    load
        Factor A(1) of the load w(k) in y(k), without a unit, shape (...).
    """

    def __init__(
        self, parameters: Parameters, numbers: PlantNumbers[Any], k: int | NDArray[np.int64]
    ) -> None:
        dynamics = Dynamics(parameters)
        gain, time_constant = dynamics.factors(numbers, k // DRIFT_INTERVAL * DRIFT_INTERVAL)
        alpha, scale, load = dynamics.coefficients(gain, time_constant)
        shape = np.broadcast_shapes(np.shape(gain), np.shape(time_constant))
        self.parameters = parameters
        self.numbers = numbers
        self.alpha = np.empty((*shape, len(alpha)))
        for i, coefficient in enumerate(alpha):
            self.alpha[..., i] = coefficient
        self.beta: Array = np.broadcast_to(scale, shape)[..., np.newaxis] * np.array(
            parameters.b
        )
        self.load = np.broadcast_to(load, shape)

    @property
    def gain(self) -> Array:
        """Steady-state gain, degC per t/h, shape (...); infinite for an integrating plant.

        The gain is B(1) / A(1) with the polynomials A and B of equation (28) of the paper.
        """
        with np.errstate(divide="ignore"):
            return np.asarray(self.beta.sum(axis=-1) / (1.0 - self.alpha.sum(axis=-1)))

    @property
    def limits(self) -> tuple[float, float]:
        """Lowest and highest flow that the actuator of one plant can apply, t/h.

        If the actuator has a dead zone, the flow 0 is possible even where it is outside the
        range from `u_min` to `u_max`.
        """
        flows = [self.numbers.u_min, self.numbers.u_max]
        if self.numbers.dead_zone > 0.0:
            flows.append(0.0)
        return min(flows), max(flows)

    @property
    def lag(self) -> int:
        """Number of samples from a flow to the first output that the flow can affect.

        The model must have one plant. Leading zeros in the polynomial B of equation (28) of the
        paper make the lag longer. If all coefficients of B are 0, a further one is taken to be
        other than 0.
        """
        first_nonzero = np.flatnonzero([*self.parameters.b, 1.0])[0]
        return int(self.numbers.delay) + 1 + int(first_nonzero)

    def impulse_response(self, samples: int) -> Array:
        """Return the impulse response of the plants, degC per t/h, shape (..., samples).

        The first value is the effect of a flow of 1 t/h at one sample on the output d + 1
        samples later, where d is the delay of the plant in samples. The coefficients of the
        plant are taken to stay as they are. `samples` is the number of values.
        """
        response = np.zeros((*self.load.shape, samples))
        response[..., : self.beta.shape[-1]] = self.beta[..., :samples]
        for k in range(1, samples):
            for i in range(min(self.alpha.shape[-1], k)):
                response[..., k] += self.alpha[..., i] * response[..., k - 1 - i]
        return response

    @property
    def outputs_in_state(self) -> int:
        """Number of outputs y(k), y(k-1), ... at the start of the state of `state_space`."""
        return max(len(self.parameters.a) - 1, 1)

    def state_space(self) -> tuple[Array, Array]:
        """Return the matrices F and g of the state equation x(k) = F x(k-1) + g xi(k).

        The state x(k) consists of the latest outputs y(k), y(k-1), ... and the latest values
        xi(k), xi(k-1), ... of the white noise. The effects of flows and load are left out.

        Returns
        -------
        F : Array
            The state transition matrix, shape (..., size, size).
        g : Array
            The effect of the noise, elements 0 and 1, shape (size,).
        """
        c = self.parameters.c
        order = self.outputs_in_state
        size = order + len(c) - 1
        F = np.zeros((*self.load.shape, size, size)) + np.eye(size, k=-1)
        F[..., order : order + 1, :] = 0.0  # xi(k) is new
        F[..., 0, : self.alpha.shape[-1]] = self.alpha
        F[..., 0, order:] = c[1:]
        g = np.zeros(size)
        g[0] = 1.0
        g[order : order + 1] = 1.0  # empty if C = 1: the state then has no noise
        return F, g

    def state_space_with_load(self, stays: Array) -> tuple[Array, Array]:
        """Return the matrices F and E of the state equation x(k) = F x(k-1) + E v(k).

        The state x(k) is the state of `state_space`, followed by the two parts of the load,
        degC: the piecewise constant part at the place `LOAD_STEPS`, and the random walk at the
        place `LOAD_WALK`. The effects of flows are left out. The vector v(k) has three
        elements: the noise xi(k), the random change of the piecewise constant part, and the
        step of the random walk.

        Parameters
        ----------
        stays
            The mean of the piecewise constant part at sample k as a share of its value at
            sample k - 1, shape (...).

        Returns
        -------
        F : Array
            The state transition matrix, shape (..., size, size).
        E : Array
            The effects of v(k) on the state, shape (..., size, 3).
        """
        F_noise, g = self.state_space()
        size = len(g) + 2
        F = np.zeros((*self.load.shape, size, size))
        F[..., :LOAD_STEPS, :LOAD_STEPS] = F_noise
        F[..., LOAD_STEPS, LOAD_STEPS] = stays
        F[..., LOAD_WALK, LOAD_WALK] = 1.0
        F[..., 0, LOAD_STEPS] = self.load * stays
        F[..., 0, LOAD_WALK] = self.load
        E = np.zeros((*self.load.shape, size, 3))
        E[..., :LOAD_STEPS, 0] = g
        E[..., 0, 1:] = self.load[..., np.newaxis]
        E[..., LOAD_STEPS, 1] = 1.0
        E[..., LOAD_WALK, 2] = 1.0
        return F, E


def nominal(parameters: Parameters) -> LinearModel:
    """Return the model of the nominal plant, which is in the middle of all ranges of arguments.

    `parameters` are the arguments of the environment. If the plant drifts, the model is that of
    the sample k = 0.
    """
    middle = {name: sum(parameters.range_of(name)) / 2 for name in PLANT_NUMBERS}
    return LinearModel(parameters, PlantNumbers(**middle), 0)


def step_test(parameters: Parameters) -> dict[str, float]:
    """Return the gain, time constant and delay that an engineer reads off a step response.

    The flow steps on the nominal plant, without noise. With the times t_28 and t_63 at which
    the temperature has made 28.3 % and 63.2 % of its change, the time constant is
    T = 1.5 (t_63 - t_28), and the delay is t_63 - T (C. L. Smith, "Digital Computer Process
    Control", 1972). As if read off a chart, the gain is rounded to four digits, the time
    constant to three digits, and the delay to a whole number of samples. The delay is the time
    from a flow to the first output that the flow can affect.

    Parameters
    ----------
    parameters
        The arguments of the environment. The nominal plant is in the middle of all ranges.

    Returns
    -------
    dict
        `gain`, degC per t/h, and `time_constant`, `delay` and `sampling_interval`, s. The names
        are those of the arguments of `PIController.simc` and `SmithPredictor`.

    Raises
    ------
    ValueError
        If the plant reaches no new steady state, or if its gain is 0.
    """
    plant = nominal(parameters)
    interval = parameters.sampling_interval
    slowest_pole = float(np.abs(np.roots([1.0, *-plant.alpha])).max(initial=0.0))
    if slowest_pole > SLOWEST_POLE:
        raise ValueError(f"a must be of a stable plant for a step test, got {parameters.a}")
    if plant.gain == 0.0:
        raise ValueError(f"b must have a sum other than 0 for a gain, got {parameters.b}")
    settling = 0.0  # samples
    if slowest_pole:
        settling = math.log(TRANSIENT) / math.log(slowest_pole)
    # Twice as long, as transients of repeated poles last longer.
    samples = len(parameters.b) + 2 * math.ceil(settling) + 2
    # The response begins with the last sample at which the output stands still.
    response = np.append(0.0, plant.impulse_response(samples).cumsum())
    response /= response[-1]
    late = _time_of(LATE_LEVEL, response)
    time_constant = 1.5 * (late - _time_of(EARLY_LEVEL, response))
    # In samples; u(k) shows at y(k + 1) at the earliest.
    delay = max(1, round(round(plant.numbers.delay) + late - time_constant + 1.0))
    return {
        "gain": float(f"{plant.gain:.4g}"),
        "time_constant": float(f"{time_constant * interval:.3g}"),
        "delay": delay * interval,
        "sampling_interval": interval,
    }


def _time_of(level: float, response: Array) -> float:
    """Return the time at which a step response first reaches `level`, in samples.

    `response` has the step response at the samples 0, 1, ..., and begins below `level`. The
    time is found by linear interpolation between two samples.
    """
    k = int(np.argmax(response >= level))
    share = (level - response[k - 1]) / (response[k] - response[k - 1])
    return float(k - 1 + share)


class LinearController(Protocol):
    """A controller that is linear for commands outside the dead zone and within the limits."""

    def transfer(self) -> tuple[Array, Array]:
        """Return the transfer function from the error e (degC) to the command u (t/h).

        The result is a numerator and a denominator, each an array of the coefficients of z^0,
        z^-1, z^-2 and so on.
        """


@dataclass(frozen=True)
class LinearLoop:
    """The closed loop of a linear controller and a plant, without dead zone and limits.

    Attributes
    ----------
    controller : tuple of Array
        Numerator and denominator of the transfer function from the error e (degC) to the
        command u (t/h): coefficients of z^0, z^-1 and so on.
    plant : tuple of Array
        Numerator and denominator of the transfer function from u to the temperature y (degC)
        without the delay: the polynomials B and A of equation (28) of the paper, as
        coefficients of z^0, z^-1 and so on.
    delay : int
        The delay d of equation (28), samples.
    """

    controller: tuple[Array, Array]
    plant: tuple[Array, Array]
    delay: int

    @classmethod
    def of(cls, controller: LinearController, plant: LinearModel) -> "LinearLoop":
        """Return the closed loop of `controller` and `plant`, which must be a single plant."""
        numerator = np.append(0.0, plant.beta)
        denominator = np.append(1.0, -plant.alpha)
        delay = round(plant.numbers.delay)
        return cls(controller.transfer(), (numerator, denominator), delay)

    def characteristic(self, delay: int) -> Array:
        """Return the characteristic polynomial of the loop for any delay of the plant.

        The result has the coefficients of z^0, z^-1, z^-2 and so on. The poles of the loop are
        the values of z at which the polynomial is 0. `delay` is the delay d of the plant,
        samples.
        """
        numerator, denominator = self.controller
        b, a = self.plant
        forward = np.append(np.zeros(delay), np.convolve(numerator, b))
        return np.asarray(polyadd(np.convolve(denominator, a), forward), np.float64)

    def largest_pole(self) -> float:
        """Return the largest modulus of a pole of the loop; below 1, the loop is stable."""
        return float(np.abs(np.roots(self.characteristic(self.delay))).max())

    def is_stable(self, delay: int) -> bool:
        """Return whether the loop is stable if the delay d of the plant is `delay` samples.

        A loop is stable if all poles lie inside the unit circle. By the argument principle,
        while z^-1 goes around the unit circle once, the characteristic polynomial turns about 0
        once for each pole outside the circle.
        """
        values = np.fft.fft(self.characteristic(delay), CIRCLE_POINTS)
        if not values.all():  # a pole on the circle
            return False
        turns = np.angle(np.roll(values, -1) / values).sum() / (2.0 * math.pi)
        return bool(round(turns) == 0)

    def sensitivity(self) -> float:
        """Return the maximum sensitivity Ms of the loop; infinite for an unstable loop.

        Ms is the largest magnitude of the sensitivity function 1 / (1 + L) over the
        `FREQUENCIES`, where L is the open loop of controller and plant.
        """
        if not self.is_stable(self.delay):
            return math.inf
        inverse_z = np.exp(-1j * FREQUENCIES)
        open_loop = np.convolve(self.controller[1], self.plant[1])
        closed_loop = self.characteristic(self.delay)
        ratio = polyval(inverse_z, open_loop) / polyval(inverse_z, closed_loop)
        return float(np.abs(ratio).max())

    def stable_delays(self) -> tuple[int, int] | None:
        """Return the shortest and the longest delay of the plant with which the loop is stable.

        The delays are values of the delay d of equation (28) of the paper, samples. The loop is
        stable with all delays between the two, among which is the plant's own delay. Delays
        above `LONGEST_DELAY` are not examined. The result is None if the loop is unstable with
        the plant's own delay.
        """
        if not self.is_stable(self.delay):
            return None
        shortest = longest = self.delay
        while shortest > 0 and self.is_stable(shortest - 1):
            shortest -= 1
        while longest < LONGEST_DELAY and self.is_stable(longest + 1):
            longest += 1
        return shortest, longest


def time_constant_for(
    target: float,
    make: Callable[[float], LinearController],
    plant: LinearModel,
    slowest: float,
    fastest: float,
) -> float:
    """Return the smallest time constant with which a loop is robust enough, s.

    A loop is robust enough if Ms, its maximum sensitivity, is at most `target`. All larger time
    constants that were tried make the loop robust enough, too.

    Parameters
    ----------
    target
        The largest Ms that is allowed.
    make
        Takes a time constant, s, and returns a controller with this time constant. A larger
        time constant makes the loop more robust.
    plant
        The model of a single plant.
    slowest, fastest
        The largest and the smallest time constant that are tried, s. If the loop is robust
        enough with all time constants that are tried, the result is `fastest`.

    Raises
    ------
    ValueError
        If the loop is not robust enough with the time constant `slowest`.
    """

    def meets_target(time_constant: float) -> bool:
        return LinearLoop.of(make(time_constant), plant).sensitivity() <= target

    grid: list[float] = np.geomspace(slowest, fastest, GRID).tolist()
    meets = [meets_target(time_constant) for time_constant in grid]
    if all(meets):
        return fastest
    first_miss = meets.index(False)
    if first_miss == 0:
        raise ValueError(
            f"no time constant up to {slowest:g} s gives the loop an Ms of {target:g} or less"
        )
    slow, fast = grid[first_miss - 1], grid[first_miss]
    while slow / fast > 1.0 + PRECISION:
        middle = math.sqrt(slow * fast)
        if meets_target(middle):
            slow = middle
        else:
            fast = middle
    return slow
