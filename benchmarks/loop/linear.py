"""Describe the plant, and the closed loop of a controller and the plant, as linear systems.

The plant is equation (28) of the paper with a load, y(k) = sum_i alpha_i y(k-1-i) + sum_i
beta_i u_a(k-d-1-i) + C(z^-1) xi(k) + A(1) w(k), where the index i counts from 0, y is the
temperature (degC), u_a the flow that the actuator applies (t/h), d the delay (samples), xi
white noise (degC) and w the load (degC). The coefficients alpha_i and beta_i are -a_(i+1) and
b_i of the polynomials A and B, changed by the factors and the drifts of the gain and of the
time constant.
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.polynomial.polynomial import polyadd
from numpy.typing import NDArray

from agents import PIController
from mptc_gym import Parameters
from mptc_gym.plant.dynamics import DRIFT_INTERVAL, Dynamics
from mptc_gym.plant.parameters import PLANT_NUMBERS, PlantNumbers, slowest_pole

Array = NDArray[np.float64]

# Indices of the two parts of the load in a state vector: the piecewise constant part, which
# changes in steps, and the random walk.
LOAD_STEPS, LOAD_WALK = -2, -1
# Smith's method reads the times at which a step response reaches these shares of its final
# value. A lag with the time constant T reaches the two shares after T / 3 and T.
EARLY_LEVEL, LATE_LEVEL = 0.283, 0.632
DOUBLINGS = 22  # 2^22 samples are longer than any transient of a plant that `step_test` takes
ROUNDING = 1e-12  # largest rounding error of A(1), divided by the sum of the magnitudes of A
# Maximum sensitivity Ms of the control loop, from which a controller's time constant is chosen.
# The time constant of the tuning rule SIMC leads to an Ms of 1.56.
ROBUSTNESS = 1.6
# Largest closed-loop time constant that a tuning rule tries, divided by the sum of the plant's
# time constant and delay.
SLOWEST_LOOP = 30.0
# Largest half period of the set point that `unfit` considers, half of the longest run, samples.
LONGEST_HOLD = 600
# Part of half a period of the set point that the delay and the time constant of a plant should
# take. Those of the paper's plant take a tenth.
FITTING_PART = 0.2
# Largest magnitude of a plant's pole for which `step_test` does a step test. A step test of a
# slower plant would be too long.
SLOWEST_POLE = 1 - 1e-5
REMAINING_TRANSIENT = 1e-5  # share of a transient that remains after a step test
# Frequencies at which a loop is computed, rad per sample: those of a grid that is dense at low
# frequencies, and `POINTS_PER_TURN` in each turn of z^-n, where n is the order of the loop. The
# grid is refined where the characteristic polynomial turns around 0 by more than
# `LARGEST_TURN`, rad, from one frequency to the next: between two other frequencies, the
# polynomial comes closer to 0 than at both of them by 2 % at most.
LOW_FREQUENCIES = np.append(np.geomspace(1e-7, 1e-4, 100), np.geomspace(1e-4, math.pi, 400))
POINTS_PER_TURN = 8
LARGEST_TURN = 0.3
# Largest number of times that an interval of the grid is halved, if a pole lies on the circle.
MOST_REFINEMENTS = 40
TIME_CONSTANTS_TRIED = 24  # number of time constants before the bisection
PRECISION = 1e-5  # relative precision of the time constant that `time_constant_for` returns


class LinearModel:
    """The coefficients of the linear equation (28) of the paper for one or several plants.

    A model has several plants at one sample k, or one plant at several samples k, or one plant
    at one sample. The coefficients of a plant that drifts hold for the step from sample k - 1
    to sample k. In the shapes of arrays, three dots stand for the axis of the plants or of the
    samples, which the arrays of one plant at one sample do not have.

    Parameters
    ----------
    parameters
        Arguments of the environment.
    numbers
        Parameter values of the plants, such as the delay: floats for one plant, or arrays of
        shape (plants,).
    k
        Number of the sample; or, for one plant, numbers of several samples, shape (samples,).

    Attributes
    ----------
    alpha
        Factors of the temperatures y(k-1), y(k-2), ... in the equation of y(k), shape (...,
        order of A).
    beta
        Factors of the applied flows u_a(k-d-1), u_a(k-d-2), ... in the equation of y(k), degC
        per t/h, shape (..., length of B), where d is the delay in samples.
    load_factor
        Factor A(1) of the load w(k) in the equation of y(k), without a unit, shape (...).
    """

    def __init__(
        self, parameters: Parameters, numbers: PlantNumbers[Any], k: int | NDArray[np.int64]
    ) -> None:
        dynamics = Dynamics(parameters)
        # The factors of a plant that drifts are constant for `DRIFT_INTERVAL` samples.
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
        self.load_factor = np.broadcast_to(load, shape)

    @property
    def gain(self) -> Array:
        """Steady-state gain B(1) / A(1) of each plant or at each sample, degC per t/h.

        The gain of an integrating plant is infinite, with the sign of B(1). A plant also counts
        as integrating if A(1) is as small as a rounding error.
        """
        at_1 = 1.0 - self.alpha.sum(axis=-1)
        is_integrator = np.abs(at_1) < ROUNDING * (1.0 + np.abs(self.alpha).sum(axis=-1))
        with np.errstate(divide="ignore"):
            return np.asarray(self.beta.sum(axis=-1) / np.where(is_integrator, 0.0, at_1))

    @property
    def noise_power(self) -> float:
        """Variance of the output of one stable plant in white noise xi with the variance 1."""
        F, g = self.state_space()
        P = np.outer(g, g)
        power = F
        for _ in range(DOUBLINGS):  # P is the sum of 2^i terms F^j g g' F'^j.
            P = P + power @ P @ power.T
            power = power @ power
        return float(P[0, 0])  # of the output, the first element of the state

    @property
    def limits(self) -> tuple[float, float]:
        """Lowest and highest flow that the actuator of one plant can apply, t/h.

        If the actuator has a dead zone, the actuator can apply a flow of 0 t/h even if 0 t/h
        lies outside the range from `u_min` to `u_max`.
        """
        flows = [self.numbers.u_min, self.numbers.u_max]
        if self.numbers.dead_zone > 0.0:
            flows.append(0.0)
        return min(flows), max(flows)

    @property
    def lag(self) -> int:
        """Number of samples from a flow to the first output that the flow can affect.

        By equation (28) of the paper, a flow at sample j affects the output y(j + d + 1) at the
        earliest, where d is the plant's delay. So the lag of a plant with the delay d is d + 1,
        plus the number of leading zeros among the coefficients of the polynomial B. The model
        must have one plant.
        """
        # The appended 1 is the first nonzero number if all coefficients of B are 0.
        first_nonzero = np.flatnonzero([*self.parameters.b, 1.0])[0]
        return int(self.numbers.delay) + 1 + int(first_nonzero)

    @property
    def slowest_pole(self) -> float:
        """Largest magnitude of a pole of one plant; 0 for a plant without poles."""
        return abs(slowest_pole([1.0, *-self.alpha]))

    def impulse_response(self, samples: int) -> Array:
        """Return the impulse response of each plant, degC per t/h, shape (..., samples).

        The first value is the effect of a flow of 1 t/h at one sample on the output d + 1
        samples later, where d is the delay of the plant in samples. The impulse response is
        computed without drift of the plant. In the shape (..., samples), the dots stand for the
        axis of the plants.
        """
        response = np.zeros((*self.load_factor.shape, samples))
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
        xi(k), xi(k-1), ... of the white noise. The state equation leaves out the effects of
        flows and load.

        Returns
        -------
        F : Array
            State transition matrix, for each plant or sample, shape (..., size, size), where
            size is the length of the state.
        g : Array
            Effect of the noise xi(k) on each element of the state, shape (size,).
        """
        c = self.parameters.c
        order = self.outputs_in_state
        size = order + len(c) - 1
        # Row 0 is equation (28); the other rows move outputs and noise on by a sample.
        F = np.zeros((*self.load_factor.shape, size, size)) + np.eye(size, k=-1)
        xi_row = slice(order, order + 1)  # the row of xi(k); no row if C = 1
        F[..., xi_row, :] = 0.0  # xi(k) does not depend on x(k-1)
        F[..., 0, : self.alpha.shape[-1]] = self.alpha
        F[..., 0, order:] = c[1:]
        g = np.zeros(size)
        g[0] = 1.0
        g[xi_row] = 1.0
        return F, g

    def state_space_with_load(self, no_jump_probability: Array) -> tuple[Array, Array]:
        """Return the matrices F and E of the state equation x(k) = F x(k-1) + E v(k).

        The state x(k) is the state of `state_space`, followed by the two parts of the load,
        degC: the piecewise constant part at the index `LOAD_STEPS`, and the random walk at the
        index `LOAD_WALK`. The vector v(k) has three elements: the noise xi(k); the piecewise
        constant part minus its expected value, given x(k-1); and the step of the random walk.
        The state equation leaves out the effects of flows.

        Parameters
        ----------
        no_jump_probability
            Probability that the piecewise constant part of the load does not jump at sample k,
            a number for each plant or sample. A jump leads to a level with the mean 0, so the
            mean of the piecewise constant part is multiplied by the probability of no jump at
            sample k.

        Returns
        -------
        F : Array
            State transition matrix, for each plant or sample, shape (..., size, size), where
            size is the length of the state.
        E : Array
            Effects of the three elements of v(k) on each element of the state, shape (...,
            size, 3).
        """
        F_noise, g = self.state_space()
        size = len(g) + 2
        F = np.zeros((*self.load_factor.shape, size, size))
        F[..., :LOAD_STEPS, :LOAD_STEPS] = F_noise
        F[..., LOAD_STEPS, LOAD_STEPS] = no_jump_probability
        F[..., LOAD_WALK, LOAD_WALK] = 1.0
        # y(k) depends on the load w(k), whose expected parts follow from x(k-1).
        F[..., 0, LOAD_STEPS] = self.load_factor * no_jump_probability
        F[..., 0, LOAD_WALK] = self.load_factor
        E = np.zeros((*self.load_factor.shape, size, 3))
        E[..., :LOAD_STEPS, 0] = g
        E[..., 0, 1:] = self.load_factor[..., np.newaxis]
        E[..., LOAD_STEPS, 1] = 1.0
        E[..., LOAD_WALK, 2] = 1.0
        return F, E


