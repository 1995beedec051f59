"""The arguments of the environment that make it the plant that a log has shown."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from benchmarks.controllers.step_test import step_test
from benchmarks.identify.log import Log
from benchmarks.identify.model import Interval, Model
from benchmarks.linear import LinearModel, nominal
from mptc_gym import Parameters
from mptc_gym.parameters import slowest_pole

Array = NDArray[np.float64]

LARGEST_FACTOR = 10.0  # of gain and time constant in a range, where the log gives no end
REACH = 0.8  # share of the temperature that the flow can hold, for the set point


def plant_arguments(model: Model) -> dict[str, Any]:
    """Return `plant.json`: the arguments of `MiddlePoint-v0` for what was found.

    The set point is the environment's where the plant reaches it and has the time for it;
    otherwise it is made smaller and slower.
    """
    arguments: dict[str, Any] = {
        "a": list(model.a),
        "b": list(model.b),
        "c": list(model.c),
        "delay": int(model.estimates["delay"].value),
        "dead_zone": model.estimates["dead_zone"].value,
        "u_min": model.u_min,
        "u_max": model.u_max,
        "noise_variance": model.estimates["noise_variance"].value,
        "sampling_interval": model.sampling_interval,
    }
    defaults = Parameters()
    gain = abs(sum(model.b) / sum(model.a))
    reach = gain * min(abs(model.u_min), abs(model.u_max)) or gain * max(
        abs(model.u_min), abs(model.u_max)
    )
    if REACH * reach < defaults.setpoint_amplitude:
        arguments["setpoint_amplitude"] = float(f"{REACH * reach:.2g}")
    span = 1.5 * gain * max(abs(model.u_min), abs(model.u_max))
    if span > defaults.temperature_span:
        arguments["temperature_span"] = float(f"{span:.2g}")
    tested = step_test(Parameters(**arguments))
    settled = (tested.delay + 5.0 * tested.time_constant) / model.sampling_interval
    if 2.0 * settled > defaults.setpoint_period:
        arguments["setpoint_period"] = 2 * math.ceil(settled)
    rounded: dict[str, Any] = _rounded(arguments)
    return rounded


def plant_ranges(model: Model) -> dict[str, Any]:
    """Return `ranges.json`: the same with the intervals as ranges, to be drawn from."""
    arguments = plant_arguments(model)
    estimates = model.estimates
    for name in ("delay", "dead_zone", "noise_variance"):
        interval = estimates[name]
        if interval.low < interval.high:
            ends = [interval.low, interval.high]
            arguments[name] = [int(end) for end in ends] if name == "delay" else ends
    gain = _factors(estimates["gain"])
    if gain[0] < gain[1]:
        arguments["gain_factor"] = gain
    constant = estimates["time_constant"]
    pole = complex(slowest_pole(model.a) or 0.0)
    if math.isfinite(constant.low) and pole.imag == 0.0 and 0.0 < pole.real < 1.0:
        # The environment's time constant is 1 / (1 - pole) samples.
        rates = Interval(
            # A log may leave it open whether the plant has any time constant at all.
            *(-math.expm1(-model.sampling_interval / max(t, 1e-12)) for t in _ordered(constant))
        )
        low, high = (rates.value / rates.high, rates.value / max(rates.low, 1e-12))
        if low < high:
            arguments["time_constant_factor"] = [low, min(high, LARGEST_FACTOR)]
    ranges: dict[str, Any] = _rounded(arguments)
    Parameters(**ranges)
    return ranges


def _rounded(value: Any) -> Any:
    """Return numbers with eight digits, which is more than any log tells."""
    if isinstance(value, dict):
        return {name: _rounded(each) for name, each in value.items()}
    if isinstance(value, list):
        return [_rounded(each) for each in value]
    return float(f"{value:.8g}") if isinstance(value, float) else value


def _ordered(interval: Interval) -> tuple[float, float, float]:
    """Return the value, then the ends that make a slow and a fast rate."""
    return interval.value, interval.high, interval.low


def _factors(interval: Interval) -> list[float]:
    """Return the ends of an interval as multiples of its value."""
    low, high = sorted((interval.low / interval.value, interval.high / interval.value))
    return [max(low, 1.0 / LARGEST_FACTOR), min(high, LARGEST_FACTOR)]


def simulation(model: Model, log: Log) -> Array:
    """Return the temperature that the model gives for the flow of a log, without noise, degC.

    It starts from the temperatures that were measured when all its flows are known; before,
    it is NaN.
    """
    flow = log.flow - model.operating_flow
    known = np.flatnonzero(np.isfinite(flow))
    held = flow[known[np.maximum(np.searchsorted(known, np.arange(len(flow)), "right") - 1, 0)]]
    applied = np.clip(held, model.u_min, model.u_max)
    applied = np.where(np.abs(applied) < model.estimates["dead_zone"].value, 0.0, applied)
    delay = int(model.estimates["delay"].value)
    order = len(model.a) - 1
    drive = signal.lfilter([0.0] * (delay + 1) + list(model.b), [1.0], applied)
    measured = log.temperature - model.operating_temperature
    start = delay + len(model.b)
    finite = np.convolve(np.isfinite(measured), np.ones(order), "valid") == order
    start += int(np.argmax(finite[start:])) + order
    result = np.full(len(flow), np.nan)
    past = measured[start - order : start][::-1]
    state = signal.lfiltic([1.0], model.a, past)
    result[start:] = signal.lfilter([1.0], model.a, drive[start:], zi=state)[0]
    return result + model.operating_temperature


def explained(model: Model, log: Log) -> float:
    """Return the share of the temperature's variance that the simulation explains."""
    error = log.temperature - simulation(model, log)
    known = np.isfinite(error)
    total = float(np.var(log.temperature[known]))
    return 1.0 - float(np.mean(error[known] ** 2)) / total


def step_band(model: Model, samples: int, draws: int, seed: int) -> tuple[Array, Array, Array]:
    """Return the step response, degC per t/h, and the ends of its 95 % band.

    Parameters
    ----------
    model
        What was found.
    samples
        How many.
    draws
        Of coefficients and delays, from what the log leaves open, for the band.
    seed
        Of the draws.
    """
    generator = np.random.default_rng(seed)
    order_a, order_b = len(model.a) - 1, len(model.b)
    size = order_a + order_b
    drawn = generator.multivariate_normal(
        [*model.a[1:], *model.b], model.covariance[:size, :size], draws
    )
    weights = np.exp(-np.array(list(model.profile.values())) / 2.0)
    delays = generator.choice(list(model.profile), draws, p=weights / weights.sum())
    responses = []
    for coefficients, delay in zip(drawn, delays, strict=True):
        a, b = np.split(coefficients, [order_a])
        plant = LinearModel([1.0, *a.tolist()], b.tolist(), delay=int(delay))
        if np.max(np.abs(plant.poles), initial=0.0) < 1.0:
            responses.append(plant.step_response(samples))
    low, high = np.percentile(responses, [2.5, 97.5], axis=0)
    found = nominal(Parameters(**plant_arguments(model)))
    return found.step_response(samples), low, high
