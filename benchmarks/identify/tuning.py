"""Tune controllers, and slow them until they are robust to what a log leaves uncertain."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from agents import PIController, SmithPredictor
from benchmarks.identify.model import Model
from benchmarks.identify.plant import plant_arguments
from benchmarks.lib.statistics import Estimate, student
from benchmarks.loop.linear import StepTest, nominal, read_off
from benchmarks.loop.margins import Loop, sensitivities
from benchmarks.loop.metrics import mean_error, travel
from benchmarks.loop.rollout import make_plants, rollout
from mptc_gym import Parameters

MOST_SENSITIVE = 2.0  # largest Ms of a recommended loop, a gain margin of 2
SHARE = 0.95  # share of the possible plants that must stay within it


@dataclass(frozen=True)
class Recommended:
    """A controller that is robust to what a log leaves uncertain, and how it was found."""

    name: str
    controller: PIController
    """Linear between the limits."""
    told: StepTest
    """The first-order model that it is made from."""
    loop: Loop
    """The loop with the identified plant."""
    worst: float
    """95th percentile of Ms over the possible plants."""
    slowed: float
    """Factor by which the closed loop is slower than the rule makes it."""
    samples: int
    """Length of a run on the identified plant."""
    error: Estimate
    """Mean |e| of such runs, degC."""
    travel: float
    """Of the valve in a run."""

    @property
    def kp(self) -> float:
        """Kp of u = Kp ((y_d - y) + integral / Ti): its sign is that of the plant's gain."""
        return -self.controller.kp

    @property
    def ti(self) -> float:
        """Ti, s."""
        return self.controller.kp / self.controller.ki * self.told.sampling_interval


def recommended(model: Model) -> list[Recommended]:
    """Return a PI controller by SIMC's rule, and a Smith predictor where that is better.

    Each is slowed until Ms is at most 2 with the identified plant and with 95 % of the plants
    that the log leaves possible. It is left out if that fails, and so is a Smith predictor
    whose mean error on the identified plant is the larger one. Nothing is recommended on a
    model with warnings.
    """
    if model.warnings:
        return []
    step, arguments = read_off(model.plant), plant_arguments(model)
    parameters = Parameters(**arguments)
    plant, samples = nominal(parameters), max(1200, 2 * parameters.setpoint_period)
    limits: dict[str, Any] = {"u_min": model.u_min, "u_max": model.u_max}
    peaks = sensitivities([model.plant, *model.possible])

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

    def slowed(name: str, make: Callable[[float], PIController]) -> list[Recommended]:
        for factor in 1.25 ** np.arange(60):  # up to half a million
            controller = make(float(factor))
            own, *others = peaks(controller)
            worst = float(np.quantile(others, SHARE, method="higher"))
            if max(worst, own) > MOST_SENSITIVE:
                continue
            loop = Loop(controller, plant)
            if loop.margins.sensitivity <= MOST_SENSITIVE:
                plants = make_plants(100, samples, **arguments)
                run = rollout(plants, controller, samples, seed=0)  # the same noise for all
                error, moved = student(mean_error(run)), float(travel(run).mean())
                found = Recommended(
                    name, controller, step, loop, worst, float(factor), samples, error, moved
                )
                return [found]
        return []

    found = [*slowed("pi-simc", pi), *slowed("smith", smith)]
    return [each for each in found if each.error.value <= found[0].error.value]