def nominal(parameters: Parameters) -> LinearModel:
    """Return the model of the nominal plant, which is in the middle of all ranges of arguments.

    `parameters` are the arguments of the environment. If the plant drifts, the model has the
    plant's coefficients at sample k = 0.
    """
    middle = {name: sum(parameters.range_of(name)) / 2 for name in PLANT_NUMBERS}
    return LinearModel(parameters, PlantNumbers(**middle), 0)


def step_test(parameters: Parameters) -> dict[str, float]:
    """Return the gain, time constant and delay that an engineer reads off a step response.

    The step response is the temperature of the nominal plant after a step of the flow, without
    noise. If the temperature has made 28.3 % and 63.2 % of its change at the times t_28 and
    t_63, the time constant is T = 1.5 (t_63 - t_28), and the dead time is t_63 - T (Cecil
    Smith, "Digital Computer Process Control", 1972). The returned delay is the dead time plus
    one sample, since a flow without dead time affects the next output. As if read off a chart,
    the gain is rounded to four digits, the time constant to three digits, and the delay to a
    whole number of samples, at least one.

    Parameters
    ----------
    parameters
        Arguments of the environment, some of which may be ranges. The nominal plant is in the
        middle of all ranges.

    Returns
    -------
    dict
        `gain`, degC per t/h, and `time_constant`, `delay` and `sampling_interval`, s, which
        `PIController.simc` and `SmithPredictor` take as arguments.

    Raises
    ------
    ValueError
        If the plant reaches no new steady state after a step, or if the gain of the plant is 0.
    """
    plant = nominal(parameters)
    interval = parameters.sampling_interval
    if plant.slowest_pole > SLOWEST_POLE:
        raise ValueError(
            f"a must be a polynomial of a stable plant for a step test, got {parameters.a}"
        )
    if plant.gain == 0.0:
        raise ValueError(
            f"b must have coefficients whose sum is not 0 for a step test, got {parameters.b}"
        )
    settling_time = 0.0  # samples
    if plant.slowest_pole > 0.0:
        settling_time = math.log(REMAINING_TRANSIENT) / math.log(plant.slowest_pole)
    # The test lasts twice the settling time, since transients of repeated poles last longer.
    samples = len(parameters.b) + 2 * math.ceil(settling_time) + 2
    # The response begins with the last sample before the output can react.
    response = np.append(0.0, plant.impulse_response(samples).cumsum())
    response /= response[-1]  # the final value, as the transient has died away
    late_time = _time_of(LATE_LEVEL, response)  # samples
    early_time = _time_of(EARLY_LEVEL, response)
    time_constant = 1.5 * (late_time - early_time)
    # A flow affects the next output at the earliest.
    delay = round(plant.numbers.delay) + late_time - time_constant + 1.0
    return {
        "gain": float(f"{plant.gain:.4g}"),
        "time_constant": float(f"{time_constant * interval:.3g}"),
        "delay": max(1, round(delay)) * interval,
        "sampling_interval": interval,
    }


