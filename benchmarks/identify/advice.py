"""Turn an identified plant into a PI controller, and into the environment's arguments."""

import math
from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.polynomial.polynomial import polyadd
from scipy.optimize import least_squares
from scipy.signal import lfilter

from agents import PIController
from benchmarks.identify.fit import Array, Complex, Plant
from benchmarks.identify.model import Model
from mptc_gym import Parameters
from mptc_gym.parameters import slowest_pole

MOST_SENSITIVE = 1.8  # largest Ms of a recommended loop
DELAYS = (1.0, 0.8, 0.9, 1.1, 1.2)  # of each of them, as multiples of its own


def responses(plants: list[Plant], h: float) -> tuple[Complex, Complex]:
    """Return 1 / z, and there the responses of plants, each with its own delay and others."""
    slowest = max(plants[0].delay + plants[0].slowest, h)
    frequency = np.geomspace(2e-3 / slowest, math.pi / h, 400)
    found = [
        [replace(each, delay=x * each.delay).response(h, frequency) for x in DELAYS]
        for each in plants
    ]
    return np.exp(-1j * h * frequency), np.array(found)


def sensitivities(controller: PIController, back: Complex, answers: Complex) -> Array:
    """Return Ms with each plant of `responses`, the largest over its delays.

    1 + L begins at -90 degrees, because of the integrator, and ends real: by Nyquist's
    criterion the loop is stable if it does not encircle 0.
    """
    up, down = controller.transfer()
    near = 1.0 + answers * (np.polyval(up[::-1], back) / np.polyval(down[::-1], back))
    turns = np.unwrap(np.angle(near), axis=-1)
    stable = np.abs(turns[..., -1] - turns[..., 0] - math.pi / 2.0) < 1.0
    return np.asarray(np.where(stable, 1.0 / np.abs(near).min(axis=-1), np.inf).max(axis=-1))


def tuned(model: Model) -> tuple[PIController, list[float], float] | None:
    """Return a PI by SIMC's rule, slowed until Ms is at most 1.8 with 95 % of possible plants.

    The others are Ms with the most likely plant and with these, and how much slower the closed
    loop is than by the rule. None if no loop is slow enough.
    """
    h, (lag, delay) = model.log.sampling_interval, model.plant.first_order()
    late = delay + h / 2.0  # as a flow is held for a sample
    loops = responses([model.plant, *model.possible], h)
    for slower in (1.15 ** np.arange(30)).tolist():
        pi = PIController.simc(
            gain=model.plant.gain, time_constant=lag, delay=late,
            closed_loop_time_constant=slower * late, sampling_interval=h,
            u_min=model.u_min, u_max=model.u_max,
        )  # fmt: skip
        own, *others = sensitivities(pi, *loops)
        worst = np.quantile(others, 0.95, method="higher")
        if max(own, worst) <= MOST_SENSITIVE:
            return pi, [float(own), float(worst)], slower
    return None


def controllers(model: Model) -> dict[str, Any]:
    """Return the content of `controllers.json`: a PI, or why there is none.

    `kp` is that of u = kp (e + integral of e / ti). `arguments` are those of
    `agents.PIController`, where the sign of `kp` is the other one.
    """
    found = None if model.warnings else tuned(model)
    if found is None:
        none = (
            "However slow a controller is, Ms is too large with one in twenty of the plants "
            "that the log leaves possible. Record a longer log, with larger steps."
        )
        return {"recommended": [], "warnings": model.warnings or [none]}
    (pi, sensitivity, slower), (lag, delay) = found, model.plant.first_order()
    h, rest = model.log.sampling_interval, model.operating_flow
    flow, degree = model.log.given.flow_unit, model.log.given.temperature_unit
    entry = {
        "controller": "pi-simc",
        "kp": -pi.kp,
        "ti": pi.kp / pi.ki * h,
        "action": "reverse" if pi.kp < 0.0 else "direct",
        "sampling_interval": h,
        # A flow takes a sample to show.
        "model": {"gain": model.plant.gain, "time_constant": lag, "delay": delay + h},
        "arguments": {each.name: getattr(pi, each.name) for each in fields(pi) if each.init},
        "sensitivity": sensitivity,
        "slowed": slower,
        "units": {"kp": f"{flow} per {degree}", "ti": "s", "flow": flow, "temperature": degree},
        "operating_point": {"flow": rest, "temperature": model.operating_temperature},
        "limits": {"low": rest + model.u_min, "high": rest + model.u_max},
    }
    return {"recommended": [entry], "warnings": []}


