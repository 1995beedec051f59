"""Test the self-tuning controller: its filter, its candidates and its hedge."""

import copy
import pickle

import numpy as np
import pytest
from scipy import signal

from agents import SelfTuningController, estimator
from agents.estimator import (
    FAST_POLE,
    FIRST_NOISE,
    FIRST_NOISE_SAMPLES,
    LOAD_MEMORY,
    NEWER_SHARE,
    NOISE_COLOUR,
    Candidates,
    Estimator,
)
from agents.hedge import RandomSetpoint
from benchmarks.loop.runs import make_plants, simulate
from tests.conftest import STEP_TEST

KNOWN = {**STEP_TEST, "dead_zone": 5.0}
GAIN, TIME_CONSTANT = -0.6825, 161.0  # of the paper's plant, degC per t/h and s


@pytest.fixture
def observations(rng):
    """Return observations of three loops in 120 samples, shape (samples, loops, 4)."""
    setpoints = np.repeat(rng.uniform(-5.0, 5.0, (3, 3)), 40, axis=0)
    errors = 0.3 * setpoints + 0.1 * np.cumsum(rng.normal(size=(120, 3)), axis=0)
    zeros = np.zeros_like(errors)
    return np.stack([setpoints, zeros, zeros, errors], axis=2)


@pytest.mark.parametrize(
    ("delay", "gain", "time_constant", "noise"),
    [(8, 1.4, 0.7, 0.0), (18, 1.0, 1.0, 0.1), (33, 0.8, 1.5, 0.1)],
)
def test_it_identifies_the_plant(delay, gain, time_constant, noise):
    controller = SelfTuningController(**KNOWN)
    plants = make_plants(
        2, 1200, delay=delay, gain_factor=gain, noise_variance=noise,
        time_constant_factor=time_constant, setpoint_period=240,
    )  # fmt: skip
    simulate(plants, controller, 1200, 5_900_000)
    estimates = controller.estimates
    assert estimates["delay"] == pytest.approx(np.full(2, 8.0 * (delay + 1)), abs=1.0)
    assert estimates["gain"] == pytest.approx(np.full(2, GAIN * gain), rel=0.1)
    constant = np.full(2, TIME_CONSTANT * time_constant)
    assert estimates["time_constant"] == pytest.approx(constant, rel=0.25)


def polynomials(pole):
    """Return the polynomials A and B of a candidate with this slow pole."""
    A = np.convolve([1.0, -pole], [1.0, -FAST_POLE])
    return A, A.sum() * np.array([0.0, NEWER_SHARE, 1.0 - NEWER_SHARE])


def test_the_forecast_is_that_of_all_samples_at_once(rng, monkeypatch):
    # The residuals of one candidate are jointly normal: condition the future on the past.
    pole, delay, samples, load_change, gain = 0.9, 3, 300, 0.2, 1.3
    monkeypatch.setattr(estimator, "LOAD_CHANGES", (load_change,))
    monkeypatch.setattr(estimator, "GAIN_LIMITS", (gain, gain))
    time_constants = np.array([-1.0 / np.log(pole)])
    plants = Estimator(Candidates(time_constants, np.array([delay]), np.zeros((1, 1))), 1)
    flows, outputs = rng.normal(size=(2, samples))
    for output, flow in zip(outputs, flows, strict=True):
        estimate = plants.observe(np.array([output]))
        plants.apply(np.array([flow]))

    A, B = polynomials(pole)
    response = signal.lfilter(B, A, np.concatenate([np.zeros(delay), flows]))[:samples]
    residuals = outputs - gain * response
    # Responses of r(k), up to d + 1 samples ahead, to unit xi(j) and eta(j) in column j.
    units = np.eye(samples + delay + 1)
    of_noise = signal.lfilter([1.0, NOISE_COLOUR], A, units, axis=0)
    of_load = signal.lfilter([A.sum()], np.convolve(A, [1.0, -LOAD_MEMORY]), units, axis=0)
    covariance = of_noise @ of_noise.T + load_change**2 * of_load @ of_load.T
    past = covariance[:samples, :samples]
    of_past = np.linalg.solve(past, covariance[:samples, -1])
    assert estimate.forecast[0] == pytest.approx(of_past @ residuals, abs=1e-6)
    # The variance of the noise is a mean of its prior and of the squared one-step errors.
    squares = (
        residuals @ np.linalg.solve(past, residuals) + FIRST_NOISE_SAMPLES * FIRST_NOISE**2
    )
    variance = covariance[-1, -1] - of_past @ covariance[:samples, -1]
    deviation = np.sqrt(squares / (FIRST_NOISE_SAMPLES + samples) * variance)
    assert estimate.deviation[0] == pytest.approx(deviation, rel=0.01)


