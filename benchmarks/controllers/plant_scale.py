"""Compare plants, and compute the intervals in which a search looks for gains for a plant.

The comparisons and the intervals depend on the gain, the temperature range, the time constant
and the delay of a plant.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from benchmarks.loop.linear import nominal
from mptc_gym import Parameters

# Two plants count as different if a quantity in `PlantScale` differs by more than this factor.
LARGEST_RATIO = 2.0
PAPER = Parameters()  # the paper's plant
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

# The interval in which a search looks for each gain, by the name of the gain. The end of
# smaller magnitude comes first.
Spans = Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class PlantScale:
    """Quantities of a plant, from which the suitable size of a controller's gains follows.

    If the plant is integrating, all quantities except the delay are infinite.
    """

    gain: float  # magnitude of the steady-state gain, degC per t/h
    temperature_range: float  # change of the steady temperature by half the flow's range, degC
    time_constant: float  # samples
    delay: float  # from a flow to the first output that the flow can affect, samples


# The name and the unit of each field of `PlantScale` in messages.
QUANTITIES = {
    "gain": ("gain", "°C per t/h"),
    "temperature_range": ("temperature change by half the flow's range", "°C"),
    "time_constant": ("time constant", "samples"),
    "delay": ("delay", "samples"),
}


def direction(plant: Parameters) -> int:
    """Return 1 if the steady temperature of a plant rises with the flow, and -1 otherwise."""
    return 1 if nominal(plant).gain > 0.0 else -1


def scale_of(plant: Parameters) -> PlantScale:
    """Return the `PlantScale` of the nominal plant, in the middle of all ranges in `plant`."""
    model = nominal(plant)
    gain = abs(float(model.gain))
    half_range = (model.numbers.u_max - model.numbers.u_min) / 2.0  # t/h
    time_constant = 0.0
    if model.slowest_pole >= 1.0:
        time_constant = math.inf
    elif model.slowest_pole > 0.0:
        time_constant = -1.0 / math.log(model.slowest_pole)
    return PlantScale(
        gain=gain,
        temperature_range=gain * half_range,
        time_constant=time_constant,
        delay=model.numbers.delay + 1.0,
    )


def difference(plant: Parameters, made_for: Parameters) -> str:
    """Return a text with the quantities in which two plants differ by more than a factor 2.

    An example of the text is "the delay is 41 samples in place of 19". The text is "" if all
    quantities differ by at most a factor 2. A controller was made for the plant `made_for`, and
    runs on the plant `plant`.
    """
    expected = vars(scale_of(made_for))
    parts = []
    for name, value in vars(scale_of(plant)).items():
        if max(value, expected[name]) > LARGEST_RATIO * min(value, expected[name]):
            quantity, unit = QUANTITIES[name]
            parts.append(
                f"the {quantity} is {value:.3g} {unit} in place of {expected[name]:.3g}"
            )
    return "; ".join(parts)


def _finite_scale_of(plant: Parameters) -> PlantScale:
    """Return the `PlantScale` of a plant on which a search for gains is to run.

    A ValueError is raised if any field of the `PlantScale` is 0 or infinite, since the ends of
    the search intervals are computed from the fields.
    """
    scale = scale_of(plant)
    for name, value in vars(scale).items():
        if not 0.0 < value < math.inf:
            quantity, unit = QUANTITIES[name]
            raise ValueError(
                f"the {quantity} must be finite and above 0 for a search for gains, "
                f"got {value:g} {unit}"
            )
    return scale


def pi_spans(plant: Parameters) -> Spans:
    """Return the intervals in which a search looks for the gains of a PI controller.

    A PI controller has a proportional gain `kp` in t/h per degC, and an integral gain `ki` in
    t/h per degC and sample. The intervals of `kp` and `ki` are the intervals for the paper's
    plant times the gain of the paper's plant divided by the gain of `plant`. The interval of
    `ki` is also multiplied by the time constant of the paper's plant divided by the time
    constant of `plant`.
    """
    scale = _finite_scale_of(plant)
    paper_scale = scale_of(PAPER)
    kp_factor = paper_scale.gain / scale.gain
    if direction(plant) != direction(PAPER):
        kp_factor = -kp_factor
    ki_factor = kp_factor * paper_scale.time_constant / scale.time_constant
    return _scaled(PI_SPANS, {"kp": kp_factor, "ki": ki_factor})


def nn_spans(plant: Parameters) -> Spans:
    """Return the intervals in which a search looks for the gains of the paper's network.

    The four gain factors of the network's learning rule multiply an error, and the input scale
    of the network multiplies temperatures. So the intervals of the gain factors and of the
    input scale are the intervals for the paper's plant times the temperature range of the
    paper's plant divided by the temperature range of `plant`. The interval for the initial
    weights, which have no unit, is the same for all plants.
    """
    factor = scale_of(PAPER).temperature_range / _finite_scale_of(plant).temperature_range
    factors = dict.fromkeys(NN_SPANS, factor) | {"weight_scale": 1.0}
    return _scaled(NN_SPANS, factors)


def dahlin_spans(plant: Parameters) -> Spans:
    """Return the intervals in which a search looks for time constants of Dahlin's controller.

    The interval for the closed-loop time constant, s, is proportional to the time constant of
    `plant`. The interval for the filter time constant, s, is proportional to the sum of the
    time constant and the delay of `plant`.
    """
    scale = _finite_scale_of(plant)
    time_constant = scale.time_constant * plant.sampling_interval
    response_time = time_constant + scale.delay * plant.sampling_interval
    return {
        "closed_loop_time_constant": (0.02 * time_constant, time_constant),
        "filter_time_constant": (0.02 * response_time, 2.0 * response_time),
    }


def _scaled(spans: Spans, factors: Mapping[str, float]) -> Spans:
    """Return search intervals of gains, with both ends of each interval multiplied by a factor.

    By the name of each gain, `spans` has the interval in which a search looks for the gain, and
    `factors` has the factor for this interval.
    """
    scaled = {}
    for name, (first, last) in spans.items():
        scaled[name] = first * factors[name], last * factors[name]
    return scaled
