"""Test the self-tuning controller: its bank of models, its filters and its hedge."""

import numpy as np
import pytest
from scipy import signal

from agents import SelfTuningController, output_filter
from agents.bank import FAST_POLE, GAIN_SPREAD, NOISE_COLOUR
from agents.hedge import RandomSetpoint
from agents.output_filter import LOAD_MEMORY, READING_SHARE, OutputFilter
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


def test_gain_and_load_are_those_of_all_samples_at_once(rng, monkeypatch):
    # The unknowns and the outputs are jointly normal: condition them in one step.
    pole, variance, samples = 0.95, 0.04, 60
    change, drift = 0.02, output_filter.GAIN_CHANGE * GAIN_SPREAD
    monkeypatch.setattr(output_filter, "LOAD_CHANGES", np.array([change]))
    monkeypatch.setattr(output_filter, "NOISE_SHARES", np.array([1.0]))
    responses = np.cumsum(rng.normal(size=samples)) / 5.0
    outputs = 1.1 * responses + 0.2 * rng.normal(size=samples)
    kalman = OutputFilter(1)
    for output, response, last in zip(outputs, responses, [0.0, *responses], strict=False):
        newest = np.array([[response], [last]])
        kalman.update(np.array([output]), newest, np.array([pole]), np.array([variance]))
    a1, a2 = pole + FAST_POLE, -pole * FAST_POLE
    # Responses of v(k), k = 1 to the last, to unit xi(j) and eta(j), in column j.
    units, of_v = np.eye(samples), [1.0, -a1, -a2]
    of_noise = signal.lfilter([1.0, NOISE_COLOUR[0]], of_v, units, axis=0)
    w = signal.lfilter([1.0], [1.0, -LOAD_MEMORY], units, axis=0)
    of_load = signal.lfilter([1.0 - a1 - a2], of_v, w, axis=0)
    walks = np.minimum.outer(np.arange(1, samples + 1), np.arange(1, samples + 1))
    gains = GAIN_SPREAD**2 + drift**2 * walks
    covariance = (1.0 - READING_SHARE) * variance * of_noise @ of_noise.T
    covariance += change**2 * of_load @ of_load.T + responses[:, None] * gains * responses
    covariance += READING_SHARE * variance * np.eye(samples)
    surprise = np.linalg.solve(covariance, outputs - responses)
    gain = 1.0 + gains[-1] * responses @ surprise
    assert kalman.gain[0] == pytest.approx(gain, abs=1e-9)
    load = change**2 * (of_load @ w[-1]) @ surprise
    assert kalman.load[0] == pytest.approx(load, abs=1e-9)


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
