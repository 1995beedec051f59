"""The linear model against the environment, its step test, and the poles of loops."""

import numpy as np
import pytest
from scipy import signal

from agents import DahlinController, PIController, SmithPredictor
from benchmarks.loop.linear import LinearLoop, nominal, step_test, time_constant_for, unfit
from mptc_gym import MiddlePointEnv, Parameters
from tests.conftest import STEP_TEST, run

OTHER = {"delay": 7, "gain_factor": 1.3, "time_constant_factor": 2.0, "dead_zone": 0.0}


def test_the_nominal_model_is_the_environment(rng):
    record = run(MiddlePointEnv(**OTHER), rng.uniform(-1, 1, 119))
    flow = record["applied"][1:]
    model = nominal(Parameters(**OTHER))
    impulse = np.append(np.zeros(7 + 1), model.impulse_response(120))
    output = np.convolve(impulse, flow)[:120]
    np.testing.assert_allclose(output, record["output"], rtol=0, atol=1e-12)
    assert model.impulse_response(900).sum() == pytest.approx(model.gain, rel=1e-4)


def test_ranges_stand_for_their_middle_and_what_is_added_does_not_show():
    added = {"disturbance_amplitude": 1.0, "gain_drift": 0.5}
    drawn = Parameters(delay=[4, 10], gain_factor=[1.0, 1.6], **added)
    middle = Parameters(delay=7, gain_factor=1.3)
    assert step_test(drawn) == step_test(middle)
    np.testing.assert_array_equal(nominal(drawn).beta, nominal(middle).beta)


def test_paper_plant_shows_the_numbers_its_controllers_are_tuned_with():
    numbers = step_test(Parameters())
    # Steady-state gain -0.0496 / 0.0727, the time constant of the pole at 0.9515, 19 samples.
    assert numbers == {**STEP_TEST, "sampling_interval": 8.0}
    slow = step_test(Parameters(sampling_interval=80.0))
    assert [*slow.values()] == [-0.6825, 1610.0, 1520.0, 80.0]


@pytest.mark.parametrize("gain", [-0.3, 0.02, 4.0])
@pytest.mark.parametrize("time_constant", [4.0, 60.0, 900.0])
@pytest.mark.parametrize("delay", [1, 5, 80])
def test_plant_of_first_order_shows_its_own_numbers(gain, time_constant, delay):
    pole = np.exp(-8.0 / time_constant)
    plant = Parameters(a=[1.0, -pole], b=[gain * (1.0 - pole)], delay=delay - 1)
    numbers = step_test(plant)
    assert numbers["gain"] == pytest.approx(gain, rel=1e-3)
    assert numbers["time_constant"] == pytest.approx(time_constant, rel=0.01, abs=1.0)
    assert numbers["delay"] == 8.0 * delay


def test_plant_without_a_new_steady_state_is_refused():
    for name, values in (("a", [1.0, -1.0]), ("a", [1.0, -1.1]), ("b", [0.1, -0.1])):
        with pytest.raises(ValueError, match=f"^{name} must"):
            step_test(Parameters(**{name: values}))
    # The gain of one that integrates has a sign.
    assert nominal(Parameters(a=[1.0, -1.0], b=[-0.1])).gain == -np.inf


def test_an_integrator_with_rounding_errors_has_the_sign_of_its_b():
    a = np.convolve([1.0, -1.0], np.convolve([1.0, -0.7], [1.0, -0.1]))  # A(1) = -8e-17
    assert sum(a.tolist()) != 0.0
    assert nominal(Parameters(a=a.tolist(), b=[0.1])).gain == np.inf
    assert "the plant integrates" in unfit(Parameters(a=a.tolist(), b=[0.1]))


@pytest.mark.parametrize(
    ("sentence", "arguments"),
    [
        ("", {}),
        ("the plant integrates", {"a": [1.0, -1.0]}),
        ("the plant is not stable", {"a": [1.0, -1.1]}),
        ("the gain of the plant is 0", {"b": [0.1, -0.1]}),
        ("the plant is static", {"a": [1.0], "b": [0.5]}),
        ("use a sampling_interval of 140 s", {"a": [1.0, -0.999], "b": [0.001]}),
        ("the plant resonates", {"a": [1.0, -1.9, 0.999], "b": [0.1]}),
        ("no flow from u_min=5 to u_max=10 t/h", {"u_min": 5.0, "setpoint": 5.0}),
        ("", {"u_min": 5.0, "setpoint": -5.0}),
    ],
)
def test_a_plant_that_the_commands_cannot_serve_is_refused_in_a_sentence(sentence, arguments):
    found = unfit(Parameters(**arguments))
    assert sentence in found
    assert bool(found) == bool(sentence)


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


