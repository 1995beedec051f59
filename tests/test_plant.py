"""The plant (28) and the actuator (29), against things that are independent of them."""

import numpy as np
import pytest
from scipy.signal import lfilter

import mptc_gym
from mptc_gym import MiddlePointEnv, MiddlePointVectorEnv
from mptc_gym.plant import Plant, action_from_command, float32_action
from mptc_gym.ranges import Ranges
from mptc_gym.signals import EpisodeStream
from tests.conftest import run

A = [1, -0.45181, -0.47546]
B = [-0.04560, -0.00404]
C = [1, -0.35740, -0.03392]


def step(action: float, **arguments: float) -> tuple[float, float, float]:
    parameters = mptc_gym.Parameters(**arguments)
    return Plant(parameters, Ranges(parameters).given).step(action, 0.0, 0.0)


def applied(
    command: float, u_min: float = -10.0, u_max: float = 10.0, **others: float
) -> float:
    action = action_from_command(command, u_min, u_max)
    return step(action, u_min=u_min, u_max=u_max, **others)[1]


@pytest.mark.parametrize(
    ("a", "b", "c", "delay"),
    [
        (A, B, C, 18),
        ([1.0], [0.7], [1.0], 0),
        ([1.0, -0.5], [0.0, 0.2, -0.1], [1.0, 0.3], 1),
        ([1.0, -1.2, 0.5, -0.1], [0.4], [1.0, 0.1, 0.2, 0.3], 5),
    ],
)
def test_dynamics_equal_a_transfer_function_with_noise(a, b, c, delay, rng):
    env = mptc_gym.MiddlePointEnv(a=a, b=b, c=c, delay=delay, noise_variance=1.0)
    record = run(env, rng.uniform(-1, 1, 500))
    # u(k) and u_a(k) are reported with sample k+1; B begins at z^-1, and d more delays it.
    by_input = lfilter([0] * (delay + 1) + b, a, np.r_[record["applied"][1:], 0.0])
    by_noise = lfilter([1], a, record["noise"])
    np.testing.assert_allclose(record["output"], by_input + by_noise, rtol=0, atol=1e-11)
    assert np.ptp(by_input) > 1.0  # both parts matter here
    assert np.ptp(by_noise) > 1.0


@pytest.mark.parametrize(("size", "expected"), [
    (0.0, 0.0), (4.999, 0.0), (5.0, 5.0), (7.5, 7.5), (10.0, 10.0), (10.001, 10.0),
    (1e300, 10.0),
])  # fmt: skip
def test_actuator_whose_edge_passes(size, expected):
    assert (applied(size), applied(-size)) == (expected, -expected)


@pytest.mark.parametrize(
    ("command", "arguments", "expected"),
    [
        (0.1, {"dead_zone": 0.0}, 0.1),
        (6.9, {"dead_zone": 7.0}, 0.0),
        (-12.0, {"u_min": -4.0}, -4.0),  # saturation comes after the dead zone
        (4.0, {"u_min": -4.0}, 0.0),
        (3.0, {"u_min": 6.0, "u_max": 8.0, "dead_zone": 2.0}, 6.0),
    ],
)
def test_actuator_with_other_limits(command, arguments, expected):
    assert applied(command, **arguments) == pytest.approx(expected, abs=1e-12)


def test_scaling_by_hand():
    for action, command in [(-1.0, -4.0), (0.0, 2.0), (1.0, 8.0), (2.0, 14.0)]:
        assert step(action, u_min=-4.0, u_max=8.0)[0] == command
        assert action_from_command(command, -4.0, 8.0) == action


EDGES = [
    *((edge, -10.0, 10.0) for edge in (0.1, 4.1, 5.0, 6.3, 6.5, 7.0, 9.0, 9.9, 10.0)),
    (2.0, -6.0, 8.0), (5.0, -5.0, 15.0), (0.3, -0.4, 0.7), (9.3, -10.1, 9.3),
    (1e-3, -1.0, 1e6), (7.0, -1e9, 7.0),
]  # fmt: skip


@pytest.mark.parametrize(("dead_zone", "u_min", "u_max"), EDGES)
def test_a_command_on_the_edge_of_the_dead_zone_passes_in_float32(dead_zone, u_min, u_max):
    arguments = {"dead_zone": dead_zone, "u_min": u_min, "u_max": u_max}
    reached = [edge for edge in (-dead_zone, dead_zone) if u_min <= edge <= u_max]
    for command in reached:
        action = float32_action(command, u_min, u_max, dead_zone)
        assert action.dtype == np.float32
        env, envs = MiddlePointEnv(**arguments), MiddlePointVectorEnv(1, **arguments)
        env.reset(seed=0), envs.reset(seed=0)
        passed = env.step(action.reshape(1))[-1]["applied"]
        # Rounding to float32 makes 1.2e-7 of the range, at the most.
        assert passed == pytest.approx(command, abs=1.3e-7 * (u_max - u_min))
        assert abs(passed) >= dead_zone
        assert envs.step(action.reshape(1, 1))[-1]["applied"][0] == passed


def test_only_commands_on_the_edge_are_moved(rng):
    commands = rng.uniform(-12, 12, 1000)
    plain = action_from_command(commands, -10.0, 10.0).astype(np.float32)
    np.testing.assert_array_equal(float32_action(commands, -10.0, 10.0, 7.0), plain)
    inside = np.nextafter(7.0, 0.0)  # stays inside
    assert applied(7.0, dead_zone=7.0) == 7.0
    assert step(float(float32_action(inside, -10, 10, 7.0)), dead_zone=7.0)[1] == 0.0
    # Many at a time, each with limits of its own.
    dead_zones = np.array([4.1, 6.3, 7.0])
    for sign in (-1, 1):
        actions = float32_action(
            sign * dead_zones, -10.0, np.array([10.0, 11.0, 12.0]), dead_zones
        )
        for action, dead_zone, u_max in zip(
            actions, dead_zones, (10.0, 11.0, 12.0), strict=True
        ):
            _, passed, _ = step(float(action), dead_zone=dead_zone, u_max=u_max)
            assert passed == pytest.approx(sign * dead_zone, abs=2e-6)


def test_episodes_of_a_seed_do_not_overlap_however_long_they_are():
    stream = EpisodeStream(0, (0,))
    first = stream.next_episode().random(2_000_000)
    second = stream.next_episode().random(10)
    third = stream.next_episode().random(10)
    assert not np.isin([second, third], first).any()
    assert not np.isin(second, third).any()
