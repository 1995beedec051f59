"""The bank of models, the law and its network, which is the same in both libraries."""

from functools import partial

import numpy as np
import pytest
import torch

from agents import NeuralSelfTuningController, NeuralSmithPredictor, SelfTuningController
from agents.bank import GAIN_MEMORY, LAGS, Bank, Prior, Whitening, second_order
from agents.law import Law, Observer
from benchmarks.loop.rollout import make_plants, rollout
from benchmarks.train.neural import Net
from tests.conftest import STEP_TEST

KNOWN = {**STEP_TEST, "dead_zone": 5.0}
GAIN, TIME_CONSTANT = -0.6825, 161.0  # of the paper's plant, degC per t/h and s
DELAY, CONSTANT = 5, 12.0  # samples


def lively_net():
    """Return a network whose outputs matter."""
    torch.manual_seed(3)
    net = Net(nodes=8, hidden=6)
    with torch.no_grad():
        net.output.weight.mul_(10.0)
    return net


@pytest.fixture
def network():
    return lively_net().export()


@pytest.fixture
def make(network):
    return partial(NeuralSelfTuningController, **KNOWN, network=network)


@pytest.fixture
def observations(rng):
    """Return observations of three loops in 120 samples, shape (samples, loops, 4)."""
    setpoints = np.repeat(rng.uniform(-5.0, 5.0, (3, 3)), 40, axis=0)
    errors = 0.3 * setpoints + 0.1 * np.cumsum(rng.normal(size=(120, 3)), axis=0)
    zeros = np.zeros_like(errors)
    return np.stack([setpoints, zeros, zeros, errors], axis=2)


def single_model(gain_spread):
    return Prior(
        time_constants=[[CONSTANT]],
        shortest_delays=[DELAY],
        log_probabilities=[[[0.0]]],
        gain_spread=[gain_spread],
    )


def simulated(flows):
    """Return the outputs of a model of gain 1 by its difference equation."""
    a1, a2, newer, older = second_order(np.array(CONSTANT))
    outputs = np.zeros(len(flows))
    for k in range(1, len(flows)):
        newest, before = (flows[i] if i >= 0 else 0.0 for i in (k - DELAY - 1, k - DELAY - 2))
        outputs[k] = a1 * outputs[k - 1] + newer * newest + older * before
        if k >= 2:
            outputs[k] += a2 * outputs[k - 2]
    return outputs


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
    rollout(plants, controller, 1200, 5_900_000)
    estimates = controller.estimates
    assert estimates["delay"] == pytest.approx(np.full(2, 8.0 * (delay + 1)), abs=16.0)
    assert estimates["gain"] == pytest.approx(np.full(2, GAIN * gain), rel=0.1)
    constant = np.full(2, TIME_CONSTANT * time_constant)
    assert estimates["time_constant"] == pytest.approx(constant, rel=0.25)


def test_the_steady_state_of_the_model_is_that_of_the_step_test():
    outputs = simulated(np.ones(300))
    assert outputs[: DELAY + 1].tolist() == [0.0] * (DELAY + 1)
    assert outputs[-1] == pytest.approx(1.0, abs=1e-6)


def test_a_single_exact_model_leaves_what_it_does_not_explain(rng):
    bank, flows, load = Bank(single_model(1e-3)), rng.uniform(-1.0, 1.0, 80), 0.25
    outputs = simulated(flows) + load
    for flow, output in zip(flows, outputs, strict=True):
        bank.observe(np.array([output], np.float32))
        bank.apply(np.array([flow], np.float32))
    assert bank.residuals[:, 0] == pytest.approx([load] * LAGS, abs=1e-3)


def test_the_gain_is_that_of_weighted_least_squares(rng):
    spread, samples = 0.3, 61
    bank, flows = Bank(single_model(spread)), rng.uniform(-1.0, 1.0, samples)
    responses = simulated(flows)
    outputs = 1.2 * responses + 0.1 * rng.normal(size=samples)
    filters = Whitening((1,)), Whitening((1,))
    regressors, whitened, noises = [], [], []
    for flow, output, response in zip(flows, outputs, responses, strict=True):
        bank.observe(np.array([output], np.float32))
        bank.apply(np.array([flow], np.float32))
        regressors.append(filters[0](np.array([response]))[0])
        whitened.append(filters[1](np.array([output]))[0])
        noises.append(bank.noise[0])
    newest = samples - 1 - (samples % 2)  # the sample of the latest design
    kept = slice(0, newest + 1)
    weights = GAIN_MEMORY ** np.arange(newest, -1, -1)
    x, y, prior = np.array(regressors)[kept], np.array(whitened)[kept], noises[newest] / spread
    expected = (weights @ (x * y) + prior**2) / (weights @ (x * x) + prior**2)
    assert expected > 1.1
    assert bank.estimate.gain[0] == pytest.approx(expected, rel=1e-4)


