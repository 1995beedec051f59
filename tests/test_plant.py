"""The plant (28) and the actuator (29), against things that are independent of them."""

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

import mptc_gym
from agents import actuator
from mptc_gym.plant.dynamics import Plant, action_from_command, float32_action
from mptc_gym.plant.parameters import PlantNumbers
from mptc_gym.plant.sampling import EpisodeStream
from tests.conftest import run

A = [1, -0.45181, -0.47546]
B = [-0.04560, -0.00404]
C = [1, -0.35740, -0.03392]


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


def exact(command, u_min, u_max, dead_zone):
    return action_from_command(command, u_min, u_max)


@pytest.mark.parametrize("scaled", [exact, float32_action, actuator.float32_action])
@settings(max_examples=50, deadline=None)
@given(
    u_min=st.floats(-20, 5),
    reach=st.floats(0.01, 30),
    dead_zone=st.floats(0.01, 15),
    beyond=st.sampled_from([0.0, 1e-12, 1e-9, 1e-7, 1e-4]),
)
@example(u_min=-10.0, reach=20.0, dead_zone=7.0, beyond=0.0)
@example(u_min=-10.0, reach=20.0, dead_zone=4.1, beyond=0.0)
@example(u_min=-6.0, reach=16.0, dead_zone=7.0, beyond=0.0)  # -7 t/h lies below u_min
@example(u_min=-5.0, reach=24.2, dead_zone=7.1, beyond=0.0)  # an action of about 0
@example(u_min=-1e9, reach=1e9 + 7.0, dead_zone=7.0, beyond=0.0)
def test_a_command_on_the_edge_of_the_dead_zone_passes_as_an_action(
    scaled, u_min, reach, dead_zone, beyond
):
    u_max = u_min + reach
    edge = dead_zone * (1.0 + beyond)
    assume(scaled is not exact or edge <= max(abs(u_min), abs(u_max)))  # others are refused
    numbers = PlantNumbers(delay=0.0, dead_zone=dead_zone, u_min=u_min, u_max=u_max)
    for command in (np.float64(-edge), np.float64(edge)):
        action = scaled(command, u_min, u_max, dead_zone)
        assert action.dtype == (np.float64 if scaled is exact else np.float32)
        plant = Plant(mptc_gym.Parameters(), numbers)
        arrived, passed, _ = plant.step(action.item(), 0.0, 0.0)
        assert passed == np.clip(arrived, u_min, u_max)  # and not 0: saturation comes after
        within = plant.step(action_from_command(0.999 * command, u_min, u_max), 0.0, 0.0)
        assert within[1] == 0.0
        # Rounding to float32 makes 1.2e-7 of the range, at the most.
        assert arrived == pytest.approx(command, abs=1.3e-7 * (reach + abs(u_min) + edge))


@pytest.mark.parametrize("scaled", [float32_action, actuator.float32_action])
def test_only_commands_on_the_edge_are_moved_each_by_its_own_limits(scaled, rng):
    commands = rng.uniform(-12, 12, 1000)
    plain = action_from_command(commands, -10.0, 10.0).astype(np.float32)
    np.testing.assert_array_equal(scaled(commands, -10.0, 10.0, 7.0), plain)
    inside = scaled(np.nextafter(7.0, 0.0), -10, 10, 7.0)  # stays inside
    numbers = PlantNumbers(delay=0.0, dead_zone=7.0, u_min=-10.0, u_max=10.0)
    assert Plant(mptc_gym.Parameters(), numbers).step(inside.item(), 0.0, 0.0)[1] == 0.0
    zones, limits = np.array([4.1, 6.3, 7.0]), np.array([10.0, 11.0, 12.0])
    alone = [
        scaled(zone, -10.0, limit, zone) for zone, limit in zip(zones, limits, strict=True)
    ]
    np.testing.assert_array_equal(scaled(zones, -10.0, limits, zones), alone)


def test_an_episode_begins_2_to_the_64_draws_after_the_one_before_it():
    # Of NumPy's own generator. What follows from a seed is published, later episodes included.
    stream, draws = EpisodeStream(7, (1,)), np.random.SeedSequence(7, spawn_key=(1,))
    whole = np.random.Generator(np.random.PCG64(draws))
    for _ in range(3):
        np.testing.assert_array_equal(stream.next_episode().random(5), whole.random(5))
        whole.bit_generator.advance(2**64 - 5)
