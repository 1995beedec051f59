"""Describe an identified plant by the environment's arguments."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np

from benchmarks.identify.armax import Orders
from benchmarks.identify.model import CannotTellError, Model
from benchmarks.loop.linear import LinearModel
from mptc_gym import Parameters
from mptc_gym.parameters import slowest_pole


def noise_of(
    plant: LinearModel, orders: Orders, variance: float
) -> tuple[dict[str, float], tuple[float, ...]]:
    """Return the variances of the environment's noises, degC^2, by name, and C.

    The plant has C, or with a walk C', and `variance` is that of xi. The noise of a log is
    C' xi / (A (1 - z^-1)) with a walk, C xi / A without. Its limit at frequency 0 gives the
    walk. The white part of the rest is the transmitter's noise if it is at least half;
    otherwise (28) cannot separate the two.
    """
    a, c, points = np.array(plant.a), np.array(plant.c), 1024
    of_a = np.abs(np.fft.rfft(a, points)) ** 2
    left = variance * np.abs(np.fft.rfft(c, points)) ** 2
    walk = 0.0
    if orders.walk:
        walk = float(variance * c.sum() ** 2 / a.sum() ** 2)
        step = np.abs(np.fft.rfft([1.0, -1.0], points)) ** 2
        left = (left - left[0]) / np.maximum(step, 1e-12)
        left[0] = left[1]
        left = np.maximum(left, 1e-6 * float(np.mean(np.abs(left))))
    white = float(np.min(left / of_a))
    if white < 0.5 * float(np.mean(left / of_a)):
        white = 0.0
    if white or orders.walk:
        # The rest is C xi: C is the spectral factor with all zeros inside the unit circle, of
        # which four coefficients are kept.
        left = np.maximum(left - white * of_a, 1e-4 * left)
        cepstrum = np.fft.irfft(np.log(left))
        variance = float(np.exp(cepstrum[0]))
        c = np.array([1.0, 0.0, 0.0, 0.0])
        for i in range(1, 4):  # exp of the causal part, term by term
            c[i] = sum(j * cepstrum[j] * c[i - j] for j in range(1, i + 1)) / i
    names = "noise_variance", "measurement_noise_variance", "disturbance_walk_variance"
    return dict(zip(names, (variance, white, walk), strict=True)), tuple(c.tolist())


def plant_arguments(model: Model) -> dict[str, Any]:
    """Return the content of `plant.json`: the arguments of `MiddlePoint-v0` for the model.

    The set point stays the environment's default if the plant can reach it in time; otherwise
    it is made smaller and slower.
    """
    plant, defaults = model.plant, Parameters()
    gain, limits = abs(plant.gain), (abs(model.u_min), abs(model.u_max))
    reach, span = 0.8 * gain * (min(limits) or max(limits)), 1.5 * gain * max(limits)
    arguments: dict[str, Any] = {
        "a": list(plant.a),
        "b": list(plant.b),
        "c": list(plant.c),
        "delay": plant.delay,
        "dead_zone": model.estimates["dead_zone"].value,
        "u_min": model.u_min,
        "u_max": model.u_max,
        **{name: value for name, value in model.noise.items() if value},
        "sampling_interval": plant.sampling_interval,
    }
    if reach < defaults.setpoint_amplitude:
        arguments["setpoint_amplitude"] = float(f"{reach:.2g}")
    if span > defaults.temperature_span:
        arguments["temperature_span"] = float(f"{span:.2g}")
    if 2 * settling(plant) > defaults.setpoint_period:
        arguments["setpoint_period"] = 2 * settling(plant)
    return _rounded(arguments)


def plant_ranges(model: Model) -> dict[str, Any]:
    """Return the content of `ranges.json`: the same, with intervals as ranges to draw from."""
    arguments, plant = plant_arguments(model), model.plant
    names = "delay", "dead_zone", "noise_variance", "gain", "time_constant"
    delay, zone, noise, gain, constant = (model.estimates[name] for name in names)
    level = arguments.get("noise_variance", 0.0) / (noise.value or 1.0)
    factors = np.sort([gain.low / gain.value, gain.high / gain.value])
    ranges = {
        "delay": [int(delay.low), int(delay.high)],
        "dead_zone": [zone.low, zone.high],
        "noise_variance": [level * noise.low, level * noise.high],
        "gain_factor": np.clip(factors, 0.1, 10.0).tolist(),
    }
    pole = complex(slowest_pole(plant.a) or 0.0)
    if pole.imag == 0.0 and 0.0 < pole.real < 1.0:
        # The environment's time constant is 1 / (1 - pole) samples, at least 1.
        rate, times = 1.0 - pole.real, np.maximum([constant.low, constant.high], 1e-9)
        fast, slow = np.maximum(-np.expm1(-plant.sampling_interval / times), 1e-12).tolist()
        ranges["time_constant_factor"] = [
            min(max(rate / fast, rate * 1.000001), 1.0),
            max(min(rate / slow, 10.0), 1.0),
        ]
    arguments |= {name: ends for name, ends in ranges.items() if ends[0] < ends[1]}
    arguments = _rounded(arguments)
    try:
        Parameters(**arguments)
    except ValueError as error:
        raise CannotTellError(
            f"the environment does not have such plants: {error}. See whether the units are "
            "right (--flow-unit, --temperature-unit, --time-unit), or scale the columns"
        ) from error
    return arguments


def _rounded(arguments: dict[str, Any]) -> dict[str, Any]:
    """Return arguments rounded to eight digits, more than any log determines."""
    rounded: dict[str, Any] = json.loads(
        json.dumps(arguments), parse_float=lambda text: float(f"{float(text):.8g}")
    )
    return rounded


def settling(plant: LinearModel) -> int:
    """Return how long a step response takes to settle within 2 %, samples."""
    size = float(np.max(np.abs(plant.poles), initial=0.0))
    own = math.log(0.02) / math.log(size) if 0.0 < size < 1.0 else 0.0
    return plant.delay + len(plant.b) + min(math.ceil(own), 100_000)