def test_numpy_and_pytorch_choose_the_same_flows(observations):
    net = lively_net()
    network = net.export()
    setpoints, outputs = observations[..., 0] / 7.0, observations[..., 3] / 7.0
    n = setpoints.shape[1]
    prior = Prior(
        time_constants=np.repeat([[14.0], [20.0]], n, axis=1),
        shortest_delays=np.array([4, 9, 12]),
        log_probabilities=np.zeros((5, 2, n)),
        gain_spread=np.full(n, 0.25),
    )
    edge, limit = np.full(n, 0.5, np.float32), np.ones(n, np.float32)
    banks = Bank(prior), Bank(prior)
    observers = [Observer(bank, edge, (-limit, limit)) for bank in banks]
    plain = Law(banks[0], edge, (-limit, limit))
    tensors = Law(banks[1], edge, (-limit, limit), torch, torch.from_numpy)
    state = network.initial_state(n)
    net.begin(n)

    def corrections(inputs):
        nonlocal state
        outputs, state = network.step(inputs, state)
        return outputs

    for setpoint, output in zip(setpoints, outputs, strict=True):
        seen = setpoint.astype(np.float32), output.astype(np.float32)
        flow = plain.flow(observers[0].observe(*seen), corrections)
        with torch.no_grad():
            other = tensors.flow(observers[1].observe(*seen), net).numpy()
        np.testing.assert_allclose(flow, other, atol=1e-5)
        for bank in banks:
            bank.apply(flow)
    assert np.abs(flow).max() > 0.0


def test_loops_of_a_batch_are_those_of_single_controllers(make, observations):
    batch, singles = make(), [make() for _ in range(3)]
    for rows in observations:
        actions = batch.act(rows)
        alone = [single.act(row) for single, row in zip(singles, rows, strict=True)]
        np.testing.assert_allclose(actions, alone, atol=1e-4)


def test_reset_forgets_the_plant_and_the_network_state(make, observations):
    controller = make()
    first = [controller.act(rows) for rows in observations]
    controller.reset()
    assert controller.estimates == {}
    again = [controller.act(rows) for rows in observations]
    np.testing.assert_array_equal(first, again)


@pytest.mark.parametrize("dead_zone", [5.0, 7.0])
def test_every_command_is_0_or_passes_the_dead_zone(make, observations, dead_zone):
    controller = make(dead_zone=dead_zone)
    for rows in observations:
        controller.act(rows)
        size = np.abs(controller.command)
        assert ((size == 0.0) | (size >= dead_zone)).all()


@pytest.mark.parametrize("kind", [SelfTuningController, NeuralSelfTuningController])
def test_nonsense_does_not_lead_to_nonsense(kind, network, rng):
    options = {"network": network} if kind is NeuralSelfTuningController else {}
    controller = kind(**KNOWN, **options)
    for scale in (1.0, 1e3, 1e6, 1.0):
        for _ in range(60):
            controller.act(rng.normal(size=(3, 6)) * scale)
            assert np.isfinite(controller.command).all()
    multiples = controller.estimates["gain"] / GAIN
    assert (multiples >= 0.3 - 1e-6).all()
    assert (multiples <= 3.0 + 1e-6).all()


def test_neither_a_wrong_gain_nor_a_steady_load_leaves_an_offset():
    controller = SelfTuningController(**{**KNOWN, "dead_zone": 0.0})
    load = {"disturbance_amplitude": 2.0, "disturbance_interval": 1e6, "setpoint": 4.0}
    plants = make_plants(1, 900, dead_zone=0.0, gain_factor=1.2, **load)
    trajectory = rollout(plants, controller, 900, 5_900_000)
    errors = (trajectory.setpoint - trajectory.output)[700:]
    assert np.abs(errors).mean() < 0.05


class TestScales:
    """Units of flow, temperature and time do not matter."""

    def commands(self, observations, flow=1.0, temperature=1.0, time=1.0, kind=None, **more):
        controller = NeuralSmithPredictor(
            gain=GAIN * temperature / flow,
            time_constant=TIME_CONSTANT * time,
            delay=STEP_TEST["delay"] * time,
            sampling_interval=8.0 * time,
            dead_zone=5.0 * flow,
            u_min=-10.0 * flow,
            u_max=10.0 * flow,
            **more,
        )
        commands = []
        for rows in observations:
            controller.act(rows * temperature)
            commands.append(controller.command / flow)
        return np.array(commands)

    @pytest.mark.parametrize("scale", [{"flow": 10.0}, {"temperature": 4.0}, {"time": 0.1}])
    def test_of_flows_temperatures_and_times(self, observations, network, scale):
        plain = self.commands(observations, network=network)
        scaled = self.commands(observations, network=network, **scale)
        np.testing.assert_allclose(scaled, plain, atol=0.01)

    def test_a_slow_plant_is_sampled_less_often(self, observations, network):
        known = {"network": network, "gain": GAIN, "dead_zone": 5.0}
        plain, slow = (
            NeuralSmithPredictor(time_constant=45.0 * time, delay=19.0 * time, **known)
            for time in (8.0, 32.0)
        )
        for rows in observations:
            plain.act(rows)
            for _ in range(4):
                slow.act(rows)
                np.testing.assert_allclose(slow.command, plain.command, atol=0.01)
