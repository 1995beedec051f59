"""Margins: against python-control, and against loops that are driven to instability."""

import math

import control
import numpy as np
import pytest
from scipy import signal

from agents import PIController, SmithPredictor
from agents.pi import SEARCHED_GAINS
from benchmarks.loop.linear import nominal
from benchmarks.loop.margins import Loop, sensitivities
from mptc_gym import Parameters

STEP_TEST = {"gain": -0.6825, "time_constant": 161.0, "delay": 152.0}  # of the paper's plant
PLANTS = {
    "paper": {},
    "long": {"delay": 35, "gain_factor": 1.1},
    "slow": {"time_constant_factor": 2.0, "sampling_interval": 2.0},
    "first order": {"a": [1.0, -0.9], "b": [-0.06], "delay": 4},
}


def controllers():
    return {
        "simc": PIController.simc(**STEP_TEST),
        "searched": PIController(**SEARCHED_GAINS),
        "smith": SmithPredictor(**STEP_TEST, closed_loop_time_constant=80.0),
        "gentle": PIController(0.5, 0.01),
        "unstable": PIController(8.0, 0.5),
    }


@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.parametrize("name", controllers())
def test_agreement_with_python_control(plant, name):
    parameters = Parameters(**PLANTS[plant])
    controller = controllers()[name]
    loop = Loop(controller, nominal(parameters))
    found, interval = loop.margins, parameters.sampling_interval
    size = max(len(loop.numerator), len(loop.denominator))
    system = control.tf(
        np.pad(loop.numerator, (0, size - len(loop.numerator))),
        np.pad(loop.denominator, (0, size - len(loop.denominator))),
        interval,
    )
    poles = control.feedback(system, 1).poles()
    assert found.stable == bool(np.all(np.abs(poles) < 1.0))
    if not found.stable:
        assert math.isnan(found.gain)
        return
    frequency = np.geomspace(1e-4, 0.9999, 4000) * math.pi / interval
    gains, phases, distances, _, crossings, _ = control.stability_margins(
        control.frd(system, frequency, smooth=True), returnall=True
    )
    assert found.sensitivity == pytest.approx(1.0 / min(distances), rel=1e-3)
    assert found.gain == pytest.approx(min(gains[gains > 1.0]), rel=1e-3)
    assert found.phase == pytest.approx(np.abs(phases).min(), rel=1e-3)
    delays = np.radians(phases % 360.0) / crossings
    assert found.delay == pytest.approx(min(delays), rel=1e-3)


@pytest.mark.parametrize("name", controllers())
def test_transfer_function_is_what_the_controller_does(name):
    # Away from limits and dead zone, commands are the error, filtered.
    controller = controllers()[name]
    errors = np.random.default_rng(0).normal(0.0, 0.1, 200)
    commands = []
    for error in errors:
        controller.act([0.0, 0.0, 0.0, error])
        commands.append(controller.command)
    assert np.abs(commands).max() < 10.0
    np.testing.assert_allclose(
        commands, signal.lfilter(*controller.transfer(), errors), atol=1e-9
    )


def test_other_direction_has_the_same_margins():
    mirrored = Parameters(b=[-b for b in Parameters().b])
    shown = {**STEP_TEST, "gain": -STEP_TEST["gain"]}
    for make in (PIController.simc, SmithPredictor):
        more = {"closed_loop_time_constant": 80.0}
        ours = Loop(make(**STEP_TEST, **more), nominal(Parameters())).margins
        assert Loop(make(**shown, **more), nominal(mirrored)).margins == ours


def test_coarse_grid_finds_the_same_sensitivities():
    plants = [nominal(Parameters(**plant)) for plant in PLANTS.values()]
    peaks = sensitivities(plants)
    for controller in controllers().values():
        for plant, peak in zip(plants, peaks(controller), strict=True):
            margins = Loop(controller, plant).margins
            assert np.isinf(peak) == (not margins.stable)
            if margins.stable:
                assert peak == pytest.approx(margins.sensitivity, rel=0.01)
