"""A plant has the same scores whatever the units of its flows and temperatures."""

import pytest

from benchmarks.compare.cases import reference_of, run_case
from benchmarks.controllers.roster import ROSTER
from benchmarks.loop.scenarios import Scenario

# Fixed gains, as of the paper's controllers and of trained networks, have units.
CONTROLLERS = "pi-simc", "smith", "dahlin", "self-tuning", "mpc"
PLANTS = {
    "paper, square wave": {"setpoint_period": 240},
    "rising and fast, square wave": {
        "a": [1.0, -0.8], "b": [0.06], "c": [1.0], "delay": 4, "dead_zone": 1.5,
        "u_min": -20.0, "u_max": 30.0, "setpoint_amplitude": 4.0, "setpoint_period": 130,
    },
    "with noise and load, random set points": {
        "a": [1.0, -0.9], "b": [-0.03], "delay": 8, "setpoint": "random",
        "setpoint_period": 240, "noise_variance": 0.1, "measurement_noise_variance": 0.05,
        "disturbance_amplitude": 1.0,
    },
}  # fmt: skip
FLOWS = {"dead_zone": 5.0, "u_min": -10.0, "u_max": 10.0}  # arguments and their defaults, t/h
TEMPERATURES = {
    "setpoint_amplitude": 5.0,
    "temperature_span": 50.0,
    "disturbance_amplitude": 0.0,
    "error_scale": 5.0,
}
VARIANCES = "noise_variance", "measurement_noise_variance", "disturbance_walk_variance"


def in_units(plant, flow, temperature):
    """Return the arguments of a plant with the numbers of flows and temperatures multiplied."""
    arguments = dict(plant)
    for name, default in FLOWS.items():
        arguments[name] = flow * plant.get(name, default)
    for name, default in TEMPERATURES.items():
        arguments[name] = temperature * plant.get(name, default)
    for name in VARIANCES:
        arguments[name] = temperature**2 * plant.get(name, 0.0)
    b = plant.get("b", [-0.04560, -0.00404])
    arguments["b"] = [temperature / flow * coefficient for coefficient in b]
    if isinstance(plant.get("setpoint"), float):
        arguments["setpoint"] = temperature * plant["setpoint"]
    return arguments


def scores(arguments):
    """Return the reference error, and the score of each controller, of a short run."""
    scenario = Scenario("case", "", 200, arguments)
    reference = reference_of(scenario, 1, 0)
    found = {"reference error": reference.value}
    for name in CONTROLLERS:
        (run,) = run_case(scenario, ROSTER[name], 1, 0).runs
        found[name] = reference.score(run["mae"]).mean()
    return found


@pytest.mark.parametrize("plant", PLANTS.values(), ids=PLANTS)
def test_scores_are_the_same_in_all_units(plant):
    expected = scores(plant)
    for flow, temperature in ((1000.0, 1.0), (1.0, 1e-3), (1000.0, 1e-3)):
        found = scores(in_units(plant, flow, temperature))
        found["reference error"] /= temperature
        assert found == pytest.approx(expected, abs=1e-3), (flow, temperature)
