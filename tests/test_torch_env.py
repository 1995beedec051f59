"""The environment in PyTorch: equal to that in NumPy, its draws, gradients, and no waiting."""

import copy
import gc
import pickle
from collections import defaultdict

import gymnasium
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="it is what is tested")

from gymnasium.vector import AutoresetMode  # noqa: E402
from hypothesis import given, settings  # noqa: E402
from hypothesis import strategies as st  # noqa: E402
from torch.utils._python_dispatch import TorchDispatchMode  # noqa: E402

from mptc_gym import PRESETS, MiddlePointVectorEnv  # noqa: E402
from mptc_gym.plant.dynamics import action_from_command, float32_action  # noqa: E402
from mptc_gym.plant.sampling import PlantSampler, RandomStreams  # noqa: E402
from mptc_gym.plant.signals import Signals  # noqa: E402
from mptc_gym.torch_env import MiddlePointTorchEnv, make_vec  # noqa: E402
from mptc_gym.wrappers import IncrementalAction  # noqa: E402
from tests.conftest import MODES, random_actions, valid_arguments  # noqa: E402


def make(num_envs=2, **arguments):
    return MiddlePointTorchEnv(num_envs, **{"dtype": torch.float64, **arguments})


def signals_of(envs, seed, *, episodes, samples):
    """Return signals and plant numbers of an environment in NumPy, as external signals."""
    parameters, n = envs.parameters, envs.num_envs
    signals, sampler = Signals.of(parameters, n, samples), PlantSampler(parameters)
    streams = [RandomStreams.of_seed(seed + i) for i in range(n)]
    values_by_name = defaultdict(list)
    for _ in range(episodes):
        numbers = sampler.sample(streams)
        first = {"setpoint": signals.reset(np.arange(n), streams, numbers)}
        for name, signal in signals._asdict().items():
            if signal is not None:
                rows = [signal.next().copy() for _ in range(samples)]
                values_by_name[name].append([first.get(name, np.zeros(n)), *rows])
        for name, values in numbers.select(parameters.ranges).items():
            values_by_name[name].append(values)
    return {name: torch.tensor(np.array(values)) for name, values in values_by_name.items()}


def assert_close(ours, theirs, name, rtol, atol):
    if isinstance(theirs, dict):
        assert set(ours) == set(theirs)
        for key in theirs:
            assert_close(ours[key], theirs[key], key, rtol, atol)
        return
    if name == "final_obs":
        none = np.zeros(ours.shape[1:])
        theirs = np.array([none if each is None else each for each in theirs], np.float32)
    if theirs.dtype == np.float32:  # half a unit in the last place
        rtol = max(rtol, 6e-8)
    ours = ours.detach().numpy()
    assert ours.shape == theirs.shape
    assert (ours.dtype == bool) == (theirs.dtype == bool)
    if ours.dtype == bool:
        assert (ours == theirs).all(), name
    elif not (np.abs(ours - theirs) <= atol + rtol * np.abs(theirs)).all():  # or NaN: slower
        np.testing.assert_allclose(ours, theirs, rtol=rtol, atol=atol, err_msg=name)


def compare(env, envs, *, steps, rng, partial_resets, limit, rtol=1e-9, atol=1e-9):
    """Compare both environments on the same signals and actions."""

    def checked(ours, theirs):
        for own, other in zip(ours, theirs, strict=True):
            assert_close(own, other, "", rtol, atol)
        return theirs

    n, seed = envs.num_envs, int(rng.integers(2**30))
    masks = rng.random((steps, n)) < partial_resets
    limit = steps if limit is None else limit
    episodes = 2 + masks.sum(axis=0).max() + steps // limit
    signals = signals_of(envs, seed, episodes=episodes, samples=min(limit, steps))
    checked(env.reset(options={"signals": signals}), envs.reset(seed=seed))
    for mask in masks:
        actions = random_actions(rng, n)
        truncated = checked(env.step(torch.tensor(actions)), envs.step(actions))[3]
        if envs.autoreset_mode is AutoresetMode.DISABLED:
            mask |= truncated
        if mask.any():
            ours = env.reset(options={"reset_mask": torch.tensor(mask)})
            checked(ours, envs.reset(options={"reset_mask": mask}))


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
    rng = np.random.default_rng(randomness)
    shell = {"max_episode_steps": limit, "autoreset_mode": mode}
    env = make(num_envs, differentiable=differentiable, **shell, **arguments)
    envs = MiddlePointVectorEnv(num_envs, **shell, **arguments)
    compare(env, envs, steps=50, rng=rng, partial_resets=partial_resets, limit=limit)


