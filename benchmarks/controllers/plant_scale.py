"""Compare the gains, time constants, delays and reachable temperatures of two plants.

With the ratios of these four magnitudes, the intervals in which a search looks for the gains of
a controller are converted from the paper's plant to another plant.
"""

import math
from collections.abc import Mapping

from benchmarks.loop.linear import nominal
from mptc_gym import Parameters
from mptc_gym.plant.parameters import slowest_pole

# Two plants count as different if one of the four magnitudes differs by more than this factor.
MUCH = 2.0
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

# The interval of each gain, by the gain's name: first the end of smaller magnitude.
Spans = Mapping[str, tuple[float, float]]


def direction(plant: Parameters) -> int:
    """Return 1 if the steady temperature of a plant rises with the flow, and -1 otherwise."""
    return 1 if nominal(plant).gain > 0.0 else -1


def scales(plant: Parameters) -> dict[str, float]:
    """Return four magnitudes of the nominal plant, by a text of name and unit, "NAME, UNIT".

    The magnitudes are the gain, the reach (the change of the steady temperature by half the
    range of the flow), the time constant and the delay. If the plant is integrating, the gain,
    the reach and the time constant are infinite. The nominal plant is the plant in the middle
    of all ranges of `plant`.
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
    """Return a text on the magnitudes of two plants that differ by a factor above `MUCH`.

    The text has both values of each magnitude that differs, and is "" if no magnitude differs
    by more than `MUCH`. The magnitudes are the gain, the reach, the time constant and the delay
    that `scales` returns. `plant` is the plant on which a controller runs, and `made_for` is
    the plant for which the controller was made.
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
    """Return the four magnitudes of `scales` for a plant on which gains are searched.

    A ValueError is raised if one of the magnitudes is 0 or infinite, since the intervals of a
    search are proportional to ratios of magnitudes.
    """
    numbers = scales(plant)
    for name, value in numbers.items():
        if not 0.0 < value < math.inf:
            quantity, unit = name.rsplit(", ", 1)
            raise ValueError(
                f"the {quantity} must be finite and above 0 for a search, got {value:g} {unit}"
            )
    return numbers


def pi_spans(plant: Parameters) -> Spans:
    """Return the intervals in which a search looks for the gains `kp` and `ki` on a plant.

    A PI controller has a proportional gain `kp` in t/h per degC, and an integral gain `ki` in
    t/h per degC and sample. The intervals for the paper's plant are multiplied by the gain of
    the paper's plant divided by the gain of `plant`. The interval of `ki` is also multiplied by
    the time constant of the paper's plant divided by the time constant of `plant`.
    """
    numbers = _finite_scales(plant)
    paper_numbers = scales(PAPER)
    kp = paper_numbers["gain, °C per t/h"] / numbers["gain, °C per t/h"]
    if direction(plant) != direction(PAPER):
        kp = -kp
    ki = kp * paper_numbers["time constant, samples"] / numbers["time constant, samples"]
    return _scaled(PI_SPANS, {"kp": kp, "ki": ki})


def nn_spans(plant: Parameters) -> Spans:
    """Return the intervals in which a search looks for the gains of the paper's network.

    The four gain factors of the learning rule multiply an error, and the input scale multiplies
    temperatures. So the intervals for the paper's plant are multiplied by the ratio of the
    temperature changes that the flow can cause on the paper's plant and on `plant`. The
    interval for the initial weights, which have no unit, is the same for all plants.
    """
    reach = "reach of half the flow's range, °C"
    factor = scales(PAPER)[reach] / _finite_scales(plant)[reach]
    factors = dict.fromkeys(NN_SPANS, factor) | {"weight_scale": 1.0}
    return _scaled(NN_SPANS, factors)


def dahlin_spans(plant: Parameters) -> Spans:
    """Return the intervals in which a search looks for Dahlin's two time constants, s.

    The intervals for the closed-loop and the filter time constant of Dahlin's controller are
    fixed multiples of the time constant and the delay of `plant`.
    """
    numbers = _finite_scales(plant)
    interval = plant.sampling_interval
    time_constant = numbers["time constant, samples"] * interval
    horizon = time_constant + numbers["delay, samples"] * interval
    return {
        "closed_loop_time_constant": (0.02 * time_constant, time_constant),
        "filter_time_constant": (0.02 * horizon, 2.0 * horizon),
    }


def _scaled(spans: Spans, factors: Mapping[str, float]) -> Spans:
    """Return intervals of gains with both ends multiplied by a factor.

    `spans` has the interval of each gain, and `factors` has the factor of each gain, both by
    the name of the gain.
    """
    scaled = {}
    for name, (first, last) in spans.items():
        scaled[name] = first * factors[name], last * factors[name]
    return scaled
