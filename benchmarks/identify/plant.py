"""Describe an identified plant by the environment's arguments."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.polynomial.polynomial import polyadd
from scipy.optimize import least_squares
from scipy.signal import lfilter

from benchmarks.identify.fit import Array
from benchmarks.identify.model import Model
from mptc_gym import Parameters
from mptc_gym.parameters import slowest_pole


def plant_arguments(model: Model) -> dict[str, Any]:
    """Return the content of `plant.json`: the arguments of `MiddlePoint-v0` for the model.

    The plant is sampled exactly, at the log's interval. The set point stays the environment's
    default if the plant can reach it in time; otherwise it is made smaller and slower.
    """
    h, plant, defaults = model.log.sampling_interval, model.plant, Parameters()
    delay, uppers, lowers = plant.sampled(h)
    b, a = uppers[0], lowers[0]
    for upper, lower in zip(uppers[1:], lowers[1:], strict=True):  # a sum of fractions
        b, a = polyadd(np.convolve(b, lower), np.convolve(upper, a)), np.convolve(a, lower)
    c, variance = _noise(model.log.temperature - model.simulated, a.real)
    limits = abs(model.u_min), abs(model.u_max)
    reach = 0.8 * abs(plant.gain) * (min(limits) or max(limits))
    span = 1.5 * abs(plant.gain) * max(limits)
    period = 2 * round((plant.delay + 4.0 * plant.slowest) / h)
    arguments: dict[str, Any] = {
        "a": a.real.tolist(),
        "b": b.real.tolist(),
        "c": c.tolist(),
        "delay": delay,
        "dead_zone": model.estimates["dead_zone"].value,
        "u_min": model.u_min,
        "u_max": model.u_max,
        "noise_variance": variance,
        "sampling_interval": h,
    }
    if reach < defaults.setpoint_amplitude:
        arguments["setpoint_amplitude"] = float(f"{reach:.2g}")
    if span > defaults.temperature_span:
        arguments["temperature_span"] = float(f"{span:.2g}")
    if period > defaults.setpoint_period:
        arguments["setpoint_period"] = period
    return _checked(arguments)


def _noise(left: Array, a: Array) -> tuple[Array, float]:
    """Return C, with real roots, and the variance of xi, such that C xi / A is like a series.

    C begins as A, for white noise, and minimises the prediction errors xi.
    """
    left = np.nan_to_num(left - np.nanmean(left))
    roots = np.clip(np.r_[np.abs(np.roots(a)), 0.1], 0.1, 0.98)

    def errors(q: Array) -> Array:
        return np.asarray(lfilter(a, np.poly(np.tanh(q)), left))

    q = least_squares(errors, np.arctanh(roots), method="lm", max_nfev=60).x
    return np.asarray(np.poly(np.tanh(q))), float(np.var(errors(q)))


def plant_ranges(model: Model) -> dict[str, Any]:
    """Return the content of `ranges.json`: the same, with intervals as ranges to draw from."""
    arguments, h = plant_arguments(model), model.log.sampling_interval
    names = "delay", "dead_zone", "gain", "time_constant"
    delay, zone, gain, constant = (model.estimates[name] for name in names)
    chance = 2.0 * np.sqrt(2.0 / len(model.log.flow))  # of a variance, about
    factors = np.sort([gain.low / gain.value, gain.high / gain.value])
    whole, most = arguments["delay"], max(-model.u_min, model.u_max)
    ranges = {
        "delay": [min(int(delay.low), whole), max(int(delay.high), whole)],
        "dead_zone": [zone.low, min(zone.high, 0.99 * most)],
        "noise_variance": [arguments["noise_variance"] * x for x in (1 - chance, 1 + chance)],
        "gain_factor": np.clip(factors, 0.1, 10.0).tolist(),
    }
    pole = complex(slowest_pole(arguments["a"]) or 0.0)
    if pole.imag == 0.0 and 0.0 < pole.real < 1.0:
        # The environment's time constant is 1 / (1 - pole) samples, at least 1.
        rate, times = 1.0 - pole.real, np.maximum([constant.low, constant.high], 1e-9)
        fast, slow = np.maximum(-np.expm1(-h / times), 1e-12).tolist()
        low, high = (
            min(max(rate / fast, 1.000001 * rate), 1.0),
            max(min(rate / slow, 10.0), 1.0),
        )
        ranges["time_constant_factor"] = [low, high]
    return _checked(arguments | {name: x for name, x in ranges.items() if x[0] < x[1]})


def _checked(arguments: dict[str, Any]) -> dict[str, Any]:
    """Return arguments; ValueError if the environment has no such plant."""
    try:
        Parameters(**arguments)
    except ValueError as error:
        raise ValueError(
            f"the environment does not have such plants: {error}. See whether the units are "
            "right (--flow-unit, --temperature-unit, --time-unit), or scale the columns"
        ) from error
    return arguments
