"""Test the controllers: their equations, batches of loops, files and errors."""

import json
import pickle
from functools import partial

import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence
from hypothesis import given, settings
from hypothesis import strategies as st

from agents import (
    DahlinController,
    DirectNNController,
    PIController,
    PolicyNetwork,
    SelfTuningController,
    SmithPredictor,
    Weights,
)
from agents.networks import PRETRAINED
from benchmarks.controllers.roster import ROSTER
from benchmarks.loop.runs import make_plants, simulate
from mptc_gym import PRESETS, Parameters, evaluate
from mptc_gym.evaluation import SEED
from tests.conftest import STEP_TEST, assert_the_seed_is_all_that_differs

FIELDS = ("W", "theta_1", "W_1", "theta_2")
TUNED = {**STEP_TEST, "closed_loop_time_constant": 80.0}
MAKERS = {  # of every controller that reads set points and errors alone
    "nn": partial(DirectNNController, num_envs=1),
    "pi": partial(PIController),
    "smith": partial(SmithPredictor, **TUNED),
    "dahlin": partial(DahlinController, **TUNED),
    "self-tuning": partial(SelfTuningController, **STEP_TEST),
}
# With a long time constant, Dahlin's controller does not correct errors inside the dead zone.
INTERNAL_MODELS = (
    partial(SmithPredictor, **TUNED),
    partial(DahlinController, **{**TUNED, "closed_loop_time_constant": 16.0}),
)


def are_equal(first, second):
    """Return whether the weights of two paper networks are equal to the bit."""
    return data_equivalence(vars(first), vars(second), exact=True)


def policy(**arguments):
    """Return a policy whose output is the error e, with these other arguments."""
    defaults = {"layers": [([[1.0]], [0.0])], "observation": {"error_window": 1}}
    return PolicyNetwork(**defaults | arguments)


@pytest.mark.parametrize(
    ("arguments", "errors", "commands"),
    [
        # u = -2 e - 0.5 (sum of e): -2 - 0.5, 4 + 0.5, -6 - 1; as printed, beyond the limits
        ({"kp": 2.0, "ki": 0.5, "u_min": -4.0, "u_max": 8.0}, (1, -2, 3), (-2.5, 4.5, -7)),
        # Limits +-4. e = 3: -3 - 1.5 = -4.5 is beyond the limit, which a sum of 2 reaches.
        # e = 1: -1 - 0.5 (3); e = -3: 3 - 0.5 (0); e = -1: 1 + 0.5 (1).
        (
            {"kp": 1.0, "ki": 0.5, "anti_windup": True, "u_min": -4, "u_max": 4},
            (3, 1, -3, -1), (-4.0, -2.5, 3.0, 1.5),
        ),
        # A proportional part of 6 is beyond the limit: the sum stays as it was.
        (
            {"kp": 1.0, "ki": 0.5, "anti_windup": True, "u_min": -4, "u_max": 4},
            (-1, -6, -1), (1.5, 6.5, 2.0),
        ),
        # An error that stays: up to the limit of a heater, and down to it.
        (
            {"kp": -1.0, "ki": -0.8, "anti_windup": True, "u_min": 0, "u_max": 10},
            (3, 3, 3, 3, -3, -3, -3, -3), (5.4, 7.8, 10.0, 10.0, 1.6, 0.0, 0.0, 0.0),
        ),
        # At least 2 t/h: e = -1 gives 1 + 0.5, which is below, then more: not held.
        (
            {"kp": 1.0, "ki": 0.5, "anti_windup": True, "u_min": 2, "u_max": 6},
            (-1, -1, -1), (1.5, 2.0, 2.5),
        ),
    ],
)  # fmt: skip
def test_pi_by_hand(arguments, errors, commands):
    controller = PIController(**arguments)
    assert controller.command == 0.0
    low, high = controller.u_min, controller.u_max
    for e, u in zip(errors, commands, strict=True):
        action = controller.act([0, 0, 0, e, 9, 9])
        assert controller.command == pytest.approx(u)
        assert action == pytest.approx([2.0 * (u - low) / (high - low) - 1.0])
        assert action.dtype == np.float32


