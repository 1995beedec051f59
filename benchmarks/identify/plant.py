"""The arguments of the environment that make it the plant that a log has shown."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np

from benchmarks.identify.armax import Array, Orders
from benchmarks.identify.model import CannotTellError, Interval, Model
from benchmarks.loop.linear import LinearModel
from mptc_gym import Parameters
from mptc_gym.parameters import slowest_pole

LARGEST_FACTOR = 10.0  # of gain and time constant in a range, where the log gives no end
REACH = 0.8  # share of the temperature that the flow can hold, for the set point
SETTLED = 0.02  # share of a transient that is left when it counts as over
LONGEST = 100_000  # samples of a step response
POINTS = 1024  # of the spectra of noise
MOSTLY = 0.5  # share of the noise that is white in the temperature, to be the transmitter's
OF_C = 3  # coefficients, of a noise that is parted


def noise_of(
    plant: LinearModel, orders: Orders, variance: float
) -> tuple[dict[str, float], tuple[float, ...]]:
    """Return the variances of the environment's noises, degC^2, and C.

    The noise of a log is C' xi / (A (1 - z^-1)) with a walk, C xi / A without. The walk is what
    is left of it at frequency 0. Of the rest, the white part is the transmitter's noise if it
    is most of it, as (28) cannot tell the two apart otherwise.

    Parameters
    ----------
    plant
        With C, or with a walk C'.
    orders
        Of the plant.
    variance
        Of xi, degC^2.

    Returns
    -------
    dict, tuple of float
        `noise_variance`, `measurement_noise_variance` and `disturbance_walk_variance`, and C
        with its leading 1.
    """
    a, c = np.array(plant.a), np.array(plant.c)
    of_a = np.abs(np.fft.rfft(a, POINTS)) ** 2
    left = variance * np.abs(np.fft.rfft(c, POINTS)) ** 2
    walk = 0.0
    if orders.walk:
        walk = float(variance * c.sum() ** 2 / a.sum() ** 2)
        step = np.abs(np.fft.rfft([1.0, -1.0], POINTS)) ** 2
        left = (left - left[0]) / np.maximum(step, 1e-12)
        left[0] = left[1]
        left = np.maximum(left, 1e-6 * float(np.mean(np.abs(left))))
    white = float(np.min(left / of_a))
    if white < MOSTLY * float(np.mean(left / of_a)):
        white = 0.0
    if white or orders.walk:
        # The rest as C xi: the factor of its spectrum with all zeros inside the unit circle.
        left = np.maximum(left - white * of_a, 1e-4 * left)
        cepstrum = np.fft.irfft(np.log(left))
        variance = float(np.exp(cepstrum[0]))
        c = np.zeros(OF_C + 1)
        c[0] = 1.0
        for i in range(1, OF_C + 1):  # exp of the causal part, term by term
            c[i] = sum(j * cepstrum[j] * c[i - j] for j in range(1, i + 1)) / i
    noise = {
        "noise_variance": variance,
        "measurement_noise_variance": white,
        "disturbance_walk_variance": walk,
    }
    return noise, tuple(c.tolist())


def plant_arguments(model: Model) -> dict[str, Any]:
    """Return `plant.json`: the arguments of `MiddlePoint-v0` for what was found.

    The set point is the environment's where the plant reaches it and has the time for it;
    otherwise it is made smaller and slower.
    """
    plant = model.plant
    arguments: dict[str, Any] = {
        "a": list(plant.a),
        "b": list(plant.b),
        "c": list(plant.c),
        "delay": plant.delay,
        "dead_zone": model.estimates["dead_zone"].value,
        "u_min": model.u_min,
        "u_max": model.u_max,
        **{name: value for name, value in model.noise.items() if value},
        "sampling_interval": model.plant.sampling_interval,
    }
    defaults = Parameters()
    gain, limits = abs(plant.gain), (abs(model.u_min), abs(model.u_max))
    reach = gain * (min(limits) or max(limits))
    if REACH * reach < defaults.setpoint_amplitude:
        arguments["setpoint_amplitude"] = float(f"{REACH * reach:.2g}")
    span = 1.5 * gain * max(limits)
    if span > defaults.temperature_span:
        arguments["temperature_span"] = float(f"{span:.2g}")
    settled = settling(plant)
    if 2 * settled > defaults.setpoint_period:
        arguments["setpoint_period"] = 2 * settled
    return _rounded(arguments)


def plant_ranges(model: Model) -> dict[str, Any]:
    """Return `ranges.json`: the same with the intervals as ranges, to be drawn from."""
    arguments = plant_arguments(model)
    estimates = model.estimates
    for name in ("delay", "dead_zone"):
        interval = estimates[name]
        if interval.low < interval.high:
            ends = [interval.low, interval.high]
            arguments[name] = [int(end) for end in ends] if name == "delay" else ends
    noise = estimates["noise_variance"]
    if noise.low < noise.high and arguments.get("noise_variance"):
        level = arguments["noise_variance"] / noise.value
        arguments["noise_variance"] = [level * noise.low, level * noise.high]
    gain = _factors(estimates["gain"])
    if gain[0] < gain[1]:
        arguments["gain_factor"] = gain
    constant = estimates["time_constant"]
    pole = complex(slowest_pole(model.plant.a) or 0.0)
    if pole.imag == 0.0 and 0.0 < pole.real < 1.0:
        # The environment's time constant is 1 / (1 - pole) samples, and 1 at the least.
        rate = 1.0 - pole.real
        fast, slow = (
            -math.expm1(-model.plant.sampling_interval / max(end, 1e-9))
            for end in (constant.low, constant.high)
        )
        low, high = rate / fast, min(rate / max(slow, 1e-12), LARGEST_FACTOR)
        low = min(max(low, rate * 1.000001), 1.0)
        if low < high:
            arguments["time_constant_factor"] = [low, max(high, 1.0)]
    ranges = _rounded(arguments)
    try:
        Parameters(**ranges)
    except ValueError as error:
        raise CannotTellError(
            f"the environment does not have such plants: {error}. See whether the units are "
            "right (--flow-unit, --temperature-unit, --time-unit), or scale the columns"
        ) from error
    return ranges


def _rounded(arguments: dict[str, Any]) -> dict[str, Any]:
    """Return arguments with eight digits, which is more than any log tells."""
    rounded: dict[str, Any] = json.loads(
        json.dumps(arguments), parse_float=lambda text: float(f"{float(text):.8g}")
    )
    return rounded


def _factors(interval: Interval) -> list[float]:
    """Return the ends of an interval as multiples of its value, around 1."""
    low, high = sorted((interval.low / interval.value, interval.high / interval.value))
    return [max(low, 1.0 / LARGEST_FACTOR), min(high, LARGEST_FACTOR)]


def settling(plant: LinearModel) -> int:
    """Return how long a step response takes, samples, to be over but for a fiftieth."""
    size = float(np.max(np.abs(plant.poles), initial=0.0))
    own = math.log(SETTLED) / math.log(size) if 0.0 < size < 1.0 else 0.0
    return plant.delay + len(plant.b) + min(math.ceil(own), LONGEST)


def step_band(model: Model, samples: int) -> tuple[Array, Array]:
    """Return the ends of the 95 % band of the step response, degC per t/h."""
    with np.errstate(over="ignore", invalid="ignore"):  # of plants that are not stable
        responses = np.array([plant.step_response(samples) for plant in model.possible])
    low, high = np.nanquantile(responses, [0.025, 0.975], axis=0, method="nearest")
    return low, high
