"""The environment in PyTorch: equal to that in NumPy, its draws, gradients, and no waiting."""

import copy
import gc
import pickle
from collections import defaultdict
from unittest import mock

import gymnasium
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="it is what is tested")

from gymnasium.vector import AutoresetMode  # noqa: E402
from hypothesis import given, settings  # noqa: E402
from hypothesis import strategies as st  # noqa: E402
from torch.utils._python_dispatch import TorchDispatchMode  # noqa: E402

from mptc_gym import PRESETS, MiddlePointVectorEnv, torch_env  # noqa: E402
from mptc_gym.plant.actuator import action_from_command, float32_action  # noqa: E402
from mptc_gym.plant.sampling import PlantSampler, RandomStreams  # noqa: E402
from mptc_gym.plant.signals import Signals  # noqa: E402
from mptc_gym.torch_env import MiddlePointTorchEnv, make_vec  # noqa: E402
from tests.conftest import MODES, random_actions, valid_arguments  # noqa: E402

HARD = PRESETS["hard"]
SQUARE = {"setpoint_period": 91, "setpoint_amplitude": 4.0, "temperature_span": 4.0}
# Limits whose mean is not 0, so that the action of a plant at rest is not 0 either.
ALL_SHOWN = {"action_window": 4, "output_window": 2, "move_weight": 0.1, "u_min": -12.0}
CHANGE = {"action": "change", "max_move": 0.3, "compensated_dead_zone": 4.7}


def make(num_envs=2, **arguments):
    return MiddlePointTorchEnv(num_envs, **{"dtype": torch.float64, **arguments})


class Replayed(MiddlePointTorchEnv):
    """An environment in PyTorch with the random numbers of NumPy."""

    def use(self, seed, *, episodes, samples):
        """Take signals and parameter values of `episodes` episodes from NumPy."""
        n, parameters = self.num_envs, self.parameters
        signals, sampler = Signals.of(parameters, n, samples), PlantSampler(parameters)
        streams = [RandomStreams.of_seed(seed + i) for i in range(n)]
        replay = defaultdict(list)
        for _ in range(episodes):
            numbers = sampler.sample(streams)
            setpoint = signals.reset(np.arange(n), streams, numbers)
            for name, signal in signals._asdict().items():
                if signal is not None:
                    first = setpoint if name == "setpoint" else np.zeros(n)
                    rows = [signal.next().copy() for _ in range(samples)]
                    replay[name].append([first, *rows])
            for name, values in numbers.select(parameters.ranges).items():
                replay[name].append(values)
        self.replay = {name: torch.tensor(np.array(values)) for name, values in replay.items()}
        self.episodes = torch.full((n,), -1)
        for name in self._signals:
            if name != "setpoint" or parameters.setpoint == "random":
                self._signals[name] = ReplayedSignal(self, name)

    def now(self, name, *index):
        values = self.replay[name][(self.episodes, *index, range(self.num_envs))]
        return values.to(self.dtype)

    def _begin(self, mask):
        begins = torch.tensor(mask)
        self.episodes += begins
        draws = [torch.where(begins, self.now(name), 0.0) for name in self.parameters.ranges]
        with mock.patch.object(torch_env, "_uniform", side_effect=draws):
            return super()._begin(mask)


class ReplayedSignal:
    def __init__(self, env, name):
        self.env, self.name = env, name

    def reset(self, mask, numbers):
        return self.env.now(self.name, 0)

    def next(self, samples, k):
        last = self.env.replay[self.name].shape[1] - 1  # steps that reset may lead beyond it
        return self.env.now(self.name, (k + torch.arange(samples)[:, None]).clamp(max=last))

    def end_block(self, samples):
        pass


def assert_close(ours, theirs, rtol, atol, name=""):
    if isinstance(theirs, tuple):
        ours, theirs = dict(enumerate(ours)), dict(enumerate(theirs))
    if isinstance(theirs, dict):
        assert ours.keys() == theirs.keys()
        for key in theirs:
            assert_close(ours[key], theirs[key], rtol, atol, key)
        return
    ours = ours.detach().numpy()
    if name == "final_obs":
        theirs = np.array([np.zeros(ours.shape[1]) if row is None else row for row in theirs])
    assert (ours.shape, ours.dtype == bool) == (theirs.shape, theirs.dtype == bool), name
    np.testing.assert_allclose(1.0 * ours, 1.0 * theirs, rtol, atol, err_msg=name)


