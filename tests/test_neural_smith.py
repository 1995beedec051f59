"""The trained network: what it is invariant to, what it settles to, and what it refuses."""

from dataclasses import asdict
from functools import partial

import numpy as np
import pytest

from agents import LawNetwork, NeuralSelfTuningController, NeuralSmithPredictor, SmithPredictor
from benchmarks.controllers.mpc import PredictiveController
from benchmarks.loop.linear import step_test
from benchmarks.loop.rollout import make_plants, rollout
from mptc_gym import Parameters

SHOWN = {"gain": -0.6825, "time_constant": 161.0, "delay": 152.0}
NETWORK = LawNetwork.load()
told = partial(NeuralSmithPredictor, **SHOWN, network=NETWORK)


def response(controller, setpoint, output):
    """Return the commands after what a loop has seen, t/h."""
    commands = []
    for wanted, measured in zip(setpoint, output, strict=True):
        controller.act([wanted, 0.0, 0.0, wanted - measured])
        commands.append(controller.command)
    return np.array(commands)


def error_of(controller, samples=600, start=0, **plant):
    run = rollout(make_plants(1, samples, **plant), controller, samples, seed=0)
    return np.abs(run.setpoint - run.output)[start:].mean()


@pytest.fixture
def seen(rng):
    """Return set points and outputs of 200 samples, degC."""
    setpoint = np.repeat(rng.uniform(-5.0, 5.0, 5), 40)
    return setpoint, 0.7 * setpoint + np.cumsum(rng.normal(size=200)) * 0.1


@pytest.mark.parametrize(
    ("make", "commands"),
    [
        (NeuralSmithPredictor, [5.045, 21.073, 26.834, 39.262, 23.213]),
        (NeuralSelfTuningController, [10.56, 53.156, 32.792, 86.13, 48.734]),
    ],
)
def test_the_law_is_that_of_the_training_whatever_the_sign_of_the_gain(make, commands, seen):
    down = response(make(**SHOWN, dead_zone=5.0, u_min=-8.0, u_max=10.0), *seen)
    rising = {**SHOWN, "gain": 0.6825}
    up = response(make(**rising, dead_zone=5.0, u_min=-10.0, u_max=8.0), *seen)
    assert up[39::40].ravel() == pytest.approx(commands, abs=1e-3)
    np.testing.assert_allclose(down, -up, atol=1e-9)


class TestScales:
    def test_of_flows(self, seen):
        plain = response(told(dead_zone=5.0), *seen)
        large = {**SHOWN, "gain": -0.06825}
        other = NeuralSmithPredictor(
            **large, dead_zone=50.0, u_min=-100.0, u_max=100.0, network=NETWORK
        )
        np.testing.assert_allclose(response(other, *seen), 10.0 * plain, rtol=1e-9)

    def test_of_temperatures(self, seen):
        plain = response(told(dead_zone=5.0), *seen)
        other = NeuralSmithPredictor(**{**SHOWN, "gain": -2.73}, dead_zone=5.0, network=NETWORK)
        np.testing.assert_allclose(
            response(other, 4.0 * seen[0], 4.0 * seen[1]), plain, rtol=1e-9
        )

    def test_of_times(self, seen):
        minutes = {"gain": -0.6825, "time_constant": 161.0 / 60, "delay": 152.0 / 60}
        other = NeuralSmithPredictor(**minutes, sampling_interval=8.0 / 60, network=NETWORK)
        np.testing.assert_allclose(response(other, *seen), response(told(), *seen), rtol=1e-6)

    def test_a_slow_plant_is_sampled_less_often(self, seen):
        # Four times the time constant and the delay: it acts every fourth sample, and sees
        # what it would have seen.
        slow = NeuralSmithPredictor(
            gain=-0.6825, time_constant=45.0 * 32.0, delay=19.0 * 32.0, network=NETWORK
        )
        plain = NeuralSmithPredictor(
            gain=-0.6825, time_constant=45.0 * 8.0, delay=19.0 * 8.0, network=NETWORK
        )
        stretched = [np.repeat(each, 4) for each in seen]
        np.testing.assert_allclose(
            response(slow, *stretched), np.repeat(response(plain, *seen), 4), rtol=1e-9
        )


class TestLoop:
    def test_a_wrong_gain_leaves_no_offset(self):
        plant = {"setpoint": 5.0, "gain_factor": 1.2}
        assert error_of(told(dead_zone=5.0), 600, 500, **plant) < 0.05

    def test_it_is_better_than_a_smith_predictor_of_the_same_model(self):
        plant = {"noise_variance": 0.3, "setpoint_amplitude": 4.7}
        smith = SmithPredictor(**SHOWN, closed_loop_time_constant=80.0, dead_zone=5.0)
        assert error_of(told(dead_zone=5.0), 1200, **plant) < 0.97 * error_of(
            smith, 1200, **plant
        )

    @pytest.mark.parametrize(
        "plant",
        [
            {"a": [1.0, -0.97], "b": [0.03], "c": [1.0]},
            {"a": [1.0, -2.4, 1.91, -0.504], "b": [0.002, 0.002, 0.002], "c": [1.0]},
            {"delay": 60, "time_constant_factor": 0.25},
        ],
    )
    def test_a_plant_unlike_those_of_the_training(self, plant):
        shown = asdict(step_test(Parameters(**plant)))
        controller = NeuralSmithPredictor(**shown, dead_zone=2.0, network=NETWORK)
        amplitude = 5.0 * abs(shown["gain"])
        square = {"setpoint_amplitude": amplitude, "dead_zone": 2.0}
        late = error_of(controller, 300, 250, **plant, **square)
        assert late < 0.05 * amplitude

    @pytest.mark.parametrize(
        ("outside", "times"),
        [
            ({"noise_variance": 0.4}, 1.03),
            ({"disturbance_amplitude": 1.5, "disturbance_interval": 150.0}, 1.2),
        ],
    )
    def test_a_load_is_told_from_noise(self, outside, times):
        # Once it has seen some; what knows the plant and its noise sets the scale.
        plant = {"setpoint": 5.0, "delay": 14, **outside}
        shown = asdict(step_test(Parameters(**plant)))
        ours = NeuralSmithPredictor(**shown, dead_zone=5.0, network=NETWORK)
        best = PredictiveController(Parameters(**plant), 16)
        errors = [
            np.abs(
                rollout(make_plants(16, 900, **plant), each, 900, 7_000_000).next_error[300:]
            )
            for each in (ours, best)
        ]
        assert errors[0].mean() < times * errors[1].mean()


def test_a_file_of_other_layers_is_refused(tmp_path):
    layers = [(np.zeros((3, 4)), np.zeros(3))] * 3
    LawNetwork(layers, layers).save(tmp_path / "network.npz")
    with pytest.raises(ValueError, match=r"weights of layers\[0\] must have shape"):
        LawNetwork.load(tmp_path / "network.npz")