class Proportional:
    """u = Kp e."""

    def __init__(self, kp):
        self.kp = kp

    def transfer(self):
        return np.array([self.kp]), np.array([1.0])


def loop_with_integrator(kp, delay):
    """Return the loop of y(k+1) = y(k) + u(k-d), u = Kp e."""
    integrator = nominal(Parameters(a=[1.0, -1.0], b=[1.0], delay=delay))
    return LinearLoop.of(Proportional(kp), integrator)


# Stable for Kp < 2 sin(pi / (4 d + 2)), which is 2, 1, 0.618, 0.445, ... for d = 0, 1, 2, 3.
@pytest.mark.parametrize(("kp", "longest"), [(0.61, 2), (0.63, 1), (1.01, 0)])
def test_an_integrator_is_stable_up_to_a_delay(kp, longest):
    assert loop_with_integrator(kp, longest).is_stable()
    unstable = loop_with_integrator(kp, longest + 1)
    assert not unstable.is_stable()
    assert unstable.sensitivity() == np.inf


def test_sensitivity_by_hand():
    # For d = 0, |S| is largest at z = -1.
    assert loop_with_integrator(0.61, 0).sensitivity() == pytest.approx(2.0 / (2.0 - 0.61))


@pytest.mark.parametrize("damping", [0.02, 0.1, 1.0])
@pytest.mark.parametrize(("frequency", "delay"), [(0.02, 200), (0.02, 3), (1.0, 0), (0.2, 20)])
def test_sensitivity_is_that_of_a_dense_grid(damping, frequency, delay):
    poles = np.exp(frequency * np.array([1j, -1j]) * np.emath.sqrt(1.0 - damping**2))
    a = np.real(np.poly(poles * np.exp(-damping * frequency)))
    plant = nominal(Parameters(a=a.tolist(), b=[0.6 * a.sum(), 0.4 * a.sum()], delay=delay))
    for kp in (-0.01, -0.1, -0.5):
        loop = LinearLoop.of(PIController(kp, 0.1 * kp / (delay + 1.0 / frequency)), plant)
        if loop.largest_pole() >= 1.0:
            assert loop.sensitivity() == np.inf
            continue
        polynomials = loop.denominator, loop.characteristic
        values = [signal.freqz(polynomial, worN=200_000)[1] for polynomial in polynomials]
        most = np.abs(values[0] / values[1]).max()
        assert loop.sensitivity() == pytest.approx(most, rel=0.02)


@pytest.mark.parametrize("time_constant", [40.0, 4e3, 4e4])
def test_slow_loops_are_as_stable_as_fast_ones(time_constant):
    # The closed loop of SIMC is as fast as the delay, which is in proportion.
    delay = round(time_constant / 4)
    pole = np.exp(-1.0 / time_constant)
    plant = nominal(Parameters(a=[1.0, -pole], b=[1.0 - pole], delay=delay - 1))
    numbers = {"gain": 1.0, "time_constant": time_constant, "sampling_interval": 1.0}
    controller = PIController.simc(**numbers, delay=delay)
    assert LinearLoop.of(controller, plant).sensitivity() == pytest.approx(1.58, abs=0.03)


def test_a_rule_is_slowed_down_until_its_sensitivity_is_the_target():
    plant = nominal(Parameters())

    def simc(time_constant):
        return PIController.simc(**STEP_TEST, closed_loop_time_constant=time_constant)

    time_constant_found = time_constant_for(1.6, simc, plant, 5000.0, 1.0)
    assert LinearLoop.of(simc(time_constant_found), plant).sensitivity() == pytest.approx(
        1.6, rel=1e-4
    )
    assert time_constant_for(1.7, simc, plant, 5000.0, 1.0) < time_constant_found
    assert time_constant_for(1.6, simc, plant, 5000.0, 200.0) == 200.0  # none is too fast
    with pytest.raises(ValueError, match=r"no time constant up to 10 s .* Ms of 1\.6"):
        time_constant_for(1.6, simc, plant, 10.0, 1.0)
