"""The self-tuning controller: what it finds out about plants, and what it does not fall for."""

import numpy as np
import pytest

from agents import (
    NeuralSelfTuningController,
    NeuralSmithPredictor,
    SelfTuningController,
    SmithPredictor,
    self_tuning,
)
from benchmarks.loop.metrics import travel
from benchmarks.loop.rollout import make_plants, rollout
from mptc_gym import PRESETS, evaluate

STEP_TEST = {"gain": -0.6825, "time_constant": 161.0, "delay": 152.0, "dead_zone": 5.0}
# Steady-state gain of (28), degC per t/h, and 1 / (1 - p) samples of 8 s, p its slowest pole.
GAIN = (-0.04560 - 0.00404) / (1.0 - 0.45181 - 0.47546)
TIME_CONSTANT = 8.0 / (1.0 - 0.95147)


def control(controller, samples=1200, runs=1, seed=5_900_000, **plant):
    """Run a controller, and return what happened."""
    return rollout(make_plants(runs, samples, **plant), controller, samples, seed)


def mean_error(trajectory, start=0):
    return np.abs(trajectory.setpoint - trajectory.output)[start:].mean()


@pytest.mark.parametrize(
    ("delay", "gain", "time_constant"), [(8, 1.5, 0.6), (18, 1.0, 1.0), (33, 0.8, 1.8)]
)
@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_it_finds_out_what_the_plant_is(delay, gain, time_constant, noise):
    controller = SelfTuningController(**STEP_TEST)
    control(
        controller, runs=2, delay=delay, gain_factor=gain, noise_variance=noise,
        time_constant_factor=time_constant, dead_zone=0.0, setpoint_period=240,
    )  # fmt: skip
    found = controller.estimates
    assert found["delay"] == pytest.approx(np.full(2, 8.0 * (delay + 1)), abs=16.0)
    assert found["gain"] == pytest.approx(np.full(2, GAIN * gain), rel=0.1)
    assert found["time_constant"] == pytest.approx(
        np.full(2, TIME_CONSTANT * time_constant), rel=0.2
    )


def test_before_it_has_learnt_it_is_what_the_step_test_says():
    controller = SelfTuningController(**{**STEP_TEST, "dead_zone": 3.5})
    assert controller.estimates == {}
    controller.act(np.zeros(6))
    found = controller.estimates
    assert found["gain"] == pytest.approx(-0.6825)
    assert found["delay"] == pytest.approx(152.0, rel=0.05)
    assert found["time_constant"] == pytest.approx(161.0, rel=0.15)
    assert found["dead_zone"] == 3.5


def test_noise_before_the_first_response_moves_the_gain_little():
    # The first input shows in sample 31, and there is noise of 1 degC a sample.
    controller = SelfTuningController(**STEP_TEST)
    control(controller, samples=40, runs=20, delay=30, noise_variance=1.0, setpoint=0.5)
    ratio = controller.estimates["gain"] / -0.6825
    assert ratio.min() > 0.6
    assert ratio.max() < 1.4


@pytest.mark.parametrize("gain", [(1.5, 0.85), (0.85, 1.5)])
def test_it_follows_a_plant_that_drifts(gain):
    first, last = gain
    plant = {
        "gain_factor": first, "gain_drift": last / first, "noise_variance": 0.05, "delay": 8,
        "runs": 3,
    }  # fmt: skip
    tuning = SelfTuningController(**STEP_TEST)
    fixed = SmithPredictor(**STEP_TEST, closed_loop_time_constant=80.0)
    ours, theirs = (mean_error(control(each, **plant), 600) for each in (tuning, fixed))
    assert ours < theirs - 0.1
    assert tuning.estimates["gain"] == pytest.approx(np.full(3, GAIN * last), rel=0.2)


def test_it_finds_the_dead_zone_that_it_was_not_told(monkeypatch):
    # 5 degC take 6.1 t/h here, which does not pass: the loop has to find it out.
    plant = {"dead_zone": 7.5, "gain_factor": 1.2, "noise_variance": 0.05, "runs": 3}
    knowing = SelfTuningController(**STEP_TEST)
    monkeypatch.setattr(self_tuning, "ZONES", (0.0,))
    told = SelfTuningController(**STEP_TEST)
    ours, theirs = (mean_error(control(each, **plant), 600) for each in (knowing, told))
    assert (knowing.estimates["dead_zone"] >= 6.5).all()
    assert (told.estimates["dead_zone"] == 5.0).all()
    assert ours < theirs


def test_it_reckons_with_the_dead_zone_that_it_is_told():
    controller = SelfTuningController(**{**STEP_TEST, "dead_zone": 7.3})
    control(controller, dead_zone=7.3, noise_variance=0.05)
    assert controller.estimates["dead_zone"] == [7.3]