# float32 has 24 bits. Errors of rounding grow with the slowest pole's time constant of some 20
# samples, and temperatures are some 10 degC: 10 * 20 * 2^-24 = 1e-5.
@pytest.mark.parametrize(
    ("dtype", "rtol", "atol"), [(torch.float64, 1e-9, 1e-9), (torch.float32, 1e-5, 1e-4)]
)
def test_it_equals_it_over_long_episodes_in_both_types(dtype, rtol, atol, rng):
    plant = {"action_window": 20, "output_window": 2, "move_weight": 0.1, **PRESETS["hard"]}
    arguments = {"max_episode_steps": 400, "autoreset_mode": "SameStep", **plant}
    env, envs = make(3, dtype=dtype, **arguments), MiddlePointVectorEnv(3, **arguments)
    tolerances = {"rtol": rtol, "atol": atol}
    compare(env, envs, steps=600, rng=rng, partial_resets=0.002, limit=400, **tolerances)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_a_command_on_the_edge_of_the_dead_zone_passes(rng, dtype):
    # Of plants with limits of their own.
    n, ranges = 600, {"dead_zone": [0.1, 5]}
    envs, env = MiddlePointVectorEnv(n, **ranges), make(n, dtype=dtype, **ranges)
    _, infos = envs.reset(seed=int(rng.integers(2**30)))
    drawn = {name: infos[name] for name in ranges}
    env.reset(options={"signals": {k: torch.tensor(each) for k, each in drawn.items()}})
    commands = rng.choice([-1, 1], n) * drawn["dead_zone"]
    exact = action_from_command(commands, -10.0, 10.0)
    for actions in (exact[:, None], float32_action(commands, -10.0, 10.0, **drawn)[:, None]):
        for applied in (env.step(torch.tensor(actions)), envs.step(actions)):
            np.testing.assert_allclose(applied[-1]["applied"], commands, rtol=0, atol=1e-5)