BAD_OBSERVATIONS = [np.zeros((1, 3)), np.zeros((1, 1, 6)), np.zeros((2, 6)), [[np.nan] * 6]]


@pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)
def test_bad_observation_changes_nothing(make):
    controller, twin = make(), make()
    controller.act(np.ones((1, 6))), twin.act(np.ones((1, 6)))
    for bad in BAD_OBSERVATIONS:
        with pytest.raises(ValueError, match=r"^observation must"):
            controller.act(bad)
        actions = controller.act(np.ones((1, 6))), twin.act(np.ones((1, 6)))
        assert np.array_equal(*actions)


PPO = PolicyNetwork.load(PRETRAINED / "ppo-10000.npz")
FITTING = [  # for each controller, arguments of an environment and the number of its loops
    *((make(), {"dead_zone": [4.0, 5.0], "output_window": 2}, 1) for make in MAKERS.values()),
    (PIController(error_index=0), {"setpoint_window": 0}, 5),
    (PPO, PPO.interface | {"compensated_dead_zone": 7.0}, 5),
]
MISFITS = [  # and the message of the error
    *((make(), *misfit) for make in MAKERS.values() for misfit in (
        ({"u_max": 12.0}, 1, r"u_max=12\.0, got -10\.0, 10\.0"),
        ({"setpoint_window": 2}, 1, "newest error as element 3"),
        ({"error_window": 0}, 1, "newest error as element 3"),
        ({"action": "change"}, 1, "must have action='flow'"),
    )),
    (SelfTuningController(**STEP_TEST, error_index=0), {"setpoint_window": 0}, 5,
     "newest setpoint as element 0"),
    (SmithPredictor(**TUNED), {"sampling_interval": 1.0}, 1,
     "sampling_interval of env, 1.0 s, got 8.0 s"),
    (DirectNNController(num_envs=2), {}, 3, "num_envs=3, one loop per episode"),
    (PPO, PPO.interface | {"output_window": 3}, 5, "with which the policy was trained"),
    (PPO, PPO.interface | {"max_move": 0.4}, 5, "with which the policy was trained"),
    (PPO, PPO.interface | {"action": "flow"}, 5, "must have action='change'"),
]  # fmt: skip


@pytest.mark.parametrize(("controller", "arguments", "num_envs"), FITTING)
def test_a_plant_that_a_controller_was_made_for_is_accepted(controller, arguments, num_envs):
    controller.check_environment(Parameters(**arguments), num_envs)


@pytest.mark.parametrize(("controller", "arguments", "num_envs", "message"), MISFITS)
def test_another_plant_is_refused(controller, arguments, num_envs, message):
    with pytest.raises(ValueError, match=message):
        controller.check_environment(Parameters(**arguments), num_envs)


@pytest.mark.parametrize(
    ("name", "error"),
    [
        ("nn", 1.9493986), ("pi-simc", 1.7795430), ("smith", 1.5552472), ("dahlin", 1.5607959),
        ("self-tuning", 1.3812650), ("ppo", 1.5119368), ("ppo-hard", 1.4632752),
    ],
)  # fmt: skip
def test_errors_on_random_plants_are_those_of_earlier_versions(name, error):
    member = ROSTER[name].members()[0]
    controller, arguments = member.start(PRESETS["hard"], 10, SEED)
    result = evaluate(controller, episodes=10, **arguments)
    # float32 results of networks can differ by rounding between machines.
    assert result.mean_error == pytest.approx(error, rel=1e-5)


