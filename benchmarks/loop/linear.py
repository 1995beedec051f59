"""Describe the plant, and loops of a controller around the plant, as linear systems.

A plant has a step test and a model for each sample of an episode; a loop has a robustness.

Between the limits of the actuator (29) the plant is

    (28)  y(k) = sum_i alpha_i y(k-1-i) + sum_i beta_i u_a(k-d-1-i) + C xi(k) + A(1) w(k),

where w is the load, degC. The factors of gain and time constant, and their drifts, are part of
alpha and beta.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.polynomial.polynomial import polyadd, polyval
from numpy.typing import NDArray

from mptc_gym import Parameters
from mptc_gym.parameters import PLANT_NUMBERS, PlantNumbers
from mptc_gym.plant import DRIFT_INTERVAL, Dynamics

Array = NDArray[np.float64]

# Shares of the final value at which Smith's method reads a step response.
EARLY_LEVEL, LATE_LEVEL = 0.283, 0.632
SLOWEST_POLE = 1 - 1e-5  # of a plant that settles within the samples of a step test
TRANSIENT = 1e-5  # share of a transient that may remain at the end of a step test
FREQUENCIES = np.geomspace(1e-4, math.pi, 400)  # rad per sample, for the sensitivity
CIRCLE_POINTS = 1 << 14  # on the unit circle, to count unstable poles
LONGEST_DELAY = 1000  # samples; longer delays are not examined for stability
GRID = 24  # time constants that are tried before a bisection
PRECISION = 1e-5  # relative, of a time constant that is solved for


class LinearModel:
    """The coefficients of (28) and the limits of (29) in the step to sample k.

    Parameters
    ----------
    parameters
        The arguments of the environment.
    numbers
        The plant numbers: floats for one plant, or arrays of shape (plants,).
    k
        A sample; or, for one plant, several samples, shape (samples,).

    Attributes
    ----------
    alpha, beta
        alpha_i, and beta_i in degC per t/h, shapes (..., order of A) and (..., length of B).
        The dots stand for plants, or for samples, or for neither.
    load
        A(1), degC of y(k) for each degC of load, shape (...).
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
        """Steady-state gain B(1) / A(1), degC per t/h; infinite for an integrating plant."""
        with np.errstate(divide="ignore"):
            return np.asarray(self.beta.sum(axis=-1) / (1.0 - self.alpha.sum(axis=-1)))

    @property
    def limits(self) -> tuple[float, float]:
        """Lowest and highest flow of one plant, t/h; a dead zone makes 0 a possible flow."""
        flows = [self.numbers.u_min, self.numbers.u_max]
        if self.numbers.dead_zone > 0.0:
            flows.append(0.0)
        return min(flows), max(flows)

    @property
    def lag(self) -> int:
        """Samples from a flow of one plant to the first output that the flow can affect.

        If all coefficients of B are 0, it is as if the next coefficient were not 0.
        """
        first_nonzero = np.flatnonzero([*self.parameters.b, 1.0])[0]
        return int(self.numbers.delay) + 1 + int(first_nonzero)

    def impulse_response(self, samples: int) -> Array:
        """Return the effects of a flow of 1 t/h at j on y(j + d + 1), y(j + d + 2) and so on.

        They are in degC per t/h, of shape (..., samples). The coefficients are held constant.
        """
        response = np.zeros((*self.load.shape, samples))
        response[..., : self.beta.shape[-1]] = self.beta[..., :samples]
        for k in range(1, samples):
            for i in range(min(self.alpha.shape[-1], k)):
                response[..., k] += self.alpha[..., i] * response[..., k - 1 - i]
        return response

    def state_space(self) -> tuple[Array, Array]:
        """Return F, shape (..., size, size), and g, shape (size,): x(k) = F x(k-1) + g xi(k).

        The state x(k) consists of y(k), y(k-1), ..., xi(k), xi(k-1), ...; flows and load are
        left out.
        """
        c = self.parameters.c
        order = max(self.alpha.shape[-1], 1)
        size = order + len(c) - 1
        F = np.zeros((*self.load.shape, size, size)) + np.eye(size, k=-1)
        F[..., order : order + 1, :] = 0.0  # xi(k) is new
        F[..., 0, : self.alpha.shape[-1]] = self.alpha
        F[..., 0, order:] = c[1:]
        return F, np.isin(np.arange(size), (0, order)).astype(float)


def nominal(parameters: Parameters) -> LinearModel:
    """Return the model of the plant in the middle of all ranges, before any drift (k = 0)."""
    middle = {name: sum(parameters.range_of(name)) / 2 for name in PLANT_NUMBERS}
    return LinearModel(parameters, PlantNumbers(**middle), 0)


