"""Compare the plant (28) and the actuator (29) with independent computations."""

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

import mptc_gym
from mptc_gym.plant.actuator import (
    action_from_command,
    applied_flow,
    command_from_action,
    float32_action,
    least_effective_command,
)
from mptc_gym.plant.dynamics import Plant, PlantBatch
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
    # The info of sample k+1 holds u_a(k). B begins at z^-1, and the delay is d further samples.
    effect_of_flow = lfilter([0] * (delay + 1) + b, a, np.r_[record["applied"][1:], 0.0])
    effect_of_noise = lfilter([1], a, record["noise"])
    output = effect_of_flow + effect_of_noise
    np.testing.assert_allclose(record["output"], output, rtol=0, atol=1e-11)
    assert np.ptp(effect_of_flow) > 1.0  # both effects are large enough to be compared
    assert np.ptp(effect_of_noise) > 1.0


def float64_action(command, u_min, u_max, dead_zone):
    return action_from_command(command, u_min, u_max)


@pytest.mark.parametrize("to_action", [float64_action, float32_action])
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
@example(u_min=-5.0, reach=24.2, dead_zone=7.1, beyond=0.0)  # the action is about 0
@example(u_min=-1e9, reach=1e9 + 7.0, dead_zone=7.0, beyond=0.0)
def test_a_command_on_the_edge_of_the_dead_zone_passes_as_an_action(
    to_action, u_min, reach, dead_zone, beyond
):
    u_max = u_min + reach
    edge = dead_zone * (1.0 + beyond)
    # An environment refuses a dead zone that no command in float64 can pass.
    assume(to_action is not float64_action or edge <= max(abs(u_min), abs(u_max)))
    numbers = PlantNumbers(delay=0.0, dead_zone=dead_zone, u_min=u_min, u_max=u_max)
    for command in (np.float64(-edge), np.float64(edge)):
        action = to_action(command, u_min, u_max, dead_zone)
        assert action.dtype == (np.float64 if to_action is float64_action else np.float32)
        plant = Plant(mptc_gym.Parameters(), numbers)
        received, applied, _ = plant.step(action.item(), 0.0, 0.0)
        assert applied == np.clip(received, u_min, u_max)  # not 0: the dead zone comes first
        inside = action_from_command(0.999 * command, u_min, u_max)
        assert plant.step(inside, 0.0, 0.0)[1] == 0.0
        # Rounding to float32 is an error of at most 1.2e-7 of the range.
        assert received == pytest.approx(command, abs=1.3e-7 * (reach + abs(u_min) + edge))


@pytest.mark.parametrize(
    "limits", [(-10.0, 10.0, 7.0), (-1.0, 12.0, 7.1), (3.0, 5.0, 4.1), (0.0, 4.0, 0.0)]
)
def test_plants_apply_what_the_actuator_defines(limits, rng):
    u_min, u_max, dead_zone = limits
    edge = least_effective_command(dead_zone, u_min, u_max)
    just_inside = np.nextafter(edge, 0.0)
    commands = np.array([edge, -edge, just_inside, -just_inside, dead_zone, u_min, u_max, 0.0])
    actions = action_from_command(np.r_[commands, rng.uniform(-15, 15, 100)], u_min, u_max)
    expected_commands = command_from_action(actions, u_min, u_max)
    expected_flows = applied_flow(expected_commands, edge, u_min, u_max)
    parameters = mptc_gym.Parameters(u_min=u_min, u_max=u_max, dead_zone=dead_zone)
    n = len(actions)
    commands, flows, _ = PlantBatch(parameters, n).step(actions, np.zeros(n))
    np.testing.assert_array_equal(commands, expected_commands)
    np.testing.assert_array_equal(flows, expected_flows)
    plant = Plant(parameters, parameters.lowest)
    for action, command, flow in zip(actions, expected_commands, expected_flows, strict=True):
        assert plant.step(action.item(), 0.0, 0.0)[:2] == (command, flow)


def test_rounding_moves_an_action_by_one_spacing_of_float32(rng):
    # Limits inside the dead zone, so that actions on its edge are beyond 1.
    limits = rng.uniform(0.5, 4.0, 2000)
    edges = limits * rng.uniform(1.0, 8.0, 2000) * rng.choice([-1.0, 1.0], 2000)
    rounded = action_from_command(edges, -limits, limits).astype(np.float32)
    moved = float32_action(edges, -limits, limits, np.abs(edges))
    is_moved = moved != rounded
    assert 500 < is_moved.sum() < 1500
    outwards = np.copysign(np.inf, edges).astype(np.float32)
    np.testing.assert_array_equal(
        moved[is_moved], np.nextafter(rounded[is_moved], outwards[is_moved])
    )


def test_only_commands_on_the_edge_are_moved_each_by_its_own_limits(rng):
    commands = rng.uniform(-12, 12, 1000)
    rounded = action_from_command(commands, -10.0, 10.0).astype(np.float32)
    np.testing.assert_array_equal(float32_action(commands, -10.0, 10.0, 7.0), rounded)
    inside = float32_action(np.nextafter(7.0, 0.0), -10, 10, 7.0)
    numbers = PlantNumbers(delay=0.0, dead_zone=7.0, u_min=-10.0, u_max=10.0)
    assert Plant(mptc_gym.Parameters(), numbers).step(inside.item(), 0.0, 0.0)[1] == 0.0
    zones = np.array([4.1, 6.3, 7.0])
    limits = np.array([10.0, 11.0, 12.0])
    one_by_one = [float32_action(zones[i], -10.0, limits[i], zones[i]) for i in range(3)]
    np.testing.assert_array_equal(float32_action(zones, -10.0, limits, zones), one_by_one)


def test_an_episode_begins_2_to_the_64_random_numbers_after_the_previous_episode():
    # All published numbers, also those of later episodes, depend on this distance.
    stream = EpisodeStream(7, (1,))
    seeds = np.random.SeedSequence(7, spawn_key=(1,))
    generator = np.random.Generator(np.random.PCG64(seeds))
    for _ in range(3):
        np.testing.assert_array_equal(stream.next_episode().random(5), generator.random(5))
        generator.bit_generator.advance(2**64 - 5)