class TestDirectNN:
    @settings(max_examples=25, deadline=None)
    @given(
        n_inputs=st.integers(1, 12),
        n_hidden=st.integers(1, 8),
        direction=st.sampled_from([-1, 1]),
        seed=st.integers(0, 10**6),
    )
    def test_weights_move_along_the_gradient_of_automatic_differentiation(
        self, n_inputs, n_hidden, direction, seed
    ):
        torch = pytest.importorskip("torch", reason="the controllers need no PyTorch")
        gains = {"eta": 0.3, "eta_theta": 0.2, "eta_1": 0.7, "eta_1_theta": 0.9}
        nn = DirectNNController(
            n_inputs=n_inputs, n_hidden=n_hidden, error_index=0, direction=direction, seed=seed,
            input_scale=0.2, weight_scale=2.0, **gains,
        )  # fmt: skip
        observation = np.random.default_rng(seed).normal(0, 5, n_inputs)
        before = nn.weights
        leaves = [torch.tensor(getattr(before, f), requires_grad=True) for f in FIELDS]
        W, theta_1, W_1, theta_2 = leaves
        hidden = torch.sigmoid(W @ torch.tensor(0.2 * observation) + theta_1)
        output = torch.sigmoid(W_1 @ hidden + theta_2)
        # (15): dE/dw = -e dy/du dX_21/dw with D(G) in place of dy/du; w moves against it.
        (-observation[0] * direction * output).backward()
        assert nn.act(observation)[0] == pytest.approx(2 * output.item() - 1, abs=1e-6)
        for field, leaf, gain in zip(FIELDS, leaves, gains.values(), strict=True):
            moved = getattr(nn.weights, field) - getattr(before, field)
            np.testing.assert_allclose(moved, -gain * leaf.grad.numpy(), atol=1e-12)

    def test_initial_weights_are_uniform_and_depend_on_the_seed_alone(self):
        weights = DirectNNController(num_envs=2000, weight_scale=0.5).weights
        for field in FIELDS:
            values = getattr(weights, field)
            assert np.abs(values).max() <= 0.5
            quartiles = np.quantile(values, [0.25, 0.5, 0.75])
            assert quartiles == pytest.approx([-0.25, 0, 0.25], abs=0.04)
        assert_the_seed_is_all_that_differs(
            lambda seed: DirectNNController(seed=seed).weights.W
        )

    def test_a_network_in_a_batch_is_that_of_its_seed_to_the_bit(self, rng):
        batch = DirectNNController(num_envs=3, seed=4)
        singles = [DirectNNController(seed=4 + i) for i in range(3)]
        for _ in range(60):
            rows = rng.normal(0.0, 3.0, (3, 6))
            alone = [single.act(row) for single, row in zip(singles, rows, strict=True)]
            # Further elements of an observation have no effect.
            assert np.array_equal(batch.act(np.column_stack([rows, rows])), alone)

    def test_weights_are_assigned_to_each_network_of_a_batch_or_refused(self):
        weights = DirectNNController(seed=3).weights
        batch = DirectNNController(num_envs=2)
        batch.weights = weights
        before = batch.weights
        assert np.array_equal(before.W, [weights.W, weights.W])
        for field, shape in (("W", (6, 3)), ("W_1", 4), ("theta_2", 3)):
            with pytest.raises(ValueError, match="requested shape"):
                batch.weights = Weights(**vars(weights) | {field: np.zeros(shape)})
            assert are_equal(batch.weights, before)

    def test_weights_change_at_every_third_sample_while_learning_is_on(self):
        nn = DirectNNController(update_interval=3)
        changed = []
        for k in range(12):
            before = nn.weights
            if k == 7:  # the count begins again, the weights stay
                nn.reset()
                assert are_equal(nn.weights, before)
            nn.learning = k < 10
            nn.act(np.ones(6))
            changed.append(not are_equal(nn.weights, before))
        assert np.flatnonzero(changed).tolist() == [0, 3, 6, 7]  # and not 10

    def test_commands_keep_to_a_share_of_the_actuators_range(self):
        # A threshold of this size saturates the output node at 0, or at 1.
        for share, lowest, highest in ((1.0, -10.0, 20.0), (0.9, -8.5, 18.5)):
            nn = DirectNNController(u_min=-10.0, u_max=20.0, output_share=share, num_envs=2)
            weights = nn.weights
            weights.theta_2[:] = -1e6, 1e6
            nn.weights = weights
            nn.act(np.ones((2, 6)))
            assert nn.command == pytest.approx([lowest, highest])
        # The limits stay the actuator's.
        evaluate(nn, episodes=2, u_max=20.0)

    @pytest.mark.parametrize("share", [0.0, 1.1])
    def test_a_share_that_is_no_part_of_the_range_is_refused(self, share):
        with pytest.raises(ValueError, match="output_share must be a number from 1e-09 to 1, "):
            DirectNNController(output_share=share)

    def test_extreme_inputs_do_not_overflow(self):
        batch = DirectNNController(input_scale=1e6, num_envs=2)
        assert np.isfinite(batch.act([[-1e3] * 6, [1e3] * 6])).all()


