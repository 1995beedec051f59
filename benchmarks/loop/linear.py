"""Describe the plant, and loops around it, as linear systems.

Of the plant: its step test and time-varying course. Of a loop: how robust it is.

Between the limits of the actuator (29) the plant is

    (28)  y(k) = sum_i alpha_i y(k-1-i) + sum_i beta_i u_a(k-d-1-i) + C xi(k) + A(1) w(k),

where w is the load. Gain and time-constant factors and their drifts are part of alpha and beta.
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

LEVELS = 0.283, 0.632  # of a step response, which time constant and delay are read off
SLOWEST = 1 - 1e-5  # pole of a plant that settles soon enough for a step test
FREQUENCIES = np.geomspace(1e-4, math.pi, 400)  # of the sensitivity, rad per sample
CIRCLE = 1 << 14  # points on the unit circle at which unstable poles are counted
LONGEST_DELAY = 1000  # samples; the longest for which the stability of a loop is examined


class LinearModel:
    """(28) and (29) in the step to sample k.

    The plant numbers are floats for one plant, or arrays for many; k is a single sample or, for
    one plant, the samples of an episode. `alpha` and `beta` have the shapes (..., order of A)
    and (..., length of B), and `load`, A(1), has the shape (...).
    """

    def __init__(
        self, parameters: Parameters, numbers: PlantNumbers[Any], k: int | NDArray[np.int64]
    ) -> None:
        dynamics = Dynamics(parameters)
        gain, time_constant = dynamics.factors(numbers, k // DRIFT_INTERVAL * DRIFT_INTERVAL)
        alpha, scale, load = dynamics.coefficients(gain, time_constant)
        shape = np.broadcast_shapes(np.shape(gain), np.shape(time_constant))
        self.parameters, self.numbers = parameters, numbers
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
        """Lowest and highest flow of one plant, t/h, counting 0 if there is a dead zone."""
        flows = [self.numbers.u_min, self.numbers.u_max]
        flows += [0.0] if self.numbers.dead_zone > 0.0 else []
        return min(flows), max(flows)

    @property
    def lag(self) -> int:
        """Samples from a flow to the first output that it can affect."""
        shows = np.flatnonzero([*self.parameters.b, 1.0])
        return int(self.numbers.delay) + 1 + int(shows[0])

    def impulse_response(self, samples: int) -> Array:
        """Return the effect of 1 t/h at j on y(j + d + 1), ..., degC per t/h, (..., samples).

        The coefficients are held constant.
        """
        response = np.zeros((*self.load.shape, samples))
        response[..., : self.beta.shape[-1]] = self.beta[..., :samples]
        for k in range(1, samples):
            for i in range(min(self.alpha.shape[-1], k)):
                response[..., k] += self.alpha[..., i] * response[..., k - 1 - i]
        return response

    def state_space(self) -> tuple[Array, Array]:
        """Return F, shape (..., size, size), and g, shape (size,): x(k) = F x(k-1) + g xi(k).

        The state x is y(k), y(k-1), ..., xi(k), xi(k-1), ..., driven by noise alone.
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
    """Return the model of a plant: ranges at their midpoints, drifts at k = 0."""
    middle = {name: sum(parameters.range_of(name)) / 2 for name in PLANT_NUMBERS}
    return LinearModel(parameters, PlantNumbers(**middle), 0)


def step_test(parameters: Parameters) -> dict[str, float]:
    """Return what an engineer would read off the plant's response to a step of the flow.

    The time constant and the delay follow from the times at which the response reaches 28.3 %
    and 63.2 % of its final value: T = 1.5 (t_63 - t_28), and the delay is t_63 - T (C. L.
    Smith, "Digital Computer Process Control", 1972). As if read off a chart, the gain has four
    digits, the time constant three, and the delay is a whole number of samples, with the one
    that any input takes to show. A ValueError is raised if the plant reaches no new steady
    state, or if its gain is 0.

    These are arguments of `PIController.simc` and `SmithPredictor`: degC per t/h, and s.
    """
    plant, interval = nominal(parameters), parameters.sampling_interval
    slowest = float(np.abs(np.roots([1.0, *-plant.alpha])).max(initial=0.0))
    if slowest > SLOWEST:
        raise ValueError(f"a must be of a stable plant for a step test, got {parameters.a}")
    if plant.gain == 0.0:
        raise ValueError(f"b must have a sum other than 0 for a gain, got {parameters.b}")
    # Until 1e-5 of a transient remains; and twice as long, as those of repeated poles are.
    settling = math.log(1e-5) / math.log(slowest) if slowest else 0.0
    samples = len(parameters.b) + 2 * math.ceil(settling) + 2
    # From the last sample on at which the output stands still.
    response = np.append(0.0, plant.impulse_response(samples).cumsum())
    response /= response[-1]
    first = [int(np.argmax(response >= level)) for level in LEVELS]
    # When it first reaches the levels, in samples, by linear interpolation.
    early, late = (
        k - 1 + (level - response[k - 1]) / (response[k] - response[k - 1])
        for k, level in zip(first, LEVELS, strict=True)
    )
    time_constant = 1.5 * (late - early)
    # In samples, u(k) shows at y(k + 1) at the earliest.
    delay = max(1, round(round(plant.numbers.delay) + late - time_constant + 1.0))
    return {
        "gain": float(f"{plant.gain:.4g}"),
        "time_constant": float(f"{time_constant * interval:.3g}"),
        "delay": delay * interval,
        "sampling_interval": interval,
    }


