"""Compare the magnitudes of plants, and scale the gains of controllers between plants."""

import math
from collections.abc import Mapping

from benchmarks.loop.linear import nominal
from mptc_gym import Parameters
from mptc_gym.parameters import slowest_pole

MUCH = 2.0  # Two plants differ if one of their magnitudes differs by more than this factor.
PAPER = Parameters()
# The intervals in which a search on the paper's plant looks for each gain.
PI_SPANS = {"kp": (0.1, 10.0), "ki": (1e-3, 1.0)}
NN_SPANS = {
    "eta": (1e-3, 10.0),
    "eta_1": (1e-3, 1.0),
    "eta_theta": (1e-4, 1.0),
    "eta_1_theta": (1e-4, 1.0),
    "input_scale": (0.02, 1.0),
    "weight_scale": (0.05, 2.0),
}

Spans = Mapping[str, tuple[float, float]]  # the interval of each gain


def direction(plant: Parameters) -> int:
    """Return 1 if the temperature rises with the flow, and -1 otherwise."""
    return 1 if nominal(plant).gain > 0.0 else -1


def scales(plant: Parameters) -> dict[str, float]:
    """Return four magnitudes of the nominal plant, by their name and unit.

    The reach is the change of the temperature by half the range of the flow. An integrating
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


def difference(plant: Parameters, made_for: Parameters) -> str:
    """Return in words which magnitudes of two plants differ by a factor of more than `MUCH`.

    The text is "" if no magnitude does.
    """
    expected = scales(made_for)
    parts = []
    for name, value in scales(plant).items():
        if max(value, expected[name]) > MUCH * min(value, expected[name]):
            quantity, unit = name.rsplit(", ", 1)
            parts.append(
                f"the {quantity} is {value:.3g} {unit} in place of {expected[name]:.3g}"
            )
    return "; ".join(parts)


def _finite_scales(plant: Parameters) -> dict[str, float]:
    """Return `scales` of a plant; raise a ValueError if one is infinite, zero or negative."""
    numbers = scales(plant)
    for name, value in numbers.items():
        if not 0.0 < value < math.inf:
            quantity, unit = name.rsplit(", ", 1)
            raise ValueError(
                f"the {quantity} must be finite and above 0 for a search, got {value:g} {unit}"
            )
    return numbers


def pi_spans(plant: Parameters) -> Spans:
    """Return the intervals for gains of a PI on a plant: those on the paper's plant, scaled.

    Both gains are inverse to the plant's gain, and have its sign. The integral gain `ki`, per
    sample, is inverse to the time constant, too.
    """
    numbers = _finite_scales(plant)
    paper_numbers = scales(PAPER)
    kp = paper_numbers["gain, °C per t/h"] / numbers["gain, °C per t/h"]
    if direction(plant) != direction(PAPER):
        kp = -kp
    ki = kp * paper_numbers["time constant, samples"] / numbers["time constant, samples"]
    return _scaled(PI_SPANS, {"kp": kp, "ki": ki})


def nn_spans(plant: Parameters) -> Spans:
    """Return the intervals for gains of the network: those on the paper's plant, scaled.

    The gain factors multiply an error and the input scale multiplies a temperature. Both are
    inverse to the temperatures that the flow can reach. The initial weights have no unit.
    """
    reach = "reach of half the flow's range, °C"
    factor = scales(PAPER)[reach] / _finite_scales(plant)[reach]
    factors = dict.fromkeys(NN_SPANS, factor) | {"weight_scale": 1.0}
    return _scaled(NN_SPANS, factors)


def dahlin_spans(plant: Parameters) -> Spans:
    """Return the intervals for the time constants of Dahlin's controller on a plant, s."""
    numbers = _finite_scales(plant)
    interval = plant.sampling_interval
    time_constant = numbers["time constant, samples"] * interval
    horizon = time_constant + numbers["delay, samples"] * interval
    return {
        "closed_loop_time_constant": (0.02 * time_constant, time_constant),
        "filter_time_constant": (0.02 * horizon, 2.0 * horizon),
    }


def _scaled(spans: Spans, factors: Mapping[str, float]) -> Spans:
    """Return both ends of each interval times the factor of its gain."""
    scaled = {}
    for name, (first, last) in spans.items():
        scaled[name] = first * factors[name], last * factors[name]
    return scaled
