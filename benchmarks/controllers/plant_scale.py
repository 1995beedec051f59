"""Tell how one plant differs from another in what the settings of a controller depend on."""

import math
from collections.abc import Mapping

from benchmarks.loop.linear import nominal
from mptc_gym import Parameters
from mptc_gym.parameters import slowest_pole

MUCH = 2.0  # factor from which on a number of the plant counts as different
PAPER = Parameters()
# Searches for gains on the paper's plant look between these values.
PI_SPANS = {"kp": (0.1, 10.0), "ki": (1e-3, 1.0)}
NN_SPANS = {
    "eta": (1e-3, 10.0),
    "eta_1": (1e-3, 1.0),
    "eta_theta": (1e-4, 1.0),
    "eta_1_theta": (1e-4, 1.0),
    "input_scale": (0.02, 1.0),
    "weight_scale": (0.05, 2.0),
}

Spans = Mapping[str, tuple[float, float]]


def direction(plant: Parameters) -> int:
    """Return 1 if the temperature rises with the flow, and -1 otherwise."""
    return 1 if nominal(plant).gain > 0.0 else -1


def scales(plant: Parameters) -> dict[str, float]:
    """Return the magnitudes of the nominal plant, by what they are and their unit.

    The reach is what half the range of the flow changes the temperature by. An integrating
    plant has an infinite gain, reach and time constant.
    """
    model = nominal(plant)
    gain = abs(float(model.gain))
    half_range = (model.numbers.u_max - model.numbers.u_min) / 2.0
    pole = abs(slowest_pole((1.0, *-model.alpha)))
    time_constant = math.inf if pole >= 1.0 else 0.0
    if 0.0 < pole < 1.0:
        time_constant = -1.0 / math.log(pole)
    return {
        "gain, °C per t/h": gain,
        "reach of half the flow's range, °C": gain * half_range,
        "time constant, samples": time_constant,
        "delay, samples": model.numbers.delay + 1.0,
    }


def difference(plant: Parameters, other: Parameters) -> str:
    """Return which magnitudes differ by a factor of more than `MUCH`, in words; "" if none."""
    here, there = scales(plant), scales(other)
    parts = []
    for name, value in here.items():
        reference = there[name]
        if max(value, reference) > MUCH * min(value, reference):
            quantity, unit = name.rsplit(", ", 1)
            parts.append(f"the {quantity} is {value:.3g} {unit}, there {reference:.3g}")
    return "; ".join(parts)


def _finite_scales(plant: Parameters) -> dict[str, float]:
    """Return `scales`; a ValueError is raised if one of them is not finite and positive."""
    numbers = scales(plant)
    for name, value in numbers.items():
        if not 0.0 < value < math.inf:
            quantity, unit = name.rsplit(", ", 1)
            raise ValueError(
                f"the {quantity} must be finite and above 0 for a search, got {value:g} {unit}"
            )
    return numbers


def pi_spans(plant: Parameters) -> Spans:
    """Return where to search for gains of the PI: those of the paper's plant, scaled.

    The gains are inverse to the plant's gain, and take its sign; `ki`, per sample, is inverse
    to the time constant, too.
    """
    here, paper = _finite_scales(plant), scales(PAPER)
    kp = paper["gain, °C per t/h"] / here["gain, °C per t/h"]
    if direction(plant) != direction(PAPER):
        kp = -kp
    ki = kp * paper["time constant, samples"] / here["time constant, samples"]
    return _scaled(PI_SPANS, {"kp": kp, "ki": ki})


def nn_spans(plant: Parameters) -> Spans:
    """Return where to search for gains of the network: those of the paper's plant, scaled.

    Gain factors multiply an error, and the input scale a temperature: both are inverse to the
    temperatures that the flow reaches. The initial weights have no unit.
    """
    reach = "reach of half the flow's range, °C"
    factor = scales(PAPER)[reach] / _finite_scales(plant)[reach]
    factors = dict.fromkeys(NN_SPANS, factor) | {"weight_scale": 1.0}
    return _scaled(NN_SPANS, factors)


def dahlin_spans(plant: Parameters) -> Spans:
    """Return where to search for the time constants of Dahlin's controller, s."""
    numbers = _finite_scales(plant)
    interval = plant.sampling_interval
    time_constant = numbers["time constant, samples"] * interval
    horizon = time_constant + numbers["delay, samples"] * interval
    return {
        "closed_loop_time_constant": (0.02 * time_constant, time_constant),
        "filter_time_constant": (0.02 * horizon, 2.0 * horizon),
    }


def _scaled(spans: Spans, factors: Mapping[str, float]) -> Spans:
    """Return spans times the factor of each gain."""
    return {
        name: (low * factors[name], high * factors[name]) for name, (low, high) in spans.items()
    }