def assert_equals_numpy(n, rng, steps, partial_resets, tolerances, own, **shared):
    """Compare both environments with the same random numbers and actions."""
    env, envs = Replayed(n, **own, **shared), MiddlePointVectorEnv(n, **shared)
    seed, masks = int(rng.integers(2**30)), rng.random((steps, n)) < partial_resets
    length = min(steps, shared["max_episode_steps"] or steps)
    env.use(seed, episodes=2 + masks.sum(axis=0).max() + steps // length, samples=length)
    assert_close(env.reset(), envs.reset(seed=seed), *tolerances)
    for mask in masks:
        actions = random_actions(rng, n)
        theirs = envs.step(actions)
        assert_close(env.step(torch.tensor(actions)), theirs, *tolerances)
        if envs.autoreset_mode is AutoresetMode.DISABLED:
            mask |= theirs[3]
        if mask.any():
            ours = env.reset(options={"reset_mask": torch.tensor(mask)})
            assert_close(ours, envs.reset(options={"reset_mask": mask}), *tolerances)


@settings(max_examples=20, deadline=None)
@given(
    arguments=valid_arguments,
    num_envs=st.integers(1, 5),
    mode=st.sampled_from(MODES),
    limit=st.none() | st.integers(1, 40),
    partial_resets=st.sampled_from([0.0, 0.05, 0.3]),
    differentiable=st.booleans(),
    randomness=st.integers(0, 2**32),
)
def test_it_equals_the_environment_in_numpy(
    arguments, num_envs, mode, limit, partial_resets, differentiable, randomness
):
    tolerances = 6e-8, 1e-9  # observations are float32 in NumPy
    assert_equals_numpy(
        num_envs, np.random.default_rng(randomness), 50, partial_resets, tolerances,
        {"dtype": torch.float64, "differentiable": differentiable},
        max_episode_steps=limit, autoreset_mode=mode, **arguments,
    )  # fmt: skip


# float32 has 24 bits. Errors of rounding grow with the slowest pole's time constant of some 20
# samples, and temperatures are some 10 degC: 10 * 20 * 2^-24 = 1e-5.
@pytest.mark.parametrize("form", [{}, CHANGE | SQUARE])
@pytest.mark.parametrize(
    ("dtype", "tolerances"), [(torch.float64, (6e-8, 1e-9)), (torch.float32, (1e-5, 1e-4))]
)
def test_it_equals_it_over_long_episodes_in_both_types(dtype, tolerances, form, rng):
    assert_equals_numpy(
        3, rng, 600, 0.002, tolerances, {"dtype": dtype},
        max_episode_steps=400, autoreset_mode="SameStep", **ALL_SHOWN, **(HARD | form),
    )  # fmt: skip


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_a_command_on_the_edge_of_the_dead_zone_passes(rng, dtype):
    env = make(600, dtype=dtype, dead_zone=[0.1, 5])
    zones = env.reset(seed=0)[1]["dead_zone"].double().numpy()
    commands = rng.choice([-1, 1], 600) * zones
    exact = action_from_command(commands, -10.0, 10.0)
    for actions in (exact, float32_action(commands, -10.0, 10.0, zones)):
        infos = env.step(torch.tensor(actions)[:, None])[-1]
        np.testing.assert_allclose(infos["applied"], commands, rtol=0, atol=1e-5)
    # In float32, the action 0.7 commands 6.9999999 t/h.
    env = make(2, dtype=dtype, **CHANGE | {"dead_zone": 7.0, "compensated_dead_zone": 7.0})
    env.reset()
    infos = env.step(torch.tensor([[1e-9], [-1e-9]]))[-1]
    np.testing.assert_allclose(infos["applied"], [7.0, -7.0], rtol=1e-6)


def test_draws_have_the_distributions_of_numpy():
    n = 10_000
    arguments = {**HARD, "setpoint_period": 90}
    drawn = []
    for env, zeros in (
        (MiddlePointVectorEnv(n, **arguments), np.zeros((n, 1))),
        (MiddlePointTorchEnv(n, **arguments), torch.zeros(n, 1)),
    ):
        _, infos = env.reset(seed=0)
        values = {name: infos[name] for name in (*env.parameters.ranges, "setpoint")}
        # Its mean would differ if the two were not drawn independently.
        values["delay times gain"] = values["delay"] * values["gain_factor"]
        for k in range(1, 41):
            observations, *_, infos = env.step(zeros)
            if k in (1, 2, 40):
                infos["reading"] = infos["setpoint"] - observations[:, 3]
                names = "setpoint", "noise", "disturbance", "gain_factor", "output", "reading"
                values |= {f"{name} at {k}": infos[name] for name in names}
        drawn.append({name: np.asarray(value).astype(float) for name, value in values.items()})
    for name, theirs in drawn[0].items():
        ours = drawn[1][name]
        for power in (1, 2):  # mean and variance
            moments = [(values - theirs.mean()) ** power for values in (ours, theirs)]
            difference = abs(moments[0].mean() - moments[1].mean())
            assert difference <= 5 * (2 / n) ** 0.5 * moments[1].std(), name
        for share in (0.01, 0.99):
            percentile = np.quantile(theirs, share)
            difference = abs((ours <= percentile).mean() - (theirs <= percentile).mean())
            assert difference <= 5 * (2 * share * (1 - share) / n) ** 0.5, name


class TestGradients:
    @pytest.mark.parametrize("plant", [
        {"dead_zone": 0.0, "action_window": 2}, {"delay": [2, 4], "gain_factor": [0.5, 2]},
        {**HARD, **ALL_SHOWN, "delay": 2, "dead_zone": 1.0},
        {**HARD, **ALL_SHOWN, **CHANGE, "delay": 2, "dead_zone": 1.0, "max_move": 0.05},
    ])  # fmt: skip
    def test_it_is_that_of_differences_away_from_the_kinks(self, plant):
        env = make(2, **{"delay": 2, "output_window": 1, "differentiable": True, **plant})

        def returned(actions):
            env.reset(seed=0)
            steps = [env.step(a) for a in actions]
            samples = [(seen, reward, infos["output"]) for seen, reward, *_, infos in steps]
            return tuple(torch.stack(column) for column in zip(*samples, strict=True))

        # Well inside what the actuator passes, and far from the same action twice.
        size = torch.linspace(0.55, 0.8, 24, dtype=torch.float64).reshape(12, 2, 1)
        actions = size * torch.tensor([1.0, -1.0]).repeat(6)[:, None, None]
        if env.parameters.action == "change":
            actions = actions.abs()  # the flow stays far from 0
            # Differences cannot be taken of actions that are rounded to float32.
            env._wanted_flows._to_float32 = lambda values: values
        assert torch.autograd.gradcheck(returned, actions.requires_grad_(), fast_mode=True)

    def test_it_goes_straight_through_the_dead_zone_and_ends_at_the_limits(self):
        # The commands: inside the dead zone, outside it, at its edge, beyond either limit.
        env = make(5, differentiable=True, delay=0)
        env.reset()
        actions = torch.tensor([[0.3], [0.7], [-0.5], [1.2], [-3.0]], requires_grad=True)
        infos = env.step(actions)[-1]
        assert infos["applied"].tolist() == pytest.approx([0.0, 7.0, -5.0, 10.0, -10.0])
        for name, slope in (("applied", 10.0), ("output", -0.4560)):
            (gradient,) = torch.autograd.grad(infos[name].sum(), actions, retain_graph=True)
            assert gradient.ravel().tolist() == pytest.approx([slope] * 3 + [0.0, 0.0])

    def test_a_policy_that_changes_nothing_can_learn_to(self):
        env = make(1, differentiable=True, delay=0, **CHANGE)
        env.reset()
        actions = torch.zeros(1, 1, requires_grad=True)
        env.step(actions)[-1]["output"].backward()
        assert actions.grad < 0.0

    @pytest.mark.parametrize("plant", [
        {}, {"dead_zone": [3, 7], "delay": [2, 4], **ALL_SHOWN}, {**ALL_SHOWN, **CHANGE},
    ])  # fmt: skip
    @pytest.mark.filterwarnings("ignore:.*jit.script:DeprecationWarning")  # within torch.func
    @pytest.mark.parametrize("differentiable", [False, True])
    def test_both_directions_of_differentiation_agree(self, plant, differentiable):
        env = make(2, **{"delay": 2, "differentiable": differentiable, **plant})

        def returned(actions):
            env.reset(seed=0)
            values = []
            for a in actions:
                observations, rewards, *_, infos = env.step(a)
                signals = rewards, infos["output"], infos["applied"]
                values.append(torch.cat([observations.ravel(), *signals]))
            return torch.stack(values)

        # In the dead zone, outside it, and beyond the limits.
        actions = 1.3 * torch.arange(20, dtype=torch.float64).sin().reshape(10, 2, 1)
        reverse = torch.func.jacrev(returned)(actions)
        forward = torch.func.jacfwd(returned, randomness="same")(actions)
        torch.testing.assert_close(forward, reverse, rtol=0, atol=1e-9)
        assert forward.any() == differentiable

    @pytest.mark.filterwarnings("ignore:The .grad attribute", "ignore::DeprecationWarning")
    def test_a_compiled_loss_has_the_same_value_and_gradient(self):
        env = make(2, differentiable=True, delay=1, **ALL_SHOWN)

        def loss(actions):
            observations = torch.zeros(2, 1)
            for a in actions:
                observations, rewards, *_ = env.step(a + 0.01 * observations.sum())
            return rewards.sum() + observations.square().sum()

        actions = torch.arange(12, dtype=torch.float64).cos().reshape(6, 2, 1).requires_grad_()
        values, gradients = [], []
        for function in (loss, torch.compile(loss, backend="eager")):
            env.reset(seed=0)
            values.append(function(actions))
            gradients += torch.autograd.grad(values[-1], actions)
        torch.testing.assert_close(values[1], values[0], rtol=0, atol=1e-9)
        torch.testing.assert_close(gradients[1], gradients[0], rtol=0, atol=1e-9)
        assert gradients[0].any()

    def test_detach_cuts_what_was_before_and_nothing_else(self):
        totals, gradients = [], []
        for cut in (False, True):
            env = make(2, differentiable=True, noise_variance=1.0, **ALL_SHOWN)
            env.reset(seed=0)
            actions = torch.tensor([0.8, 0.6] * 30, dtype=torch.float64, requires_grad=True)
            total = 0.0
            for k, a in enumerate(actions):
                if k == 25 and cut:
                    env.detach()
                observation, reward, _, _, infos = env.step(a.expand(2, 1))
                if k >= 25:
                    total = total + reward.sum() + observation.sum() + infos["output"].sum()
            totals.append(total.item())
            gradients += torch.autograd.grad(total, actions)
        assert totals[0] == totals[1]
        assert gradients[0][:25].abs().min() > 0
        assert not gradients[1][:25].any()
        # The last move before the cut is one of an action after it, too.
        torch.testing.assert_close(gradients[1][25:], gradients[0][25:])

    @pytest.mark.parametrize("differentiable", [False, True])
    def test_memory_does_not_grow_and_a_graph_is_kept_only_if_wanted(self, differentiable):
        plant = {**ALL_SHOWN, **HARD, **CHANGE, "max_episode_steps": None}
        env = make(3, differentiable=differentiable, **plant)
        env.reset(seed=0)
        weight = torch.ones(1, 1, dtype=torch.float64, requires_grad=True)
        counts = []
        for k in range(90):
            observation, reward, *_, infos = env.step(torch.full((3, 1), 0.7) * weight)
            returned = observation, reward, *infos.values()
            assert any(tensor.requires_grad for tensor in returned) is differentiable
            env.detach()
            if k in (20, 89):
                gc.collect()
                counts.append(sum(type(thing) is torch.Tensor for thing in gc.get_objects()))
        assert counts[1] < counts[0] + 400  # in a block they rise and fall by 250


class Waiting(TorchDispatchMode):
    """Refuses what a device would have to be waited for."""

    REFUSED = ("_local_scalar_dense", "nonzero", "is_nonzero", "masked_select", "equal")
    on_host = None  # a tensor that would not be on the device

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func._schema.name.partition("::")[2]
        assert name not in self.REFUSED
        indices = args[1] if name.startswith(("index", "_index")) else ()
        for index in indices if isinstance(indices, list | tuple) else ():
            assert index is None or index.dtype != torch.bool, f"{name} by a mask"
        if name == "lift_fresh":
            self.on_host = args[0]
        elif any(argument is self.on_host for argument in args):
            assert name == "_to_copy"
            assert kwargs["non_blocking"], "waits for a copy"
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("arguments", [
    {}, {"autoreset_mode": "SameStep", "differentiable": True, **HARD, **ALL_SHOWN},
    {**HARD, **CHANGE},
])  # fmt: skip
def test_a_step_never_waits_for_the_device(arguments):
    env = make(3, max_episode_steps=12, **arguments)
    env.checks_actions = False  # as on any device but the CPU
    env.reset(seed=0)
    env.step(torch.zeros(3, 1, dtype=torch.float64))
    env.reset(options={"reset_mask": torch.tensor([True, False, False])})
    with Waiting():
        for _ in range(27):
            env.step(torch.zeros(3, 1, dtype=torch.float64))


def test_types_and_seeds_beyond_those_of_pytorch_are_named():
    with pytest.raises(ValueError, match=r"^dtype must be"):
        make(dtype=torch.float16)
    env = make()
    env.reset()
    with pytest.raises(
        ValueError, match=r"^actions must be numbers \(can't convert np.ndarray"
    ):
        env.step(np.array([["up"], ["down"]]))
    with pytest.raises(ValueError, match=r"^seed must be an integer from 0 to 9,223,372"):
        make().reset(seed=1 << 63)


def test_by_id_it_is_that_of_the_id():
    env = make_vec(
        "MiddlePointHard-v0", 3, dtype=torch.float64, delay=[2, 4], max_episode_steps=2
    )
    one = gymnasium.make(env.spec)
    assert env.parameters == one.unwrapped.parameters
    assert one.spec.max_episode_steps == 2
    env.reset(seed=0)
    assert [env.step(torch.zeros(3, 1))[3].all() for _ in range(2)] == [False, True]
    pictured = gymnasium.make("MiddlePoint-v0", render_mode="rgb_array", dead_zone=[1, 2])
    assert make_vec(pictured.spec, 2).parameters == pictured.unwrapped.parameters
    with pytest.raises(ValueError, match="spec of a MiddlePointEnv, without wrappers"):
        make_vec("CartPole-v1", 2)


@pytest.mark.parametrize("form", [{}, CHANGE])
@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda e: pickle.loads(pickle.dumps(e))])
def test_a_copy_in_mid_episode_goes_on_alike(duplicate, form):
    plant = {**ALL_SHOWN, "max_episode_steps": 50, **HARD, **form}
    env = make(3, differentiable=True, **plant)
    env.reset(seed=0)
    weight = torch.ones(1, 1, dtype=torch.float64, requires_grad=True)
    for _ in range(27):
        env.step(0.7 * weight * torch.ones(3, 1, dtype=torch.float64))
    other = duplicate(env)
    for k in range(60):  # beyond the end of the episode
        action = torch.full((3, 1), (-1) ** k * 0.8, dtype=torch.float64)
        for returned, expected in zip(
            other.step(action)[:4], env.step(action)[:4], strict=True
        ):
            assert torch.equal(returned, expected)
            assert not returned.requires_grad


@pytest.mark.parametrize("form", [{}, CHANGE])
def test_after_steps_in_the_inference_mode_there_are_gradients(form):
    with torch.inference_mode():
        env = make(2, differentiable=True, max_episode_steps=40, **ALL_SHOWN, **HARD, **form)
        env.reset(seed=0)
        for _ in range(35):
            env.step(torch.full((2, 1), 0.5, dtype=torch.float64))
    actions = torch.full((45, 2, 1), 0.7, dtype=torch.float64, requires_grad=True)
    for a in actions:  # into the next episode
        observations, rewards, *_, infos = env.step(a)
        for returned in (observations, rewards, *infos.values()):
            assert not returned.is_inference()
    rewards.sum().backward()
    assert actions.grad.any()