class TestGradients:
    @pytest.mark.parametrize("plant", [
        {"dead_zone": 0.0, "action_window": 2}, {"delay": [2, 4], "gain_factor": [0.5, 2]},
        {**PRESETS["hard"], "delay": 2, "dead_zone": 1.0, "action_window": 3,
         "output_window": 2, "move_weight": 0.1, "u_min": -12.0},
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
        assert torch.autograd.gradcheck(returned, actions.requires_grad_(), fast_mode=True)

    def test_it_goes_straight_through_the_dead_zone_and_ends_at_the_limits(self):
        # The commands: inside the dead zone, outside it, at its edge, beyond either limit.
        env = make(5, differentiable=True, delay=0)
        env.reset()
        actions = torch.tensor([[0.3], [0.7], [-0.5], [1.2], [-3.0]], requires_grad=True)
        infos = env.step(actions)[-1]
        assert infos["applied"].tolist() == pytest.approx([0.0, 7.0, -5.0, 10.0, -10.0])
        infos["applied"].sum().backward(retain_graph=True)
        assert actions.grad.ravel().tolist() == [10.0, 10.0, 10.0, 0.0, 0.0]
        actions.grad = None
        infos["output"].sum().backward()
        ours = actions.grad.ravel().tolist()
        assert ours == pytest.approx([-0.4560, -0.4560, -0.4560, 0.0, 0.0])

    def test_detach_cuts_what_was_before_and_nothing_else(self):
        def gradients(cut):
            shown = {"action_window": 3, "move_weight": 0.1, "noise_variance": 1.0}
            env = make(2, differentiable=True, **shown)
            env.reset(seed=0)
            actions = torch.full((60, 2, 1), 0.8, dtype=torch.float64)
            actions[1::2] = 0.6
            actions.requires_grad_()
            total = 0.0
            for k, a in enumerate(actions):
                if k == 25 and cut:
                    env.detach()
                observation, reward, _, _, infos = env.step(a)
                if k >= 25:
                    total = total + reward.sum() + observation.sum() + infos["output"].sum()
            total.backward()
            return actions.grad, total.item()

        (whole, value), (cut, same) = gradients(False), gradients(True)
        assert value == same
        assert whole[:25].abs().min() > 0
        assert not cut[:25].any()
        # The last move before the cut is one of an action after it, too.
        torch.testing.assert_close(cut[25:], whole[25:])

    @pytest.mark.parametrize("differentiable", [False, True])
    def test_memory_does_not_grow_and_a_graph_is_kept_only_if_wanted(self, differentiable):
        shown = {"action_window": 5, "output_window": 1, "move_weight": 0.1, **PRESETS["hard"]}
        env = make(3, differentiable=differentiable, max_episode_steps=None, **shown)
        env.reset(seed=0)
        weight = torch.ones(1, 1, dtype=torch.float64, requires_grad=True)
        counts = []
        for steps in (20, 70):
            for _ in range(steps):
                observation, reward, *_, infos = env.step(torch.full((3, 1), 0.7) * weight)
                returned = observation, reward, *infos.values()
                assert any(each.requires_grad for each in returned) is differentiable
                env.detach()
            gc.collect()
            counts.append(sum(type(each) is torch.Tensor for each in gc.get_objects()))
        assert counts[1] < counts[0] + 400  # in a block they rise and fall by 250


class Waiting(TorchDispatchMode):
    """Refuses what a device would have to be waited for."""

    REFUSED = ("_local_scalar_dense", "nonzero", "is_nonzero", "masked_select", "equal")

    def __init__(self):
        super().__init__()
        self.on_host = []  # tensors that would not be on the device

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func._schema.name.partition("::")[2]
        assert name not in self.REFUSED, name
        indices = args[1] if name.startswith(("index", "_index")) else ()
        for each in indices if isinstance(indices, list | tuple) else ():
            assert each is None or each.dtype != torch.bool, f"{name} by a mask"
        if name == "lift_fresh":
            self.on_host.append(args[0])
        elif any(each is other for each in args for other in self.on_host):
            assert (name, args[2:]) == ("copy_", (True,)), f"{name} waits for a copy"
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("differentiable", [False, True])
@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_a_step_never_waits_for_the_device(mode, differentiable):
    shell = {"max_episode_steps": 12, "autoreset_mode": mode, "differentiable": differentiable}
    most = {**PRESETS["hard"], "action_window": 5, "move_weight": 0.1}
    for plant in (most, {}):
        env = make(3, **shell, **plant)
        env.checks_actions = False  # as on any device but the CPU
        env.reset(seed=0)
        env.step(torch.zeros(3, 1, dtype=torch.float64))
        env.reset(options={"reset_mask": torch.tensor([True, False, False])})
        with Waiting():
            for _ in range(27):
                env.step(torch.zeros(3, 1, dtype=torch.float64))


@pytest.mark.parametrize(("given", "named"), [
    *(({name: value}, f"^{name} must be") for name, value in [
        ("dtype", torch.float16), ("dtype", "float32"), ("dtype", np.ones(2)),
        ("device", "toaster"), ("device", "meta"), ("differentiable", "yes"),
    ]),
    ({"seed": 1 << 63}, "^seed must be None or an integer"),
    *(({"options": {"signals": signals}}, named) for signals, named in [
        ({}, "signals"), ({"nois": torch.zeros(5, 2)}, "signals"), (3, "signals"),
        ({"disturbance": torch.zeros(5, 2)}, "disturbance"),
        ({"delay": torch.zeros(2)}, "delay"), ({"delay": torch.full((2,), 7.5)}, "delay"),
        ({"dead_zone": torch.zeros(2)}, "dead_zone"),
    ]),
    *(({"options": {"signals": {"noise": values}}}, "noise") for values in [
        torch.zeros(5, 3), torch.zeros(2), torch.full((5, 2), torch.nan), "x", None, [[1], []],
    ]),
])  # fmt: skip
def test_what_is_refused_is_named(given, named):
    if given.keys() & {"seed", "options"}:
        env = make(delay=[5, 9])
        env.reset(seed=(1 << 63) - 1)  # the largest
        assert env.np_random_seed == (1 << 63) - 1
        with pytest.raises(ValueError, match=named):
            env.reset(**given)
    else:
        with pytest.raises(ValueError, match=named):
            MiddlePointTorchEnv(2, **given)


def test_signals_end_with_an_error_and_with_a_reset_without():
    env = make(noise_variance=0.5)
    env.reset(seed=0, options={"signals": {"noise": torch.ones(4, 2)}})
    some = {"reset_mask": torch.tensor([True, False]), "signals": {"noise": 1.0}}
    with pytest.raises(ValueError, match="signals"):
        env.reset(options=some)
    for _ in range(3):
        assert env.step(torch.zeros(2, 1))[-1]["noise"].tolist() == [1.0, 1.0]
    with pytest.raises(ValueError, match="end at sample 3"):
        env.step(torch.zeros(2, 1))
    env.reset()
    assert env.step(torch.zeros(2, 1))[-1]["noise"].tolist() != [1.0, 1.0]


def test_after_the_last_given_episode_the_first_follows_again():
    env = make(1, max_episode_steps=2)
    levels = torch.tensor([1.0, 2.0])[:, None, None].expand(2, 3, 1)  # episodes, samples, n
    setpoints = [env.reset(options={"signals": {"setpoint": levels}})[1]["setpoint"].item()]
    setpoints += [env.step(torch.zeros(1, 1))[-1]["setpoint"].item() for _ in range(11)]
    assert setpoints == [1.0] * 3 + [2.0] * 3 + [1.0] * 3 + [2.0] * 3


class TestById:
    def test_it_is_that_of_the_id(self):
        env = make_vec(
            "MiddlePointHard-v0", 3, dtype=torch.float64, delay=[2, 4], max_episode_steps=9
        )
        single = gymnasium.make(env.spec)
        assert env.parameters == single.unwrapped.parameters
        assert env.spec.id == "MiddlePointHard-v0"
        assert env.spec.max_episode_steps == 9
        assert env.dtype is torch.float64
        env.reset(seed=0)
        ended = [env.step(torch.zeros(3, 1))[3].all().item() for _ in range(9)]
        assert ended == [False] * 8 + [True]

    @pytest.mark.parametrize(
        ("env", "named"),
        [
            ("MiddlePointHart-v0", "Did you mean: .MiddlePointHard"),
            ("CartPole-v1", "spec of a MiddlePointEnv, without wrappers"),
            (IncrementalAction(gymnasium.make("MiddlePoint-v0")).spec, "without wrappers"),
        ],
    )
    def test_others_are_refused(self, env, named):
        with pytest.raises(ValueError, match=named):
            make_vec(env, 2)


@pytest.mark.parametrize("differentiable", [False, True])
@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda e: pickle.loads(pickle.dumps(e))])
def test_a_copy_in_mid_episode_goes_on_alike(duplicate, differentiable):
    shown = {"action_window": 4, "move_weight": 0.1, "max_episode_steps": 50}
    env = make(3, differentiable=differentiable, **shown, **PRESETS["hard"])
    env.reset(seed=0)
    weight = torch.ones(1, 1, dtype=torch.float64, requires_grad=True)
    for _ in range(27):
        env.step(0.7 * weight * torch.ones(3, 1, dtype=torch.float64))
    other = duplicate(env)
    for k in range(60):  # beyond the end of the episode
        action = torch.full((3, 1), (-1) ** k * 0.8, dtype=torch.float64)
        *arrays, infos = env.step(action)
        *other_arrays, other_infos = other.step(action)
        for array, expected in zip(other_arrays, arrays, strict=True):
            assert torch.equal(array, expected)
            assert not array.requires_grad
        assert torch.equal(other_infos["noise"], infos["noise"])


def arrays(values):
    return {name: torch.as_tensor(each).numpy() for name, each in values.items()}
