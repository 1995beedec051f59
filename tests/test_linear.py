"""The linear model against the environment, and what refuses a plant that is not linear."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from agents import PIController
from benchmarks.bounds import __main__ as command
from benchmarks.bounds.least import frontier, least_possible
from benchmarks.controllers import engineered
from benchmarks.controllers.mpc import PredictiveController
from benchmarks.loop import linear
from benchmarks.loop.linear import (
    Coefficients,
    LinearModel,
    nominal,
    step_test,
    time_varying_model,
)
from benchmarks.loop.margins import Loop
from mptc_gym import MiddlePointEnv, Parameters
from mptc_gym.parameters import ARGUMENTS
from mptc_gym.ranges import Ranges, numbers_of_plant
from tests.conftest import run

OTHER = {"delay": 7, "gain_factor": 1.3, "time_constant_factor": 2.0, "dead_zone": 0.0}
DRIFT = {"gain_drift": 0.6, "time_constant_drift": 1.5, "drift_samples": 90}


def outputs(rng, samples=120, **arguments):
    """Return random flows and what the environment makes of them."""
    found = run(MiddlePointEnv(**arguments), rng.uniform(-1, 1, samples - 1))
    return np.append(found["applied"][1:], 0.0), found["output"]


def test_the_nominal_model_is_the_environment(rng):
    flow, output = outputs(rng, **OTHER)
    model = nominal(Parameters(**OTHER))
    np.testing.assert_allclose(model.response(flow), output, rtol=0, atol=1e-12)
    assert model.gain == pytest.approx(1.3 * nominal(Parameters()).gain)
    assert model.step_response()[-1] == pytest.approx(model.gain, rel=1e-4)
    assert np.max(1 / (1 - model.poles.real)) == pytest.approx(
        2.0 * np.max(1 / (1 - nominal(Parameters()).poles.real))
    )


def test_a_course_is_the_environment_while_it_drifts(rng):
    arguments = {**OTHER, **DRIFT}
    flow, output = outputs(rng, **arguments)
    parameters = Parameters(**arguments)
    of_plant = time_varying_model(
        parameters, numbers_of_plant(Ranges(parameters).given, 0), len(flow)
    )
    np.testing.assert_allclose(of_plant.flow_response() @ flow, output, rtol=0, atol=1e-12)
    assert np.abs(nominal(parameters).response(flow) - output).max() > 0.1


def test_ranges_stand_for_their_middle_and_what_is_added_does_not_show():
    more = {"disturbance_amplitude": 1.0, "gain_drift": 0.5}
    drawn = Parameters(delay=[4, 10], gain_factor=[1.0, 1.6], **more)
    assert nominal(drawn) == nominal(Parameters(delay=7, gain_factor=1.3))


def test_an_integrating_plant_has_a_gain_of_one_sign():
    assert LinearModel([1.0, -1.0], [-0.1]).gain == -np.inf


@pytest.mark.parametrize("a", [(1.0,), (1.0, -0.9), (1.0, -1.2, 0.5)])
def test_responses_of_many_plants_at_once(a):
    b, c = [0.3, -0.1, 0.2], (1.0, 0.4, 0.1)
    ones = np.ones((2, 1))
    many = Coefficients(-np.array(a[1:]) * ones, np.array(b) * ones, np.ones(2))
    alone = LinearModel(a, b).response(np.eye(1, 30)[0])
    np.testing.assert_allclose(many.impulse_response(29), [alone[1:]] * 2, atol=1e-12)

    F, g = many.state_space(c)
    state, noise = g, []
    for _ in range(30):
        noise.append(state[0])
        state = F[0] @ state
    np.testing.assert_allclose(noise, signal.lfilter(c, a, np.eye(1, 30)[0]), atol=1e-12)


ANALYSES = {
    "bound": lambda **p: least_possible(samples=30, folder=None, **p),
    "frontier": lambda **p: frontier(samples=30, **p),
    "step test": lambda **p: step_test(Parameters(**p)),
    "NN": lambda **p: engineered.direct_nn(Parameters(**p), 1, 0),
    "PI": lambda **p: engineered.simc_pi(Parameters(**p), 1, 0),
    "Smith": lambda **p: engineered.smith(Parameters(**p), 1, 0),
    "self-tuning": lambda **p: engineered.self_tuning(Parameters(**p), 1, 0),
    "MPC": lambda **p: PredictiveController(Parameters(**p), 1),
    "margins": lambda **p: Loop(PIController(), nominal(Parameters(**p))),
}


@pytest.fixture
def nonlinear_span(monkeypatch):
    """As if the span were declared as more than (28) and (29)."""
    span = replace(ARGUMENTS["temperature_span"], linear=False)
    monkeypatch.setattr(linear, "ARGUMENTS", {**ARGUMENTS, "temperature_span": span})


@pytest.mark.usefixtures("nonlinear_span")
def test_the_command_for_bounds_says_that_a_plant_is_not_linear(refused):
    said = refused(command.main, ["--set", "temperature_span=49"])
    assert "temperature_span=49: temperature_span must be 50.0" in said


@pytest.mark.usefixtures("nonlinear_span")
@pytest.mark.parametrize("analysis", ANALYSES)
def test_every_analysis_refuses_an_argument_that_is_not_declared_linear(analysis):
    ANALYSES[analysis]()
    with pytest.raises(ValueError, match=r"^temperature_span must be 50\.0 .* got 49\.0"):
        ANALYSES[analysis](temperature_span=49.0)