def test_without_noise_the_candidate_that_is_the_plant_is_found(rng):
    time_constants, delays, gain, delay = np.array([10.0, 20.0, 40.0]), np.arange(2, 9), 1.6, 5
    plants = Estimator(Candidates(time_constants, delays, np.zeros((7, 3))), 1)
    flows = rng.normal(size=400)
    A, B = polynomials(np.exp(-1.0 / 20.0))
    outputs = gain * signal.lfilter(B, A, np.concatenate([np.zeros(delay), flows]))
    for output, flow in zip(outputs, flows, strict=False):
        estimate = plants.observe(np.array([output]))
        plants.apply(np.array([flow]))
    assert estimate.delay == pytest.approx(delay, abs=1e-3)
    assert estimate.gain == pytest.approx(gain, rel=1e-3)
    assert estimate.time_constant == pytest.approx(20.0, rel=1e-3)


def test_no_other_target_has_less_error(rng):
    hedge = RandomSetpoint(shortest=100.0, longest=300.0, amplitude=5.0)
    levels = rng.uniform(-5.0, 5.0, 200_000)
    noise = rng.logistic(scale=0.6 / 1.702, size=levels.size)
    for setpoint, held in ((4.0, 0.9), (4.0, 0.55), (-3.0, 0.7)):
        stays = rng.random(levels.size) < held
        wanted = np.where(stays, setpoint, levels)
        candidates = np.linspace(min(setpoint, 0.0), max(setpoint, 0.0), 81)
        losses = [np.abs(wanted - target - noise).mean() for target in candidates]
        best = candidates[np.argmin(losses)]
        target = hedge.targets(np.array([setpoint]), np.array([held]), np.array([0.6]))
        assert target[0] == pytest.approx(best, abs=0.12)


@pytest.mark.parametrize("dead_zone", [5.0, 7.0])
def test_every_command_is_0_or_passes_the_dead_zone(observations, dead_zone):
    controller = SelfTuningController(**STEP_TEST, dead_zone=dead_zone)
    for rows in np.concatenate([scale * observations for scale in (1.0, 1e3, 1e6, 1.0)]):
        controller.act(rows)
        size = np.abs(controller.command)
        assert ((size == 0.0) | (size >= dead_zone) & (size <= 10.0)).all()
    multiples = controller.estimates["gain"] / GAIN
    assert multiples == pytest.approx(multiples.clip(0.3, 3.0))


def test_neither_a_wrong_gain_nor_a_steady_load_leaves_an_offset():
    controller = SelfTuningController(**{**KNOWN, "dead_zone": 0.0})
    load = {"disturbance_amplitude": 2.0, "disturbance_interval": 1e6, "setpoint": 4.0}
    plants = make_plants(1, 900, dead_zone=0.0, gain_factor=1.2, **load)
    trajectory = simulate(plants, controller, 900, 5_900_000)
    errors = (trajectory.setpoint - trajectory.output)[700:]
    assert np.abs(errors).mean() < 0.05


@pytest.mark.parametrize(("time_constant", "delay"), [(5, 20), (10, 40), (20, 20)])
def test_a_calm_plant_stays_calm(time_constant, delay):
    # A plant of first order, which equals its step test, and on which nothing ever happens.
    pole, gain = np.exp(-1.0 / time_constant), -0.7
    plant = {"a": (1.0, -pole), "b": (gain * (1.0 - pole),), "c": (1.0,), "dead_zone": 0.0}
    test = {"gain": gain, "time_constant": 8.0 * time_constant, "delay": 8.0 * (delay + 1)}
    plants = make_plants(1, 3000, **plant, delay=delay, setpoint=4.0)
    trajectory = simulate(plants, SelfTuningController(**test, dead_zone=0.0), 3000, 0)
    errors = trajectory.setpoint - trajectory.output
    assert np.abs(errors[600:]).max() < 0.02


