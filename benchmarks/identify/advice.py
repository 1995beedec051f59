"""Tune controllers that are safe with the plants that a log leaves possible."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from agents import PIController, SmithPredictor
from benchmarks.identify.fit import Array, Plant
from benchmarks.identify.model import Model

MOST_SENSITIVE = 1.8  # largest Ms of a recommended loop
SHARE = 0.95  # of the possible plants that must stay within it
DELAYS = (1.0, 0.8, 0.9, 1.1, 1.2)  # of each of them, as multiples of its own
SLOWER = 1.15 ** np.arange(30)  # closed loops that are tried, as multiples of the rule's


@dataclass(frozen=True)
class Recommended:
    """A controller that is robust to what a log leaves uncertain."""

    name: str
    arguments: dict[str, Any]
    """Of `agents.PIController` or `agents.SmithPredictor`."""
    kp: float
    """Kp of u = Kp ((y_d - y) + integral / Ti): its sign is that of the plant's gain."""
    ti: float
    """Ti, s."""
    told: dict[str, float]
    """The first-order model that it is made from: `gain`, `time_constant` and `delay`, s, the
    sample included that any flow takes to show."""
    sensitivity: float
    """Ms with the most likely plant."""
    worst: float
    """Ms with 95 % of the possible plants, with the delay a fifth off."""
    slowed: float
    """Factor by which the closed loop is slower than the rule makes it."""
    delay_margin: float
    """Additional delay at which the loop with the most likely plant becomes unstable, s."""

    @property
    def label(self) -> str:
        """Its name in a report."""
        return {"pi-simc": "PI (SIMC)", "smith": "Smith"}[self.name]

    @property
    def action(self) -> str:
        """Whether the flow rises ("direct") or falls when the temperature rises."""
        return "reverse" if self.kp > 0.0 else "direct"


class Loops:
    """Loops of a controller with many plants, each with its own delay and with others."""

    def __init__(self, plants: list[Plant], h: float) -> None:
        slowest = max(plants[0].delay + plants[0].slowest, h)
        self._frequency = np.geomspace(2e-3 / slowest, math.pi / h, 400)
        self._back = np.exp(-1j * h * self._frequency)
        self._responses = np.array([
            [replace(each, delay=x * each.delay).response(h, self._frequency) for x in DELAYS]
            for each in plants
        ])  # fmt: skip

    def judged(self, controller: PIController) -> tuple[Array, float]:
        """Return Ms with each plant, and the delay margin with the first, s.

        Ms is the largest over the delays, and infinite if a loop is unstable. 1 + L begins at
        -90 degrees, because of the integrator, and ends real: by Nyquist's criterion the loop
        is stable if it does not encircle 0, and the controller has no pole outside the circle.
        """
        up, down = controller.transfer()
        response = np.polyval(up[::-1], self._back) / np.polyval(down[::-1], self._back)
        opened = self._responses * response
        turns = np.unwrap(np.angle(1.0 + opened), axis=-1)
        stable = np.abs(turns[..., -1] - turns[..., 0] - math.pi / 2.0) < 1.0
        stable &= np.abs(np.roots(down)).max() < 1.0 + 1e-6
        peaks = np.where(stable, 1.0 / np.abs(1.0 + opened).min(axis=-1), np.inf).max(axis=-1)
        own = opened[0, 0]
        of_one = np.flatnonzero((np.abs(own[:-1]) >= 1.0) != (np.abs(own[1:]) >= 1.0))
        left = (np.angle(own[of_one]) + math.pi) % (2.0 * math.pi) / self._frequency[of_one]
        return peaks, float(left.min(initial=math.inf))


def recommended(model: Model, *, smith: bool = False) -> list[Recommended]:
    """Return a PI controller by SIMC's rule, and a Smith predictor if it is asked for.

    Each is slowed until Ms is at most 1.8 with 95 % of the plants that the log leaves possible,
    with their delays a fifth longer and shorter among them. It is left out if that fails, and
    so is a Smith predictor with a delay margin of less than a fifth of the delay. Nothing is
    recommended on a model with warnings.
    """
    if model.warnings:
        return []
    h, plant, found = model.log.sampling_interval, model.plant, list[Recommended]()
    lag, delay = plant.first_order()
    told = {"gain": plant.gain, "time_constant": lag, "delay": delay + h}
    limits = {"u_min": model.u_min, "u_max": model.u_max}
    zone = model.estimates["dead_zone"].value
    loops = Loops([plant, *model.possible], h)
    for name in ["pi-simc", "smith"][: 1 + smith]:
        for slower in SLOWER.tolist():
            if name == "smith":  # at first half as slow as the plant
                rule = {
                    "closed_loop_time_constant": slower * max(lag / 2.0, h),
                    "dead_zone": zone,
                }
                arguments: dict[str, Any] = {**told, **rule, "sampling_interval": h, **limits}
                made: PIController = SmithPredictor(**arguments)
            else:  # a flow that is held for a sample is half a sample late
                late = delay + h / 2.0
                rule = told | {"delay": late, "closed_loop_time_constant": slower * late}
                made = PIController.simc(**rule, sampling_interval=h)
                arguments = {"kp": made.kp, "ki": made.ki, "anti_windup": True, **limits}
            (own, *others), margin = loops.judged(made)
            worst = float(np.quantile(others, SHARE, method="higher"))
            enough = name != "smith" or margin >= delay / 5.0
            if max(own, worst) <= MOST_SENSITIVE and enough:
                ti = made.kp / made.ki * h
                found.append(Recommended(
                    name, arguments, -made.kp, ti, told, float(own), worst, slower, margin
                ))  # fmt: skip
                break
    return found