class LinearController(Protocol):
    """A controller that is linear away from the dead zone and the limits."""

    def transfer(self) -> tuple[Array, Array]:
        """Return the transfer function from e to u: coefficients of z^0, z^-1 and so on."""


@dataclass(frozen=True)
class LinearLoop:
    """A linear controller around a plant, away from the dead zone and the limits.

    `controller` and `plant` are transfer functions, from e to u in t/h and from u to y in degC:
    the coefficients of numerator and denominator, of z^0, z^-1 and so on. That of the plant is
    B(z^-1) / A(z^-1) of (28). `delay`, d, is in samples.
    """

    controller: tuple[Array, Array]
    plant: tuple[Array, Array]
    delay: int

    @classmethod
    def of(cls, controller: LinearController, plant: LinearModel) -> "LinearLoop":
        """Return the loop of a controller and one plant."""
        numerator = np.append(0.0, plant.beta)
        denominator = np.append(1.0, -plant.alpha)
        delay = round(plant.numbers.delay)
        return cls(controller.transfer(), (numerator, denominator), delay)

    def characteristic(self, delay: int) -> Array:
        """Return the polynomial in z^-1 whose roots are the inverse poles, with a delay d."""
        up, down = self.controller
        b, a = self.plant
        forward = np.convolve(up, b)
        late = np.append(np.zeros(delay), forward)
        return np.asarray(polyadd(np.convolve(down, a), late), np.float64)

    def is_stable(self, delay: int) -> bool:
        """Return whether all poles lie inside the unit circle, with a delay of d samples.

        By the argument principle, the polynomial in z^-1 turns about 0 once for each pole
        outside, as z^-1 goes around the unit circle.
        """
        values = np.fft.fft(self.characteristic(delay), CIRCLE)
        if not values.all():  # a pole on the circle
            return False
        turns = np.angle(np.roll(values, -1) / values).sum() / (2.0 * math.pi)
        return bool(round(turns) == 0)

    def sensitivity(self) -> float:
        """Return Ms, the largest magnitude of 1 / (1 + L); infinite for an unstable loop."""
        if not self.is_stable(self.delay):
            return math.inf
        z = np.exp(-1j * FREQUENCIES)  # z^-1
        open_loop = np.convolve(self.controller[1], self.plant[1])
        closed_loop = self.characteristic(self.delay)
        return float(np.abs(polyval(z, open_loop) / polyval(z, closed_loop)).max())

    def stable_delays(self) -> tuple[int, int] | None:
        """Return the shortest and longest delay, samples, between which the loop is stable.

        It is stable with all delays between them, of which the plant's is one. None is returned
        if it is unstable with that one. The longest that is examined is `LONGEST_DELAY`.
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
    """Return the time constant with which a loop has an Ms of `target`, s.

    `make` returns the controller for a time constant; slower ones make a more robust loop.
    Down to the one that is returned, all from `slowest` on have at most this Ms. If they all
    have, it is `fastest`. A ValueError is raised if `slowest` has not.
    """

    def fits(time_constant: float) -> bool:
        return LinearLoop.of(make(time_constant), plant).sensitivity() <= target

    grid: list[float] = np.geomspace(slowest, fastest, 24).tolist()
    first = next((i for i, each in enumerate(grid) if not fits(each)), None)
    if first is None:
        return fastest
    if first == 0:
        raise ValueError(
            f"no time constant up to {slowest:g} s gives the loop an Ms of {target:g} or less"
        )
    fast, slow = grid[first], grid[first - 1]
    while slow / fast > 1.0 + 1e-5:
        middle = math.sqrt(slow * fast)
        if fits(middle):
            slow = middle
        else:
            fast = middle
    return slow