def describe(parameters: Parameters) -> str:
    """Return a line on a plant, with the numbers of a step test and of a data sheet."""
    test = step_test(parameters)
    low, high = parameters.range_of("dead_zone")
    dead_zone = f"{low:g}" if low == high else f"{low:g} to {high:g}"
    return (
        f"Plant: gain {test['gain']:.3g} °C per t/h, time constant "
        f"{test['time_constant']:.3g} s, delay {test['delay']:.4g} s, dead zone {dead_zone} "
        f"t/h, limits {parameters.u_min:g} to {parameters.u_max:g} t/h, "
        f"sampling interval {parameters.sampling_interval:g} s"
    )


def unfit(parameters: Parameters) -> str:
    """Return a sentence that says why a plant is not for these commands; "" if it is.

    The commands tune controllers by a step test, and compare them with an idle valve in runs of
    a fixed length. So the nominal plant needs a steady state, and must reach it within half a
    period of the set point. A flow within the limits must bring the temperature nearer to a
    constant set point.
    """
    plant = nominal(parameters)
    polynomials = f"a={list(parameters.a)}, b={list(parameters.b)}"
    if np.isinf(plant.gain):
        return f"the plant integrates: its temperature has no steady state, got {polynomials}"
    if plant.slowest_pole > SLOWEST_POLE:
        return f"the plant is not stable, or too slow for a step test, got {polynomials}"
    if plant.gain == 0.0:
        return f"the gain of the plant is 0, got {polynomials}"
    if plant.slowest_pole == 0.0:
        return f"the plant is static: it has no time constant, got {polynomials}"
    test = step_test(parameters)
    interval = parameters.sampling_interval
    samples = (test["time_constant"] + test["delay"]) / interval
    half_period = min(parameters.setpoint_period // 2, LONGEST_HOLD)
    if samples > half_period:
        # With this interval, delay and time constant take `FITTING_PART` of half a period.
        fitting = float(f"{interval * samples / (FITTING_PART * half_period):.2g}")
        return (
            f"the plant is too slow for a set point that changes every {half_period} samples: "
            f"its delay and time constant are {samples:,.0f} samples of {interval:g} s "
            f"together; use a sampling_interval of {fitting:g} s, with a, b, c and delay for "
            "this interval"
        )
    slowest = SLOWEST_LOOP * (test["time_constant"] + test["delay"])
    controller = PIController.simc(closed_loop_time_constant=slowest, **test)
    if LinearLoop.of(controller, plant).sensitivity() > ROBUSTNESS:
        return (
            f"the plant resonates: no PI controller of a tuning rule gives the loop a maximum "
            f"sensitivity Ms of {ROBUSTNESS:g} or less, got {polynomials}"
        )
    if isinstance(parameters.setpoint, float):
        steady = np.array([parameters.u_min, parameters.u_max]) * plant.gain
        if (steady * parameters.setpoint < 0.0).all():
            return (
                f"no flow from u_min={parameters.u_min:g} to u_max={parameters.u_max:g} t/h "
                f"brings the temperature nearer to the set point of {parameters.setpoint:g} °C"
            )
    return ""


def _time_of(level: float, response: Array) -> float:
    """Return the time at which a step response first reaches a level, in samples.

    `response` has the step response at the samples 0, 1, ..., in the unit of `level`, and is
    interpolated linearly between samples. The first value of `response` must be below `level`.
    """
    k = int(np.argmax(response >= level))
    share = (level - response[k - 1]) / (response[k] - response[k - 1])
    return float(k - 1 + share)


@runtime_checkable
class LinearController(Protocol):
    """The interface of a controller with a linear transfer function."""

    def transfer(self) -> tuple[Array, Array]:
        """Return the transfer function from the error e (degC) to the command u (t/h).

        The transfer function is a pair, numerator and denominator, each an array of the
        coefficients of z^0, z^-1, z^-2 and so on.
        """


@dataclass(frozen=True)
class LinearLoop:
    """The closed loop of a linear controller and a plant, without dead zone and limits.

    Attributes
    ----------
    denominator : Array
        Denominator of the transfer function from the error e to the temperature y, with the
        delay of the plant: coefficients of z^0, z^-1 and so on.
    characteristic : Array
        Characteristic polynomial, which is the numerator plus the denominator of the transfer
        function: coefficients of z^0, z^-1 and so on. The zeros of the characteristic
        polynomial in z are the poles of the loop.
    """

    denominator: Array
    characteristic: Array

    @classmethod
    def of(cls, controller: LinearController, plant: LinearModel) -> "LinearLoop":
        """Return the closed loop of `controller` and `plant`, which must be a single plant."""
        controller_numerator, controller_denominator = controller.transfer()
        # The coefficients of B begin at z^-1, since a flow affects the next output at the
        # earliest, and the delay of the plant adds further zeros.
        zeros = np.zeros(round(plant.numbers.delay) + 1)
        numerator = np.convolve(controller_numerator, np.append(zeros, plant.beta))
        denominator = np.convolve(controller_denominator, np.append(1.0, -plant.alpha))
        return cls(denominator, np.asarray(polyadd(denominator, numerator)))

    def largest_pole(self) -> float:
        """Return the largest magnitude of a pole of the loop; below 1, the loop is stable."""
        return float(np.abs(np.roots(self.characteristic)).max())

    def is_stable(self) -> bool:
        """Return whether the loop is stable: whether all poles have magnitudes below 1."""
        return math.isfinite(self.sensitivity())

    def sensitivity(self) -> float:
        """Return the maximum sensitivity Ms of the loop; infinite for an unstable loop.

        Ms is the largest magnitude of the sensitivity function 1 / (1 + L) over all
        frequencies, where L is the transfer function from the error to the temperature. While
        z^-1 goes around the upper half of the unit circle, the characteristic polynomial turns
        around 0 by half a turn for each pole outside the unit circle (argument principle).
        """
        frequencies, characteristic = self._on_refined_grid()
        if not characteristic.all():  # A pole lies on the circle.
            return math.inf
        half_turns = _turns(characteristic).sum() / math.pi
        if round(half_turns) != 0:  # the number of poles outside the unit circle
            return math.inf
        denominator = _values_on_circle(self.denominator, frequencies)
        return float(np.abs(denominator / characteristic).max())

    def _on_refined_grid(self) -> tuple[Array, NDArray[np.complex128]]:
        """Return frequencies from 0 to pi, rad per sample, and the characteristic polynomial.

        From each frequency to the next, the characteristic polynomial turns around 0 by at most
        `LARGEST_TURN`, unless a pole lies on the unit circle.
        """
        # From the frequency 0 to pi, z^-n makes n / 2 turns, for the order n of the loop. With
        # `LOW_FREQUENCIES`, the grid is dense at low frequencies, where slow poles lie.
        points = POINTS_PER_TURN * len(self.characteristic) // 2
        grid = np.union1d(np.linspace(0.0, math.pi, points + 1), LOW_FREQUENCIES)
        values = _values_on_circle(self.characteristic, grid)
        for _ in range(MOST_REFINEMENTS):
            wide = np.flatnonzero(np.abs(_turns(values)) > LARGEST_TURN)
            if len(wide) == 0:
                break
            middles = (grid[wide] + grid[wide + 1]) / 2.0
            grid = np.insert(grid, wide + 1, middles)
            new_values = _values_on_circle(self.characteristic, middles)
            values = np.insert(values, wide + 1, new_values)
        return grid, values


def _turns(values: NDArray[np.complex128]) -> Array:
    """Return the angles from each complex number to the next, rad, from -pi to pi."""
    return np.asarray(np.angle(values[1:] * values[:-1].conj()))


def _values_on_circle(polynomial: Array, frequencies: Array) -> NDArray[np.complex128]:
    """Return the values of a polynomial in z^-1 at z = exp(i frequency), in rad per sample.

    `polynomial` has the coefficients of z^0, z^-1 and so on, most of which are 0 if the delay
    is long.
    """
    powers = np.flatnonzero(polynomial)
    values: NDArray[np.complex128] = (
        np.exp(-1j * np.outer(frequencies, powers)) @ polynomial[powers]
    )
    return values


def time_constant_for(
    target: float,
    make: Callable[[float], LinearController],
    plant: LinearModel,
    slowest: float,
    fastest: float,
) -> float:
    """Return the smallest time constant of a controller with which a loop is robust enough, s.

    A loop is robust enough if the maximum sensitivity Ms of the loop is at most `target`. The
    search tries time constants from the largest to the smallest, and stops at the first time
    constant with which the loop is not robust enough.

    Parameters
    ----------
    target
        Largest allowed maximum sensitivity Ms.
    make
        Function that takes a time constant, s, and returns a controller. A larger time constant
        must make the loop more robust.
    plant
        Model of a single plant.
    slowest, fastest
        Largest and smallest time constant that the search tries, s. If the loop is robust
        enough with all tried time constants, `fastest` is returned.

    Raises
    ------
    ValueError
        If the loop is not robust enough with the time constant `slowest`.
    """

    def meets_target(time_constant: float) -> bool:
        return LinearLoop.of(make(time_constant), plant).sensitivity() <= target

    tried: list[float] = np.geomspace(slowest, fastest, TIME_CONSTANTS_TRIED).tolist()
    robust = list(itertools.takewhile(meets_target, tried))
    if not robust:
        raise ValueError(
            f"no time constant up to {slowest:g} s gives the loop a maximum sensitivity Ms of "
            f"{target:g} or less"
        )
    if len(robust) == len(tried):
        return fastest
    # The last time constant that is robust enough, and the first that is not.
    slow, fast = robust[-1], tried[len(robust)]
    while slow / fast > 1.0 + PRECISION:
        middle = math.sqrt(slow * fast)
        if meets_target(middle):
            slow = middle
        else:
            fast = middle
    return slow
