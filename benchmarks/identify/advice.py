"""Tune controllers that are safe with the plants that a log leaves possible."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from typing import Any

import numpy as np

from agents import PIController, SmithPredictor
from benchmarks.identify.fit import Array, Plant
from benchmarks.identify.model import Model

MOST_SENSITIVE = 1.8  # largest Ms of a recommended loop
SHARE = 0.95  # of the possible plants that must stay within it
DELAYS = (1.0, 0.8, 0.9, 1.1, 1.2)  # of each of them, as multiples of its own
SLOWER = 1.15 ** np.arange(30)  # closed loops that are tried, as multiples of the rule's


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


def recommended(model: Model, *, smith: bool = False) -> list[dict[str, Any]]:
    """Return a PI controller by SIMC's rule, and a Smith predictor if it is asked for.

    Each is slowed until Ms is at most 1.8 with 95 % of the plants that the log leaves possible,
    with their delays a fifth longer and shorter among them. It is left out if that fails, and
    so is a Smith predictor with a delay margin of less than a fifth of the delay. Nothing is
    recommended on a model with warnings.

    Returns
    -------
    list
        Entries of `controllers.json`. `kp` is that of u = kp (e + integral of e / ti), positive
        where the flow rises when the temperature is below its set point. `model` has the sample
        in its delay that any flow takes to show. `arguments` are those of
        `agents.PIController` or `agents.SmithPredictor`, `sensitivity` is Ms with the most
        likely plant and with 95 % of the possible ones, `slowed` how much slower the closed
        loop is than by the rule.
    """
    h, plant, found = model.log.sampling_interval, model.plant, list[dict[str, Any]]()
    lag, delay = plant.first_order()
    told: dict[str, Any] = {"gain": plant.gain, "time_constant": lag, "delay": delay + h}
    shared = {"sampling_interval": h, "u_min": model.u_min, "u_max": model.u_max}
    zone, loops = model.estimates["dead_zone"].value, Loops([plant, *model.possible], h)

    def pi(slower: float) -> PIController:
        # A flow that is held for a sample is half a sample late.
        rule = {
            "delay": delay + h / 2.0,
            "closed_loop_time_constant": slower * (delay + h / 2.0),
        }
        return PIController.simc(**told | rule | shared)

    def predictor(slower: float) -> PIController:
        rule = {"closed_loop_time_constant": slower * max(lag / 2.0, h), "dead_zone": zone}
        return SmithPredictor(**told | rule | shared)

    rules = {"pi-simc": pi, "smith": predictor} if smith else {"pi-simc": pi}
    for name, rule in ({} if model.warnings else rules).items():
        for slower in SLOWER.tolist():
            made = rule(slower)
            (own, *others), margin = loops.judged(made)
            worst = float(np.quantile(others, SHARE, method="higher"))
            if max(own, worst) > MOST_SENSITIVE or (name == "smith" and margin < delay / 5.0):
                continue
            names = [each.name for each in fields(made) if each.init]
            found.append({
                "controller": name,
                "kp": -made.kp,
                "ti": made.kp / made.ki * h,
                "action": "reverse" if made.kp < 0.0 else "direct",
                "sampling_interval": h,
                "model": told,
                "arguments": {each: getattr(made, each) for each in names},
                "sensitivity": [float(own), worst],
                "delay_margin": margin,
                "slowed": slower,
            })  # fmt: skip
            break
    return found