def plants(model: Model) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the contents of `plant.json` and `ranges.json`: arguments of `MiddlePoint-v0`.

    In the ranges, intervals stand for estimates.
    """
    arguments = _arguments(model)
    ranges = arguments | _ranges(model, arguments)
    try:
        for each in (arguments, ranges):
            Parameters(**each)
    except ValueError as error:
        raise ValueError(
            f"the environment does not have such plants: {error}. Scale the columns of the "
            "log, and name their units with --flow-unit and --temperature-unit"
        ) from error
    return arguments, ranges


def _arguments(model: Model) -> dict[str, Any]:
    """Return the arguments of the most likely plant, sampled exactly at the log's interval.

    The set point stays the environment's default if the plant can reach it in time; otherwise
    it is made smaller and slower.
    """
    h, plant, defaults = model.log.sampling_interval, model.plant, Parameters()
    delay, (b, *uppers), (a, *lowers) = plant.sampled(h)
    for upper, lower in zip(uppers, lowers, strict=True):  # a sum of fractions
        b, a = polyadd(np.convolve(b, lower), np.convolve(upper, a)), np.convolve(a, lower)
    c, variance = _noise(model.log.temperature - model.simulated, a.real)
    limits, gain = (abs(model.u_min), abs(model.u_max)), abs(plant.gain)
    reach = float(f"{0.8 * gain * (min(limits) or max(limits)):.2g}")
    span = float(f"{1.5 * gain * max(limits):.2g}")
    period = 2 * round((plant.delay + 4.0 * plant.slowest) / h)
    suited = {
        "setpoint_amplitude": min(reach, defaults.setpoint_amplitude),
        "temperature_span": max(span, defaults.temperature_span),
        "setpoint_period": max(period, defaults.setpoint_period),
    }
    return {
        "a": a.real.tolist(),
        "b": b.real.tolist(),
        "c": c.tolist(),
        "delay": delay,
        "dead_zone": model.estimates["dead_zone"].value,
        "u_min": model.u_min,
        "u_max": model.u_max,
        "noise_variance": variance,
        "sampling_interval": h,
        **{name: x for name, x in suited.items() if x != getattr(defaults, name)},
    }


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


def _ranges(model: Model, arguments: dict[str, Any]) -> dict[str, list[float]]:
    """Return the intervals, as ranges to draw from."""
    delay, zone, gain, constant = model.estimates.values()
    chance = 2.0 * np.sqrt(2.0 / len(model.log.flow))  # of a variance, about
    whole, most = arguments["delay"], max(-model.u_min, model.u_max)
    ranges = {
        "delay": [min(int(delay.low), whole), max(int(delay.high), whole)],
        "dead_zone": [zone.low, min(zone.high, 0.99 * most)],
        "noise_variance": [arguments["noise_variance"] * x for x in (1 - chance, 1 + chance)],
        "gain_factor": np.clip(np.sort(np.array(gain[1:]) / gain.value), 0.1, 10.0).tolist(),
    }
    pole = complex(slowest_pole(arguments["a"]) or 0.0)
    if pole.imag == 0.0 and 0.0 < pole.real < 1.0:
        # The environment's time constant is 1 / (1 - pole) samples, at least 1.
        rate, times = 1.0 - pole.real, np.array([constant.low, constant.high])
        fast, slow = (-rate / np.expm1(-model.log.sampling_interval / times)).tolist()
        low = min(max(fast, 1.000001 * rate), 1.0)
        ranges["time_constant_factor"] = [low, max(min(slow, 10.0), 1.0)]
    return {name: x for name, x in ranges.items() if x[0] < x[1]}