@pytest.mark.parametrize(
    ("arguments", "kp", "ki"),
    [
        # Kc = tau / (|k| (tau_c + theta)) = 100 / (2 x 50); tau_I = min(100, 4 x 50) = 100.
        (
            {"delay": 20.0, "closed_loop_time_constant": 30.0, "sampling_interval": 5.0},
            1.0, 1.0 * 5 / 100,
        ),
        # By default tau_c = theta: 100 / (2 x 20) = 2.5; tau_I = 4 x 20, less than 100.
        ({"delay": 10.0}, 2.5, 2.5 * 8 / 80),
    ],
)  # fmt: skip
def test_simc_by_hand(arguments, kp, ki):
    controller = PIController.simc(gain=-2.0, time_constant=100.0, **arguments)
    assert (controller.kp, controller.ki) == pytest.approx((kp, ki))
    assert controller.anti_windup


@pytest.mark.parametrize(
    ("setpoint", "actuator"),
    [
        (6.5, {"dead_zone": 0.0}),  # takes more than the limits
        (2.0, {"dead_zone": 5.0, "u_min": -3.0}),  # the limit lies inside the dead zone
    ],
)
def test_with_the_right_model_the_delay_only_shifts_the_output(setpoint, actuator):
    # On a plant that is its model, the output is that of the loop without delay, later.
    pole = np.exp(-8 / 161)
    plant = {"a": (1.0, -pole), "b": (-0.6825 * (1 - pole),), "c": (1.0,), **actuator}
    plant["setpoint"] = setpoint
    outputs = []
    for delay in (0, 18):
        smith = SmithPredictor(**{**TUNED, "delay": 8.0 * (delay + 1), **actuator})
        trajectory = simulate(make_plants(1, 200, **plant, delay=delay), smith, 200, seed=0)
        outputs.append(trajectory.output[delay : 182 + delay])
    np.testing.assert_allclose(*outputs, atol=1e-4)


def test_the_response_with_dahlins_controller_is_a_first_order_lag_after_the_delay():
    pole, samples = np.exp(-8 / 161), np.arange(100)
    plant = {"a": (1.0, -pole), "b": (-0.6825 * (1 - pole),), "c": (1.0,), "dead_zone": 0.0}
    commands = []  # for an error of 0.5 degC at rest
    for filter_time_constant in (0.0, 100.0):
        controller = DahlinController(**TUNED, filter_time_constant=filter_time_constant)
        found = simulate(make_plants(1, 119, **plant, setpoint=2.0), controller, 119, seed=0)
        # lambda = 80 s is ten samples; the delay is 19.
        lag = 2.0 * (1.0 - np.exp(-samples / 10.0))
        np.testing.assert_allclose(found.output[18:118, 0], lag, atol=1e-4)
        controller.reset()
        controller.act([0.0, 0.0, 0.0, 0.5])
        commands.append(controller.command)
    # The filter acts on loads alone, of which it takes 1 - exp(-8 / 100) in the first sample.
    assert commands[1] / commands[0] == pytest.approx(1.0 - np.exp(-0.08))


@pytest.mark.parametrize("make", INTERNAL_MODELS)
def test_no_controller_winds_up_at_a_limit_or_stays_in_the_dead_zone(make):
    controller = make(dead_zone=5.0)
    # 9 degC are out of reach; 6 degC take 8.8 t/h. The valve must leave its limit at once.
    plants = make_plants(1, 320, setpoint=[9.0] * 300 + [6.0])
    applied = simulate(plants, controller, 320, seed=0).applied
    assert (applied[290:300] == -10.0).all()
    assert applied[300] > -10.0
    # 1 degC takes 1.5 t/h, inside the zone: now and then 5 t/h pass, and never more.
    held = simulate(make_plants(1, 900, setpoint=1.0), controller, 900, seed=0)
    assert set(np.abs(held.applied[100:]).ravel()) == {0.0, 5.0}
    assert np.abs(held.next_error[300:]).max() < 0.5