@pytest.mark.parametrize(
    ("told", "dead_zone", "setpoint"), [(7.0, 7.0, 5.2), (5.0, 5.8, 4.4), (5.0, 6.0, 4.4)]
)
def test_the_network_does_not_hunt_beside_a_dead_zone(told, dead_zone, setpoint):
    controller = NeuralSelfTuningController(**{**STEP_TEST, "dead_zone": told})
    found = evaluate(
        controller, episodes=2, max_episode_steps=600, dead_zone=dead_zone, setpoint=setpoint
    )
    assert found.travel < 80.0


def test_behind_the_bank_the_network_takes_no_load_for_a_gain():
    plant = PRESETS["disturbed"] | {"setpoint_amplitude": 4.5, "delay": 14, "runs": 20}
    ours, theirs = (
        mean_error(control(make(**{**STEP_TEST, "delay": 120.0}), **plant))
        for make in (NeuralSelfTuningController, SelfTuningController)
    )
    assert ours < theirs - 0.015


@pytest.mark.parametrize(
    "plant", [{}, {"time_constant_factor": 1.5}, {"setpoint": 5.0}, {"delay": 21}]
)
def test_on_a_calm_plant_the_valve_is_as_calm_as_with_the_model_given(plant):
    # Where the given numbers are wrong, both learn of it once; then nothing is left to do.
    shown = {**STEP_TEST, "delay": 8.0 * (plant.get("delay", 18) + 1)}
    given, tuning = (
        control(make(**shown), **plant)
        for make in (NeuralSmithPredictor, NeuralSelfTuningController)
    )
    assert travel(tuning)[0] < 1.2 * travel(given)[0] + 2.0
    assert mean_error(tuning) < 1.04 * mean_error(given)


def test_no_dead_zone_is_assumed_unless_told():
    shown = {name: value for name, value in STEP_TEST.items() if name != "dead_zone"}
    plant = {"dead_zone": 0.0, "noise_variance": 0.1, "setpoint": 1.0}
    unaware, told = (
        travel(control(SelfTuningController(**shown, **dead_zone), **plant))[0]
        for dead_zone in ({}, {"dead_zone": 5.0})
    )
    assert SelfTuningController(**shown).dead_zone == 0.0
    assert unaware < 0.5 * told


def test_haste_is_paid_for_in_valve_travel():
    def travelled(**aggressiveness):
        controller = NeuralSelfTuningController(**STEP_TEST, **aggressiveness)
        return travel(control(controller, 500, 6, noise_variance=0.5)).mean()

    assert travelled(aggressiveness=0.0) < 0.75 * travelled()


def test_thousands_of_quiet_samples_teach_nothing():
    controller, estimates = SelfTuningController(**STEP_TEST), []
    setpoint = [0.0] + [5.0] * 300 + [-5.0] * 300 + [0.0]  # the last one is held
    plants = make_plants(1, 6_000, setpoint=setpoint, delay=26, gain_factor=1.3)

    def watch(k):
        if k in (1500, 5_999):
            estimates.append(controller.estimates)

    trajectory = rollout(plants, controller, 6_000, 0, watch)
    assert not trajectory.applied[1500:].any()
    before, after = estimates
    assert before["delay"] == pytest.approx(8.0 * 27, abs=16.0)
    for name, values in after.items():
        assert values == pytest.approx(before[name], rel=1e-6), name


def test_nothing_bursts_in_noise_without_changes_of_the_set_point():
    plant = {"setpoint": 5.0, "noise_variance": 0.3, "delay": 26, "runs": 2}
    controller = SelfTuningController(**STEP_TEST)
    trajectory = control(controller, samples=6000, **plant)
    errors = np.abs(trajectory.setpoint - trajectory.output).reshape(6, 1000, 2).mean((1, 2))
    assert errors[1:].max() < 1.5 * errors[1:].min()
    assert controller.estimates["gain"] == pytest.approx(np.full(2, GAIN), rel=0.4)


def test_a_gain_of_the_wrong_sign_is_not_believed():
    controller = SelfTuningController(**STEP_TEST)
    control(controller, b=[0.04560, 0.00404], runs=2)
    assert (controller.estimates["gain"] <= 0.3 * -0.6825 + 1e-12).all()


def test_nonsense_does_not_lead_it_beyond_its_bounds(rng):
    controller = SelfTuningController(**STEP_TEST)
    for scale in (1.0, 1e3, 1e6, 1.0):
        for _ in range(200):
            controller.act(rng.normal(size=(3, 6)) * scale)
            assert np.isfinite(controller.command).all()
    found = controller.estimates
    for values, low, high in ((found["gain"] / -0.6825, 0.3, 3.0), (found["delay"], 56, 296)):
        assert values.min() >= low
        assert values.max() <= high


def test_no_offset_remains_under_a_steady_load():
    controller = SelfTuningController(**STEP_TEST)
    trajectory = control(
        controller, samples=1500, setpoint=4.0, dead_zone=0.0,
        disturbance_amplitude=2.0, disturbance_interval=1e6, delay=12,
    )  # fmt: skip
    assert mean_error(trajectory, 1300) < 0.05
