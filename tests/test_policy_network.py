"""Trained networks in NumPy: what they compute, keep and refuse."""

import itertools
import json

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from agents import Increments, PolicyNetwork
from mptc_gym import MiddlePointEnv
from mptc_gym.wrappers import IncrementalAction

WINDOWS = {"setpoint_window": 1, "output_window": 2, "action_window": 2}


def layers(*sizes):
    generator = np.random.default_rng(0)
    return [
        (generator.normal(size=(after, before)), generator.normal(size=after))
        for before, after in itertools.pairwise(sizes)
    ]


def policy(**arguments):
    given = {"observation": WINDOWS, "input_scale": [0.2] * 3 + [1.0] * 2, **arguments}
    return PolicyNetwork(**{"layers": layers(5, 7, 6, 1), **given})


def constant(value, **arguments):
    """Return a network whose output before scaling is the same whatever it sees."""
    only = [(np.zeros((1, 1)), np.array([value]))]
    return PolicyNetwork(only, observation={"error_window": 1}, input_scale=[1.0], **arguments)


class TestForward:
    @pytest.mark.parametrize("activation", ["elu", "relu", "tanh"])
    def test_equals_torch(self, activation):
        torch = pytest.importorskip("torch")
        network = policy(activation=activation)
        x = np.random.default_rng(1).uniform(-2, 2, size=(50, 5))
        functions = {"elu": torch.nn.functional.elu, "relu": torch.relu, "tanh": torch.tanh}
        h = torch.tensor(np.float32(x) * network.input_scale)
        for i, (W, b) in enumerate(network.layers):
            h = torch.nn.functional.linear(h, torch.tensor(W), torch.tensor(b))
            h = functions[activation](h) if i < len(network.layers) - 1 else h
        expected = h.clamp(-1.0, 1.0).numpy()
        assert np.abs(expected).min() < 0.9  # not all at the limits
        # PyTorch adds in another order; 1e-5 is some hundred roundings of float32.
        assert network.act(x) == pytest.approx(expected, abs=1e-5)

    def test_commands_fit_other_limits(self):
        network = constant(0.5, u_min=-4.0, u_max=8.0)
        assert network.act([[0.0]]) == pytest.approx(0.5)
        assert network.command == pytest.approx(5.0)  # three quarters of the way up

    @pytest.mark.parametrize("size", [4, 6])
    def test_an_observation_of_other_windows_is_refused_with_what_it_needs(self, size):
        message = r"^observation must .*5[ ,].*environment needs the network's `observation`"
        with pytest.raises(ValueError, match=message):
            policy().act(np.zeros(size))


class TestIncrements:
    @settings(max_examples=60, deadline=None)
    @given(
        u_min=st.floats(-15, -0.5),
        u_max=st.floats(0.5, 15),
        dead_zone=st.floats(0, 12),
        max_move=st.floats(0.01, 2),
        outputs=st.lists(st.floats(-1.5, 1.5), min_size=1, max_size=12),
    )
    @example(u_min=-12.0, u_max=6.0, dead_zone=4.0, max_move=0.1, outputs=[0.1, 0.1])
    def test_it_is_the_velocity_form_of_the_wrapper(
        self, u_min, u_max, dead_zone, max_move, outputs
    ):
        network = PolicyNetwork(
            [(np.ones((1, 1)), np.zeros(1))], observation={"error_window": 1},
            input_scale=[1.0], increments=Increments(max_move, dead_zone),
            u_min=u_min, u_max=u_max,
        )  # fmt: skip
        plant = MiddlePointEnv(dead_zone=0.0, u_min=u_min, u_max=u_max)
        wrapped = IncrementalAction(plant, max_move=max_move, compensate_dead_zone=dead_zone)
        wrapped.reset(seed=0)
        for output in np.float32(outputs):
            network.act([output])
            command = wrapped.step(output[np.newaxis])[-1]["command"]
            # Where the wanted flow is 0 but for rounding, its sign is chance.
            if max(abs(command), abs(network.command)) > dead_zone + 1e-5:
                assert network.command == pytest.approx(command, abs=2e-5)

    @pytest.mark.parametrize("side", [-1.0, 1.0])
    def test_the_smallest_flow_beyond_the_dead_zone_is_applied(self, side):
        # float32(0.7) stands for less than 7 t/h.
        network = constant(1e-12 * side, increments=Increments(max_move=0.4, dead_zone=7.0))
        env = MiddlePointEnv(dead_zone=7.0)
        env.reset(seed=0)
        info = env.step(network.act([0.0]))[-1]
        assert info["applied"] == pytest.approx(7.0 * side, abs=1e-5)

    def test_another_batch_within_an_episode_is_refused(self):
        network = constant(0.5, increments=Increments(max_move=0.8))
        network.act([[0.0], [0.0]])
        with pytest.raises(ValueError, match="until reset"):
            network.act([[0.0]])


class TestFile:
    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"format": 99}, "format is 99"),
            ({"layers": 2}, r"weights of layers\[1\]"),
            ({"increments": {"step": 1}}, "step"),
            ({"observation": 3}, "damaged"),
        ],
    )
    def test_what_does_not_fit_is_named(self, tmp_path, change, message):
        path = tmp_path / "policy.npz"
        policy().save(path)
        with np.load(path) as file:
            arrays = dict(file)
        arrays["about"] = json.dumps(json.loads(str(arrays["about"])) | change)
        np.savez(path, **arrays)
        with pytest.raises(ValueError, match=message):
            PolicyNetwork.load(path)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"observation": {"window": 5}}, "observation"),
        ({"observation": {"output_window": 5.0}}, "output_window"),
        ({"observation": {"output_window": 4}}, "input_scale"),
        ({"input_scale": [1.0] * 4 + [np.inf]}, "input_scale must be finite"),
        ({"activation": "elu "}, "activation"),
        ({"u_min": 10.0}, "u_max"),
        ({"activation": ["elu"]}, "activation must be"),
        ({"u_max": 10**400}, "u_max must be"),
        ({"input_scale": ["1"] * 5}, "input_scale must be numbers"),
        ({"layers": []}, "layers must hold at least one"),
        ({"layers": layers(4, 3, 1)}, r"weights of layers\[0\] must have shape \(3, 5\)"),
        ({"layers": layers(5, 3, 2)}, r"weights of layers\[1\] must have shape \(1, 3\)"),
        ({"layers": [(np.full((1, 5), np.nan), np.zeros(1))]}, r"layers\[0\] must be finite"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        policy(**arguments)
