"""Compute the intervals in which a search looks for the gains of a controller for a plant.

Both ends of an interval have the same sign, and the first end has the smaller magnitude.
"""

import math
from collections.abc import Callable, Mapping

from benchmarks.controllers.known_plant import PAPER, KnownPlant

Spans = Mapping[str, tuple[float, float]]  # an interval for each gain, by the name of the gain


def pi_spans(plant: KnownPlant) -> Spans:
    """Return the intervals for the gains of a PI controller.

    A PI controller has a proportional gain `kp` in t/h per degC, and an integral gain `ki` in
    t/h per degC and sample. The interval of `kp` is inversely proportional to the gain of
    `plant`, and proportional to the ratio of its time constant and its delay, as in the rule
    SIMC. The interval of `ki` is proportional to that of `kp`, divided by the time constant.
    `plant` has a gain and a time constant other than 0, since the options that choose a plant
    refuse others.
    """
    # Both factors are 1 for the paper's plant.
    slowness = (time_constant(plant) / lag(plant)) / (time_constant(PAPER) / lag(PAPER))
    kp = PAPER.gain / plant.gain * slowness
    ki = kp * time_constant(PAPER) / time_constant(plant)  # 1 for the paper's plant
    return {"kp": (0.1 * kp, 10.0 * kp), "ki": (1e-3 * ki, 1.0 * ki)}


def nn_spans(plant: KnownPlant) -> Spans:
    """Return the intervals for the settings of the paper's network.

    The four gains of the network's learning rule multiply an error, and the input scale of the
    network multiplies temperatures. So their intervals are inversely proportional to the
    temperature range of `plant`. The initial weights have no unit.
    """
    scale = PAPER.temperature_range / plant.temperature_range  # 1 for the paper's plant
    return {
        "eta": (1e-3 * scale, 10.0 * scale),
        "eta_1": (1e-3 * scale, 1.0 * scale),
        "eta_theta": (1e-4 * scale, 1.0 * scale),
        "eta_1_theta": (1e-4 * scale, 1.0 * scale),
        "input_scale": (0.02 * scale, 1.0 * scale),
        "weight_scale": (0.05, 2.0),
    }


def lag(plant: KnownPlant) -> float:
    """Return the delay of a plant, samples, with the sample in which a flow first acts."""
    return float(plant.model.numbers.delay) + 1.0


def time_constant(plant: KnownPlant) -> float:
    """Return the time constant of the slowest pole of a plant, samples."""
    return -1.0 / math.log(plant.model.slowest_pole)


# The controllers whose gains can be searched, by their names in the roster.
SPANS: dict[str, Callable[[KnownPlant], Spans]] = {
    "nn": nn_spans,
    "pi": pi_spans,
}
