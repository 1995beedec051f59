"""Test what is off by default: transmitter noise, load, other dynamics, fouling, ranges."""

import gymnasium
import numpy as np
import pytest
from scipy.signal import lfilter

from mptc_gym import PRESETS, MiddlePointEnv, parameters
from tests.arguments import STRATEGIES
from tests.conftest import ROOT, run

GAIN = -0.04964 / 0.07273  # B(1) / A(1), degC per t/h
POLE = 0.45181 / 2 + np.sqrt(0.45181**2 / 4 + 0.47546)  # of z^2 - 0.45181 z - 0.47546
EVERYTHING = {
    "noise_variance": [0.2, 0.8], "measurement_noise_variance": [0.1, 0.2],
    "disturbance_amplitude": [1.0, 3.0], "disturbance_interval": [20, 60],
    "disturbance_walk_variance": [0.001, 0.01], "gain_factor": [0.7, 1.4],
    "time_constant_factor": [0.7, 1.4], "gain_drift": [0.7, 1.4],
    "time_constant_drift": [0.7, 1.4], "drift_samples": 300, "delay": [3, 25],
    "dead_zone": [3, 7], "u_min": [-12, -9], "u_max": [9, 12], "setpoint": "random",
    "output_window": 2, "action_window": 2,
}  # fmt: skip


class TestDeclarations:
    def test_what_a_seed_draws_never_changes(self):
        # Which draw a plant number takes is part of what a seed means.
        released = {
            "delay": 0, "dead_zone": 1, "u_min": 2, "u_max": 3, "noise_variance": 4,
            "measurement_noise_variance": 5, "disturbance_amplitude": 6,
            "disturbance_interval": 7, "disturbance_walk_variance": 8, "gain_factor": 9,
            "time_constant_factor": 10, "gain_drift": 11, "time_constant_drift": 12,
        }  # fmt: skip
        assert released.items() <= parameters.PLANT_NUMBERS.items()

    def test_draws_by_hand(self):
        env = MiddlePointEnv(delay=[3, 6], time_constant_drift=[1.0, 3.0])
        _, info = env.reset(seed=7)
        # The third of the seed's streams is the plant's; draw 0 is the delay's, 12 the drift's.
        stream = np.random.SeedSequence(7).spawn(4)[2]
        draws = np.random.Generator(np.random.PCG64(stream)).random(32)
        assert info["delay"] == 3 + int(4 * draws[0])
        assert info["time_constant_drift"] == 1.0 + 2.0 * draws[12]

    def test_every_argument_is_tried_in_all_combinations(self):
        assert set(STRATEGIES) == set(parameters.ARGUMENTS)


class TestTransmitter:
    def test_the_observation_sees_its_noise_and_nothing_else_does(self, rng):
        actions = rng.uniform(-1, 1, 5_000)
        plant = {"noise_variance": 0.5, "output_window": 1}
        true = run(MiddlePointEnv(**plant), actions)
        seen = run(MiddlePointEnv(measurement_noise_variance=0.09, **plant), actions)
        for name in ("output", "error", "reward", "noise"):
            np.testing.assert_array_equal(seen[name], true[name])
        noise = seen["observation"][:, -1] - seen["output"]
        assert noise[0] == 0.0  # at rest
        assert noise.var() == pytest.approx(0.09, rel=0.1)
        assert abs(np.corrcoef(noise[1:], seen["noise"][1:])[0, 1]) < 0.06
        # The error that is shown is that of the reading.
        np.testing.assert_allclose(
            seen["observation"][:, 3], seen["setpoint"] - seen["observation"][:, -1], atol=1e-5
        )

    def test_the_reading_saturates_and_the_truth_does_not(self):
        noisy = {"measurement_noise_variance": 100.0, "temperature_span": 5.0}
        record = run(MiddlePointEnv(output_window=1, **noisy), -np.ones(300))
        assert np.abs(record["observation"][:, -1]).max() == 5.0
        assert record["output"][-1] > 6.8