def test_one_plant_with_a_gain_above_0_and_one_sided_limits():
    test = {"gain": 0.5, "time_constant": 160.0, "delay": 80.0, "u_min": 0.0, "u_max": 20.0}
    pole = np.exp(-1.0 / 20.0)
    plant = {"a": (1.0, -pole), "b": (0.6 * (1.0 - pole),), "c": (1.0,), "delay": 9}
    plant |= {"u_min": 0.0, "u_max": 20.0, "dead_zone": 2.0, "setpoint": 6.0}
    controller = SelfTuningController(**test, dead_zone=2.0)
    trajectory = simulate(make_plants(1, 600, **plant), controller, 600, 0)
    assert np.abs(trajectory.setpoint - trajectory.output)[300:].max() < 0.02
    assert controller.estimates["gain"] == pytest.approx([0.6], rel=0.05)


@pytest.mark.parametrize("renewed", [copy.deepcopy, lambda c: pickle.loads(pickle.dumps(c))])
def test_a_copy_in_mid_episode_goes_on_alike(observations, renewed):
    controller = SelfTuningController(**KNOWN, setpoint_holds=(80.0, 800.0))
    for rows in observations[:60]:
        controller.act(rows)
    twin = renewed(controller)
    for rows in observations[60:]:
        assert np.array_equal(controller.act(rows), twin.act(rows))
    assert np.array_equal(controller.estimates["delay"], twin.estimates["delay"])


def test_each_loop_of_a_batch_is_a_single_loop(observations):
    batch = SelfTuningController(**KNOWN)
    singles = [SelfTuningController(**KNOWN) for _ in range(3)]
    for rows in observations:
        alone = [single.act(row) for single, row in zip(singles, rows, strict=True)]
        np.testing.assert_allclose(batch.act(rows), alone, atol=1e-5)


class TestScales:
    """Commands do not depend on the units of flow, temperature and time."""

    def commands(self, observations, flow=1.0, temperature=1.0, time=1.0):
        controller = SelfTuningController(
            gain=GAIN * temperature / flow,
            time_constant=TIME_CONSTANT * time,
            delay=STEP_TEST["delay"] * time,
            sampling_interval=8.0 * time,
            dead_zone=5.0 * flow,
            u_min=-10.0 * flow,
            u_max=10.0 * flow,
        )
        commands = []
        for rows in observations:
            controller.act(rows * temperature)
            commands.append(controller.command / flow)
        return np.array(commands)

    @pytest.mark.parametrize("scale", [{"flow": 10.0}, {"temperature": 4.0}, {"time": 0.1}])
    def test_commands_scale_with_the_units(self, observations, scale):
        plain = self.commands(observations)
        scaled = self.commands(observations, **scale)
        np.testing.assert_allclose(scaled, plain, atol=0.01)

    def test_a_slow_plant_is_sampled_less_often(self, observations):
        known = {"gain": GAIN, "dead_zone": 5.0}
        plain, slow = (
            SelfTuningController(time_constant=45.0 * time, delay=19.0 * time, **known)
            for time in (8.0, 32.0)
        )
        for rows in observations:
            plain.act(rows)
            for _ in range(4):
                slow.act(rows)
                np.testing.assert_allclose(slow.command, plain.command, atol=0.01)


def test_a_set_point_that_may_soon_change_is_hedged():
    plant = {"gain": -0.7, "time_constant": 160.0, "delay": 152.0, "dead_zone": 0.0}

    def hedge(setpoints):
        """Return the difference in flow between a hedging controller and one that does not."""
        flows = []
        for holds in (None, (800.0, 2400.0)):  # s; 100 to 300 samples
            controller = SelfTuningController(**plant, setpoint_holds=holds)
            # The output has settled at the set point.
            observations = [[level, 0.0, 0.0, 0.0] for level in setpoints]
            flows.append([controller.act(row)[0] for row in observations])
        return np.subtract(flows[1], flows[0])

    constant = hedge([4.0] * 290)
    # The shortest hold time is 100 samples, and a flow affects the output after 20 samples.
    assert np.abs(constant[:60]).max() < 1e-6
    # More flow lowers the temperature, towards the mean of the next set point.
    assert constant[240:].min() > 0.1
    # The time until the next change begins anew with each set point.
    assert np.abs(hedge(([4.0] * 70 + [3.9] * 70) * 2)).max() < 1e-6
