"""Compute the intervals in which a search looks for the gains of a controller for a plant.

Both ends of an interval have the same sign, and the first end has the smaller magnitude.
"""

import math
from collections.abc import Mapping

from benchmarks.controllers.known_plant import KnownPlant
from mptc_gym import Parameters

Spans = Mapping[str, tuple[float, float]]  # an interval for each gain, by the name of the gain

PAPER = KnownPlant(Parameters())
# The intervals in which a search on the paper's plant looks for each gain of a controller.
PI_SPANS = {"kp": (0.1, 10.0), "ki": (1e-3, 1.0)}
NN_SPANS = {
    "eta": (1e-3, 10.0),
    "eta_1": (1e-3, 1.0),
    "eta_theta": (1e-4, 1.0),
    "eta_1_theta": (1e-4, 1.0),
    "input_scale": (0.02, 1.0),
    "weight_scale": (0.05, 2.0),
}


def pi_spans(plant: KnownPlant) -> Spans:
    """Return the intervals for the gains of a PI controller.

    A PI controller has a proportional gain `kp` in t/h per degC, and an integral gain `ki` in
    t/h per degC and sample. The intervals of `kp` and `ki` are the intervals for the paper's
    plant times the gain of the paper's plant divided by the gain of `plant`. The interval of
    `ki` is also multiplied by the time constant of the paper's plant divided by the time
    constant of `plant`.
    """
    _check(plant)
    kp_factor = PAPER.gain / plant.gain
    ki_factor = kp_factor * time_constant(PAPER) / time_constant(plant)
    return _scaled(PI_SPANS, {"kp": kp_factor, "ki": ki_factor})


def nn_spans(plant: KnownPlant) -> Spans:
    """Return the intervals for the gains of the paper's network.

    The four gain factors of the network's learning rule multiply an error, and the input scale
    of the network multiplies temperatures. So the intervals of the gain factors and of the
    input scale are the intervals for the paper's plant times the temperature range of the
    paper's plant divided by the temperature range of `plant`. The interval for the initial
    weights, which have no unit, is the same for all plants.
    """
    _check(plant)
    factor = PAPER.temperature_range / plant.temperature_range
    return _scaled(NN_SPANS, dict.fromkeys(NN_SPANS, factor) | {"weight_scale": 1.0})


def dahlin_spans(plant: KnownPlant) -> Spans:
    """Return the intervals for the time constants of Dahlin's controller.

    The interval for the closed-loop time constant, s, is proportional to the time constant of
    `plant`. The interval for the filter time constant, s, is proportional to the sum of the
    time constant and the delay of `plant`.
    """
    _check(plant)
    interval = plant.parameters.sampling_interval
    seconds = time_constant(plant) * interval
    response_time = seconds + (plant.model.numbers.delay + 1.0) * interval
    return {
        "closed_loop_time_constant": (0.02 * seconds, seconds),
        "filter_time_constant": (0.02 * response_time, 2.0 * response_time),
    }


def time_constant(plant: KnownPlant) -> float:
    """Return the time constant of the slowest pole of a plant, samples."""
    return -1.0 / math.log(plant.model.slowest_pole)


def _check(plant: KnownPlant) -> None:
    """Raise a ValueError if a plant has no gain or no time constant, such as an integrator."""
    if not 0.0 < plant.model.slowest_pole < 1.0 or plant.gain == 0.0:
        a, b = list(plant.parameters.a), list(plant.parameters.b)
        raise ValueError(
            "a search for gains needs a stable plant with a time constant and a gain other "
            f"than 0, got a={a}, b={b}"
        )


def _scaled(spans: Spans, factors: Mapping[str, float]) -> Spans:
    """Return the intervals with both ends of each interval multiplied by the gain's factor."""
    return {
        name: (first * factors[name], last * factors[name])
        for name, (first, last) in spans.items()
    }