class TestDisturbance:
    @pytest.mark.parametrize("slower", [1.0, 2.0])
    def test_with_noise_it_passes_through_the_dynamics_and_its_gain_is_1(self, slower):
        signals = {"disturbance_amplitude": 4.0, "disturbance_walk_variance": 0.01}
        env = MiddlePointEnv(time_constant_factor=slower, noise_variance=0.5, **signals)
        record = run(env, np.zeros(1000))
        assert np.ptp(record["disturbance"]) > 4.0
        # The other pole of the paper's plant, 0.45181 - POLE, stays where it is.
        a = np.convolve([1, (1 - POLE) / slower - 1], [1, POLE - 0.45181])
        driven = a.sum() * record["disturbance"] + record["noise"]
        np.testing.assert_allclose(record["output"], lfilter([1], a, driven), atol=1e-10)


class TestDynamics:
    def test_drift_ends_at_the_plant_that_factors_give(self):
        drifting = MiddlePointEnv(
            gain_factor=0.8, gain_drift=1.5, time_constant_drift=2.0, drift_samples=200
        )
        record = run(drifting, np.ones(3000))
        k = np.arange(3001)
        share = np.minimum(k // 10 * 10 / 200, 1.0)  # linear, every 10 samples
        np.testing.assert_allclose(record["gain_factor"], 0.8 * (1 + 0.5 * share), rtol=1e-12)
        np.testing.assert_allclose(record["time_constant_factor"], 1 + share, rtol=1e-12)
        assert record["output"][-1] == pytest.approx(10 * 0.8 * 1.5 * GAIN, rel=1e-9)


class TestRanges:
    def test_a_drawn_plant_is_the_plant_with_these_numbers_to_the_bit(self, rng):
        drawn_plant = MiddlePointEnv(**EVERYTHING)
        actions = rng.uniform(-1.2, 1.2, 700)
        for seed in range(5):
            _, info = drawn_plant.reset(seed=seed)
            ranges = {name for name, value in EVERYTHING.items() if isinstance(value, list)}
            assert ranges <= set(info)
            drawn = {name: info[name] for name in ranges}
            assert type(drawn["delay"]) is int
            numbers = {**EVERYTHING, **drawn}
            ours = run(drawn_plant, actions, seed)
            theirs = run(MiddlePointEnv(**numbers), actions, seed)
            assert set(ours) == set(theirs)
            for name in ours:
                np.testing.assert_array_equal(ours[name], theirs[name])

    def test_draws_come_from_the_seed_and_the_episode_alone(self):
        first, second = (MiddlePointEnv(**EVERYTHING) for _ in range(2))
        before = run(first, np.ones(1500), seed=5)
        run(second, -np.ones(2), seed=5)
        ours, theirs = (run(env, np.zeros(300), seed=None) for env in (first, second))
        for name in ours:
            np.testing.assert_array_equal(ours[name], theirs[name])
        for name in ("noise", "setpoint", "disturbance", "gain_factor"):
            assert not np.array_equal(before[name][:301], ours[name])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"delay": [3, 2]}, "delay must be .* low <= high"),
        ({"delay": [3.5, 4]}, "delay must be an integer"),
        ({"dead_zone": [1, 2, 3]}, r"dead_zone must be one number, or a range \[low, high\]"),
        ({"dead_zone": [0, 11]}, "dead_zone must be small enough"),
        ({"dead_zone": 8, "u_min": [-9, -7], "u_max": [7, 9]}, "dead_zone must be small"),
        ({"u_min": [-10, 10]}, "u_min must be below"),
        ({"disturbance_walk_variance": [0, float("nan")]}, "disturbance_walk_variance must"),
        ({"time_constant_factor": 0.01}, "time_constant_factor, .* never below 0.048"),
        ({"time_constant_factor": 2, "a": [1.0]}, "which has no pole, not one"),
        ({"time_constant_factor": 2, "a": [1.0, 0.0, 0.5]}, r"slowest pole .*0\.7.*j, not one"),
        ({"time_constant_factor": 2, "a": [1.0, -1.0]}, r"slowest pole 1\+0j, not one between"),
        ({"disturbance_amplitude": 1, "a": [1.0, -1.0]}, "not stable"),
        ({"setpoint_window": 0, "error_window": 0}, "error_window"),
    ],
)  # fmt: skip
def test_bad_options_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        MiddlePointEnv(**arguments)
    with pytest.raises(ValueError, match=message):
        gymnasium.make_vec("MiddlePoint-v0", 2, **arguments)


def test_every_preset_is_documented():
    page = (ROOT / "mptc_gym/README.md").read_text(encoding="utf-8")
    assert all(f"`{name}`" in page for name in PRESETS)