def step_test(parameters: Parameters) -> dict[str, float]:
    """Return what an engineer would read off the plant's response to a step of the flow.

    The time constant and the delay follow from the times at which the response reaches 28.3 %
    and 63.2 % of its final value: T = 1.5 (t_63 - t_28), and the delay is t_63 - T (C. L.
    Smith, "Digital Computer Process Control", 1972). As if read off a chart, the gain has four
    digits, the time constant three, and the delay is a whole number of samples; the delay
    includes the one sample that any input takes to show.

    Returns
    -------
    dict
        `gain`, degC per t/h, and `time_constant`, `delay` and `sampling_interval`, s: arguments
        of `PIController.simc` and `SmithPredictor`.

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
    """Return when a step response first reaches a level, samples, by linear interpolation."""
    k = int(np.argmax(response >= level))
    share = (level - response[k - 1]) / (response[k] - response[k - 1])
    return float(k - 1 + share)


class LinearController(Protocol):
    """A controller that is linear away from the dead zone and the limits."""

    def transfer(self) -> tuple[Array, Array]:
        """Return numerator and denominator from e, degC, to u, t/h.

        They are the coefficients of z^0, z^-1 and so on.
        """


@dataclass(frozen=True)
class LinearLoop:
    """A linear controller around a plant, away from the dead zone and the limits.

    A transfer function is a numerator and a denominator: coefficients of z^0, z^-1 and so on.
    """

    controller: tuple[Array, Array]  # from e, degC, to u, t/h
    plant: tuple[Array, Array]  # from u to y without the delay: B(z^-1) and A(z^-1) of (28)
    delay: int  # the plant's d, samples

    @classmethod
    def of(cls, controller: LinearController, plant: LinearModel) -> "LinearLoop":
        """Return the loop of a controller and one plant."""
        numerator = np.append(0.0, plant.beta)
        denominator = np.append(1.0, -plant.alpha)
        delay = round(plant.numbers.delay)
        return cls(controller.transfer(), (numerator, denominator), delay)

    def characteristic(self, delay: int) -> Array:
        """Return the polynomial in z^-1 whose roots are the inverse poles of the loop.

        `delay` is the plant's d, samples. The coefficients begin with that of z^0.
        """
        numerator, denominator = self.controller
        b, a = self.plant
        forward = np.append(np.zeros(delay), np.convolve(numerator, b))
        return np.asarray(polyadd(np.convolve(denominator, a), forward), np.float64)

    def largest_pole(self) -> float:
        """Return the largest modulus of the poles; the loop is stable if it is below 1."""
        return float(np.abs(np.roots(self.characteristic(self.delay))).max())

    def is_stable(self, delay: int) -> bool:
        """Return whether all poles lie inside the unit circle, with a delay d in samples.

        By the argument principle, the polynomial in z^-1 turns about 0 once for each pole
        outside the unit circle, while z^-1 goes around this circle once.
        """
        values = np.fft.fft(self.characteristic(delay), CIRCLE_POINTS)
        if not values.all():  # a pole on the circle
            return False
        turns = np.angle(np.roll(values, -1) / values).sum() / (2.0 * math.pi)
        return bool(round(turns) == 0)

    def sensitivity(self) -> float:
        """Return Ms, the largest magnitude of 1 / (1 + L); infinite for an unstable loop."""
        if not self.is_stable(self.delay):
            return math.inf
        inverse_z = np.exp(-1j * FREQUENCIES)
        open_loop = np.convolve(self.controller[1], self.plant[1])
        closed_loop = self.characteristic(self.delay)
        ratio = polyval(inverse_z, open_loop) / polyval(inverse_z, closed_loop)
        return float(np.abs(ratio).max())

    def stable_delays(self) -> tuple[int, int] | None:
        """Return the shortest and the longest delay d, samples, of a range of stable loops.

        The loop is stable with all delays of the range, which includes the plant's. The longest
        delay that is examined is `LONGEST_DELAY`. None is returned if the loop is unstable with
        the plant's delay.
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
    """Return the smallest time constant with which the Ms of a loop is at most a target, s.

    All slower time constants that were tried meet the target, too.

    Parameters
    ----------
    target
        The largest Ms that is allowed.
    make
        Returns the controller for a time constant, s. A larger one makes a more robust loop.
    plant
        One plant.
    slowest, fastest
        The largest and the smallest time constant that are examined, s. If `fastest` meets the
        target, it is returned.

    Raises
    ------
    ValueError
        If `slowest` does not meet the target.
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
