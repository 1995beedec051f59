"""The linear model against the environment, its step test, and the poles of loops."""

import numpy as np
import pytest
from scipy import signal

from agents import DahlinController, PIController, SmithPredictor
from benchmarks.lib.storage import UsageError
from benchmarks.loop.linear import nominal, step_test
from benchmarks.loop.scenarios import PlantOptions
from mptc_gym import MiddlePointEnv, Parameters
from tests.conftest import STEP_TEST, run

OTHER = {"delay": 7, "gain_factor": 1.3, "time_constant_factor": 2.0, "dead_zone": 0.0}
DRIFT = {"gain_drift": 0.6, "time_constant_drift": 1.5, "drift_samples": 90}


def outputs(rng, samples=120, **arguments):
    """Return random flows and what the environment makes of them."""
    found = run(MiddlePointEnv(**arguments), rng.uniform(-1, 1, samples - 1))
    return np.append(found["applied"][1:], 0.0), found["output"]


def response(model, flow, delay):
    """Return y(0), y(1), ..., from rest, of flows u_a(0), u_a(1), ..."""
    impulse = np.append(np.zeros(delay + 1), model.impulse_response(len(flow)))
    return np.convolve(impulse, flow)[: len(flow)]


def test_the_nominal_model_is_the_environment(rng):
    flow, output = outputs(rng, **OTHER)
    model = nominal(Parameters(**OTHER))
    np.testing.assert_allclose(response(model, flow, 7), output, rtol=0, atol=1e-12)
    assert model.gain == pytest.approx(1.3 * nominal(Parameters()).gain)
    assert model.impulse_response(900).sum() == pytest.approx(model.gain, rel=1e-4)
    slow, paper = (np.roots([1, *-each.alpha]).max() for each in (model, nominal(Parameters())))
    assert 1 - paper == pytest.approx(2.0 * (1 - slow))


def test_ranges_stand_for_their_middle_and_what_is_added_does_not_show():
    more = {"disturbance_amplitude": 1.0, "gain_drift": 0.5}
    drawn = Parameters(delay=[4, 10], gain_factor=[1.0, 1.6], **more)
    middle = Parameters(delay=7, gain_factor=1.3)
    assert step_test(drawn) == step_test(middle)
    np.testing.assert_array_equal(nominal(drawn).beta, nominal(middle).beta)


def test_paper_plant_shows_the_numbers_its_controllers_are_tuned_with():
    found = step_test(Parameters())
    # Steady-state gain -0.0496 / 0.0727, the time constant of the pole at 0.9515, 19 samples.
    assert found == {**STEP_TEST, "sampling_interval": 8.0}
    slow = step_test(Parameters(sampling_interval=80.0))
    assert [*slow.values()] == [-0.6825, 1610.0, 1520.0, 80.0]


@pytest.mark.parametrize("gain", [-0.3, 0.02, 4.0])
@pytest.mark.parametrize("time_constant", [4.0, 60.0, 900.0])
@pytest.mark.parametrize("delay", [1, 5, 80])
def test_plant_of_first_order_shows_its_own_numbers(gain, time_constant, delay):
    pole = np.exp(-8.0 / time_constant)
    plant = Parameters(a=[1.0, -pole], b=[gain * (1.0 - pole)], delay=delay - 1)
    found = step_test(plant)
    assert found["gain"] == pytest.approx(gain, rel=1e-3)
    assert found["time_constant"] == pytest.approx(time_constant, rel=0.01, abs=1.0)
    assert found["delay"] == 8.0 * delay


def test_plant_without_a_new_steady_state_is_refused():
    for name, values in (("a", [1.0, -1.0]), ("a", [1.0, -1.1]), ("b", [0.1, -0.1])):
        with pytest.raises(ValueError, match=f"^{name} must"):
            step_test(Parameters(**{name: values}))
    # The gain of one that integrates has a sign.
    assert nominal(Parameters(a=[1.0, -1.0], b=[-0.1])).gain == -np.inf


def test_bad_plant_file_is_named(tmp_path):
    path = tmp_path / "plant.json"
    for text, complaint in {
        None: "plant.json must be a JSON file of arguments.*No such file",
        "{": "plant.json must be a JSON file",
        "[1, 2]": "plant.json must be a JSON file of arguments",
        '{"delay": -1}': "delay must be",
    }.items():
        if text is not None:
            path.write_text(text)
        with pytest.raises(UsageError, match=f"^--plant: .*{complaint}"):
            PlantOptions(plant=path).arguments()


@pytest.mark.parametrize(
    "controller",
    [
        PIController(0.5, 0.01),
        SmithPredictor(**STEP_TEST, closed_loop_time_constant=80.0),
        DahlinController(**STEP_TEST, closed_loop_time_constant=80.0),
        DahlinController(
            **STEP_TEST, closed_loop_time_constant=80.0, filter_time_constant=50.0
        ),
    ],
)
def test_transfer_function_is_what_the_controller_does(controller):
    # Away from limits and dead zone, commands are the error, filtered.
    errors = np.random.default_rng(0).normal(0.0, 0.1, 200)
    commands = []
    for error in errors:
        controller.act([0.0, 0.0, 0.0, error])
        commands.append(controller.command)
    assert np.abs(commands).max() < 10.0
    np.testing.assert_allclose(
        commands, signal.lfilter(*controller.transfer(), errors), atol=1e-9
    )
