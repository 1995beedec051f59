"""Tunes controllers, and de-tunes them until the plants that a log leaves possible bear it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy import integrate

from agents import PIController, SmithPredictor
from benchmarks.controllers.step_test import StepTest
from benchmarks.identify.armax import Array
from benchmarks.identify.margins import Margins, margins, ratio
from benchmarks.identify.model import Model
from benchmarks.identify.plant import settling
from benchmarks.loop.linear import LinearModel
from mptc_gym import Parameters

MOST_SENSITIVE = 2.0  # Ms of a loop that is recommended
SHARE = 0.95  # of the plants that the log leaves possible
SLOWER = 1.25  # by which a closed loop is slowed at a time
SLOWEST = 60  # times at most


@dataclass(frozen=True)
class Recommended:
    """A controller that all plants bear which the log leaves possible, and how it came about.

    Attributes
    ----------
    controller
        None if none was found.
    margins
        Of the loop with the identified plant.
    worst
        Ms that 95 % of the possible plants stay below; infinite if they are not stable.
    slowed
        By which factor the closed loop is slower than by the rule.
    """

    controller: PIController | SmithPredictor | None
    margins: Margins | None
    worst: float
    slowed: float


def reduced(plant: LinearModel, interval: float) -> StepTest:
    """Return a model of first order with delay that has the plant's whole response.

    By areas (K. J. Astrom and T. Hagglund, "PID Controllers", 2nd edition, 1995, section 2.4):
    that between the step response and its end is T + L, and that under it up to T + L is T / e.
    The sample that any input takes to show is part of the delay.

    Parameters
    ----------
    plant
        Stable, with a gain other than 0.
    interval
        s between samples.
    """
    samples = 3 * settling(plant) + 10
    shape = plant.step_response(samples) / plant.gain
    total = max(float(np.sum(1.0 - shape)) - 0.5, 0.0)  # samples, with lines between them
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


def recommended(model: Model, parameters: Parameters) -> dict[str, Recommended]:
    """Return a PI controller by SIMC's rule and a Smith predictor, by name.

    Each is slowed until Ms is at most 2 with the identified plant and with 95 % of those that
    the log leaves possible.
    """
    interval = model.plant.sampling_interval
    step = reduced(model.plant, interval)
    limits: dict[str, Any] = {"u_min": model.u_min, "u_max": model.u_max}

    def pi(slowed: float) -> PIController:
        return PIController.simc(
            **asdict(step), closed_loop_time_constant=slowed * step.delay, **limits
        )

    def smith(slowed: float) -> SmithPredictor:
        wanted = slowed * max(step.time_constant / 2.0, interval)
        return SmithPredictor(
            **asdict(step),
            closed_loop_time_constant=float(f"{wanted:.3g}"),
            dead_zone=model.estimates["dead_zone"].value,
            **limits,
        )

    stable = [p for p in model.possible if np.max(np.abs(p.poles), initial=0.0) < 1.0]
    # A plant that settles in the log is stable; if most of what is possible is not, it did not.
    known = len(stable) > len(model.possible) / 2
    plants = Plants([model.plant, *stable], max(settling(model.plant), 1))
    return {
        "PI, SIMC": _slowed(pi, plants, known, parameters),
        "Smith": _slowed(smith, plants, known, parameters),
    }


def _slowed(
    make: Callable[[float], PIController | SmithPredictor],
    plants: Plants,
    known: bool,
    parameters: Parameters,
) -> Recommended:
    worst = math.inf
    for times in range(SLOWEST if known else 0):
        slowed = SLOWER**times
        controller = make(slowed)
        peaks = plants.sensitivity(*controller.transfer())
        worst = float(np.quantile(peaks[1:], SHARE, method="higher"))
        if max(worst, float(peaks[0])) <= MOST_SENSITIVE:
            found = margins(controller, parameters)
            if found.sensitivity <= MOST_SENSITIVE:
                return Recommended(controller, found, worst, slowed)
    return Recommended(None, None, worst, math.nan)


class Plants:
    """The frequency responses of stable plants.

    Parameters
    ----------
    plants
        At least one.
    settling
        How long the first of them takes to settle, samples.
    """

    def __init__(self, plants: Sequence[LinearModel], settling: int) -> None:
        slowest = 0.01 / settling
        turns = 8 * (max(plant.delay + len(plant.b) for plant in plants) + 50)
        self._back = np.exp(-1j * np.union1d(
            np.geomspace(slowest, np.pi, 400), np.linspace(np.pi / turns, np.pi, turns)
        ))  # fmt: skip
        self._responses = np.array([
            ratio(plant.b, plant.a, self._back) * self._back ** (plant.delay + 1)
            for plant in plants
        ])  # fmt: skip

    def sensitivity(self, numerator: Array, denominator: Array) -> Array:
        """Return Ms of each plant with a controller, infinite where the loop is not stable.

        1 + L begins at -90 degrees, for the integrator, and ends real. By Nyquist's criterion
        the loop is stable if it does so without a turn around 0, and the controller has no
        poles beyond the unit circle.
        """
        poles = np.abs(np.roots(denominator))
        beyond = int(np.sum(poles > 1.0 + 1e-6))
        difference = 1.0 + self._responses * ratio(numerator, denominator, self._back)
        steps = np.angle(difference[:, 1:] / difference[:, :-1])
        start = np.angle(difference[:, 0])
        stable = (start < 0.0) & (np.abs(start + steps.sum(axis=1)) < 1.0) & (beyond == 0)
        peaks = 1.0 / np.abs(difference).min(axis=1)
        result: Array = np.where(stable, peaks, np.inf)
        return result