class TestPolicyNetwork:
    def test_equals_torch(self):
        torch = pytest.importorskip("torch")
        linear = [torch.nn.Linear(*sizes) for sizes in ((5, 7), (7, 6), (6, 1))]
        tanh = torch.nn.Tanh()
        expected = torch.nn.Sequential(linear[0], tanh, linear[1], tanh, linear[2])
        x = torch.randn(50, 5, generator=torch.manual_seed(1)) * 5.0
        layers = [
            (layer.weight.numpy(force=True), layer.bias.numpy(force=True)) for layer in linear
        ]
        network = policy(layers=layers, observation={"error_window": 5})
        # PyTorch adds in another order; 1e-5 is some hundred roundings of float32.
        actions = expected(x).clamp(-1.0, 1.0).numpy(force=True)
        assert network.act(x) == pytest.approx(actions, abs=1e-5)

    def test_an_action_sets_or_changes_the_flow_as_in_the_training(self, rng):
        limits = {"u_min": -4.0, "u_max": 8.0}
        errors = rng.normal(size=(100, 1)).astype(np.float32)
        for form, command in (("flow", 5.0), ("change", 0.5 * 0.3 * 6.0)):
            network = policy(action=form, max_move=0.3, **limits)
            actions = network.act(errors)
            np.testing.assert_allclose(actions, errors.clip(-1.0, 1.0), atol=1e-7)
            network.act([0.5])  # without memory, the batch size may change
            assert network.command == pytest.approx(command)


class Harm:
    """An object that prints if a file with its pickle is loaded."""

    def __reduce__(self):
        return print, ("executed",)


SAVED = {
    "weights": DirectNNController().weights,
    "policy": PPO,
}


@pytest.mark.parametrize("kind", SAVED)
def test_saved_files_are_loaded_and_other_files_are_refused(tmp_path, capsys, kind):
    path, saved = tmp_path / "kept.npz", SAVED[kind]
    saved.save(path)
    assert data_equivalence(vars(saved.load(path)), vars(saved), exact=True)
    data = path.read_bytes()
    damaged = data[:100] + bytes([data[100] ^ 0xFF]) + data[101:]  # of the first array
    for content in (b"", data[:200], data[:-1], damaged, pickle.dumps(Harm())):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"kept\.npz is no .npz file, or is damaged"):
            saved.load(path)
    np.savez(path, about=np.array(Harm(), dtype=object))
    with pytest.raises(ValueError, match="damaged: Object arrays cannot be loaded"):
        saved.load(path)
    np.savez(path, about=json.dumps({"format": 1}))
    with pytest.raises((ValueError, TypeError), match=r"another version|argument 'about'"):
        saved.load(path)
    assert capsys.readouterr().out == ""  # nothing in a file is executed


BAD = {
    DirectNNController: [
        ("n_inputs", 0), ("n_hidden", 1.5), ("eta", -0.1), ("eta_1", np.nan), ("seed", "1"),
        ("direction", 0.5), ("num_envs", True), ("update_interval", 0),
    ],
    partial(PIController.simc, **STEP_TEST): [
        ("gain", 0.0), ("time_constant", 0.0), ("delay", -1.0), ("delay", 0.0), ("u_min", 10.0),
        ("closed_loop_time_constant", 0.0), ("sampling_interval", 0.0), ("u_min", -np.inf),
    ],
    partial(DahlinController, **TUNED): [
        ("closed_loop_time_constant", 0.0), ("filter_time_constant", -1.0),
    ],
    partial(SmithPredictor, **TUNED): [("delay", -8.0), ("dead_zone", np.nan)],
    partial(SelfTuningController, **STEP_TEST): [
        ("delay_range", (0.0, np.inf)), ("delay_range", (160.0, 80.0)),
        ("delay_range", ("a", 5.0)), ("setpoint_holds", (9.0, 3.0)),
    ],
    policy: [
        ("action", "jump"), ("max_move", 0.0), ("compensated_dead_zone", np.nan),
        ("layers", [(np.ones((1, 5)), [0.0])]), ("layers", [(np.ones((2, 1)), np.ones(2))]),
    ],
}  # fmt: skip


@pytest.mark.parametrize("make", BAD)
def test_bad_arguments_are_named(make):
    for name, value in BAD[make]:
        with pytest.raises(ValueError, match=name):
            make(**{name: value})
