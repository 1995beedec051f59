"""Describe the plant as a linear system: its step test and time-varying course.

Between the limits of the actuator (29) the plant is

    (28)  y(k) = sum_i alpha_i y(k-1-i) + sum_i beta_i u_a(k-d-1-i) + C xi(k) + A(1) w(k),

where w is the load. Gain and time-constant factors and their drifts are part of alpha and beta.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mptc_gym import Parameters
from mptc_gym.parameters import PLANT_NUMBERS, PlantNumbers
from mptc_gym.plant import DRIFT_INTERVAL, Dynamics

Array = NDArray[np.float64]

LEVELS = 0.283, 0.632  # of a step response, which time constant and delay are read off
SLOWEST = 1 - 1e-5  # pole of a plant that settles soon enough for a step test


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
