"""Tune controllers, and slow them until they are robust to what a log leaves uncertain."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy import integrate, signal

from agents import PIController, SmithPredictor
from benchmarks.controllers.step_test import StepTest
from benchmarks.identify.armax import Array
from benchmarks.identify.margins import Loop
from benchmarks.identify.model import Model
from benchmarks.identify.plant import plant_arguments, settling
from benchmarks.loop.linear import LinearModel
from mptc_gym import Parameters

MOST_SENSITIVE = 2.0  # largest Ms of a recommended loop
SHARE = 0.95  # share of the possible plants that must stay within it
SLOWER = 1.25  # factor by which a closed loop is slowed from one attempt to the next
SLOWEST = 60  # attempts at most


@dataclass(frozen=True)
class Recommended:
    """A controller that is robust to what a log leaves uncertain, and how it was found."""

    controller: PIController
    """Linear between the limits."""
    loop: Loop
    """The loop with the identified plant."""
    worst: float
    """95th percentile of Ms over the possible plants that are stable."""
    slowed: float
    """Factor by which the closed loop is slower than the rule makes it."""


def reduced(plant: LinearModel) -> StepTest:
    """Return a first-order model with delay, fitted to the whole response of a stable plant.

    The area between the step response and its final value is T + L, and that under it up to
    T + L is T / e (K. J. Astrom and T. Hagglund, "PID Controllers", 2nd edition, 1995, section
    2.4). The delay includes the sample that any input takes to show.
    """
    samples, interval = 3 * settling(plant) + 10, plant.sampling_interval
    shape = plant.step_response(samples) / plant.gain
    total = max(float(np.sum(1.0 - shape)) - 0.5, 0.0)  # samples, by the trapezoidal rule
    under = integrate.cumulative_trapezoid(shape, initial=0.0)
    area = float(np.interp(total, np.arange(samples), under))
    constant = min(max(math.e * area, 0.2), max(total, 0.2))
    delay = max(total - constant, 0.0) + 1.0
    return StepTest(
        float(f"{plant.gain:.4g}"),
        float(f"{constant * interval:.3g}"),
        float(f"{delay * interval:.3g}"),
        interval,
    )


def recommended(model: Model) -> dict[str, Recommended | None]:
    """Return a PI controller by SIMC's rule and a Smith predictor, by name.

    Each is slowed until Ms is at most 2 with the identified plant and with 95 % of the stable
    plants that the log leaves possible. It is None if that fails, or if most are not stable.
    """
    step, parameters = reduced(model.plant), Parameters(**plant_arguments(model))
    limits: dict[str, Any] = {"u_min": model.u_min, "u_max": model.u_max}

    def pi(slowed: float) -> PIController:
        return PIController.simc(
            **asdict(step), closed_loop_time_constant=slowed * step.delay, **limits
        )

    def smith(slowed: float) -> SmithPredictor:
        wanted = slowed * max(step.time_constant / 2.0, step.sampling_interval)
        return SmithPredictor(
            **asdict(step),
            closed_loop_time_constant=float(f"{wanted:.3g}"),
            dead_zone=model.estimates["dead_zone"].value,
            **limits,
        )

    stable = [p for p in model.possible if np.max(np.abs(p.poles), initial=0.0) < 1.0]
    # A plant that settles in the log is stable; if most possible ones are not, it did not.
    known = len(stable) > len(model.possible) / 2
    sensitivity = _sensitivity([model.plant, *stable])

    def slowed(make: Callable[[float], PIController]) -> Recommended | None:
        for times in range(SLOWEST if known else 0):
            controller = make(SLOWER**times)
            own, *peaks = sensitivity(controller)
            worst = float(np.quantile(peaks, SHARE, method="higher"))
            if max(worst, own) <= MOST_SENSITIVE:
                loop = Loop(controller, parameters)
                if loop.margins.sensitivity <= MOST_SENSITIVE:
                    return Recommended(controller, loop, worst, SLOWER**times)
        return None

    return {"PI, SIMC": slowed(pi), "Smith": slowed(smith)}


def _sensitivity(plants: list[LinearModel]) -> Callable[[PIController], Array]:
    """Return a function from a controller to its Ms with each of several stable plants.

    The first plant sets the lowest frequency. Ms is infinite for an unstable loop: 1 + L begins
    at -90 degrees, because of the integrator, and ends real. By Nyquist's criterion the loop is
    stable if 1 + L does not encircle 0 and no controller pole is outside the unit circle.
    """
    slowest = 0.01 / max(settling(plants[0]), 1)
    turns = 8 * (max(plant.delay + len(plant.b) for plant in plants) + 50)
    at = np.union1d(np.geomspace(slowest, np.pi, 400), np.linspace(np.pi / turns, np.pi, turns))
    back = np.exp(-1j * at)
    responses = np.array([
        signal.freqz(plant.b, plant.a, at)[1] * back ** (plant.delay + 1) for plant in plants
    ])  # fmt: skip

    def sensitivity(controller: PIController) -> Array:
        numerator, denominator = controller.transfer()
        if np.any(np.abs(np.roots(denominator)) > 1.0 + 1e-6):
            return np.full(len(plants), np.inf)
        difference = 1.0 + responses * signal.freqz(numerator, denominator, at)[1]
        steps = np.angle(difference[:, 1:] / difference[:, :-1])
        start = np.angle(difference[:, 0])
        stable = (start < 0.0) & (np.abs(start + steps.sum(axis=1)) < 1.0)
        return np.where(stable, 1.0 / np.abs(difference).min(axis=1), np.inf)

    return sensitivity
