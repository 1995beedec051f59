"""Test the shell that batches in NumPy and in PyTorch share."""

import inspect
from functools import partial
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.vector import AutoresetMode
from scipy.signal import lfilter

from mptc_gym import PRESETS, MiddlePointVectorEnv, Parameters
from mptc_gym.env import INFO
from mptc_gym.plant.dynamics import FACTORS
from tests.conftest import MODES, NOISY, assert_the_seed_is_all_that_differs


@pytest.fixture(params=["NumPy", "PyTorch"])
def library(request):
    """Return the environment of a library, and how to make its arrays."""
    if request.param == "NumPy":
        return SimpleNamespace(
            cls=MiddlePointVectorEnv,
            array=np.array,
            own={"render_mode"},
            shared={},
            make=partial(_made, MiddlePointVectorEnv),
        )
    torch = pytest.importorskip("torch", reason="it is what is tested")
    from mptc_gym.torch_env import MiddlePointTorchEnv

    return SimpleNamespace(
        cls=MiddlePointTorchEnv,
        array=torch.tensor,
        own={"device", "dtype", "differentiable"},
        # Several steps may return the same, as documented.
        shared={*FACTORS, *(f"_{name}" for name in (*INFO, *FACTORS, "disturbance"))},
        make=partial(_made, MiddlePointTorchEnv, dtype=torch.float64),
    )


def _made(cls, num_envs=2, **arguments):
    return cls(num_envs, **{"max_episode_steps": None, **arguments})


def plain(returned):
    """Return a copy of what an environment returned, in lists and arrays of NumPy."""
    if isinstance(returned, dict):
        return {name: plain(each) for name, each in returned.items()}
    if isinstance(returned, tuple):
        return tuple(plain(each) for each in returned)
    return np.asarray(returned).copy()


def assert_equal(ours, theirs):
    assert data_equivalence(plain(ours), plain(theirs), exact=True)


def test_spaces_modes_and_arguments_are_those_of_gymnasium_s_environments(library):
    arguments = {"temperature_span": 70.0, "output_window": 2}
    ours = library.make(3, **arguments)
    theirs = gymnasium.make_vec("MiddlePoint-v0", 3, vectorization_mode="sync", **arguments)
    for name in ("action_space", "observation_space"):
        assert getattr(ours, name) == getattr(theirs, name)
        assert getattr(ours, f"single_{name}") == getattr(theirs, f"single_{name}")
    assert ours.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    for mode in [*MODES, *AutoresetMode]:
        envs = library.make(autoreset_mode=mode)
        assert envs.metadata["autoreset_mode"] is AutoresetMode(mode)
    shell = {"num_envs", "max_episode_steps", "autoreset_mode"}
    names = set(inspect.signature(library.cls).parameters)
    assert names == shell | library.own | set(inspect.signature(Parameters).parameters)


SEEDS = [-1, 1.5, True, "12", np.array(3), [1], [1, 2, 3], [1, -2], [1, "2"]]
MASKS = [[True, False], np.array([[True, False]]), np.array([1, 0]), np.array([True]),
         np.array([False, False]), None]  # fmt: skip
ACTIONS = [
    np.zeros(2), np.zeros((1, 1)), np.zeros((2, 2)), np.array([[np.nan], [0.0]]),
    np.array([[0.0], [np.inf]]), [[10**400], [0]], [[0.0], [None]], None, [[0.3], [0.3j]],
    [["0.3"], ["0.3"]], np.array([["0.3"], ["0.3"]]), [[b"0.3"], [b"0.3"]], [["0.3"], [0.3]],
]  # fmt: skip
REFUSED = [
    *(("make", {name: value}, f"^{name} must be") for name, value in [
        ("num_envs", 0), ("num_envs", 2.0), ("num_envs", True),
        ("max_episode_steps", 0), ("max_episode_steps", 1.5), ("max_episode_steps", -2),
        ("dead_zone", -1.0),
        ("delay", 1.5), ("render_mode", np.ones(2)), ("render_mode", "human"),
    ]),
    *(("reset", {"seed": seed}, "seed must be") for seed in SEEDS),
    *(("reset", {"options": {"reset_mask": mask}}, "reset_mask") for mask in MASKS),
    ("make", {"autoreset_mode": "Never"}, "'Never' is not a valid AutoresetMode"),
    *(("step", actions, "actions must be") for actions in ACTIONS),
]  # fmt: skip


@pytest.mark.parametrize(("way", "given", "named"), REFUSED, ids=range(len(REFUSED)))
def test_what_is_refused_is_named_and_changes_nothing(library, way, given, named):
    if way == "make":
        with pytest.raises(ValueError, match=named):
            library.make(**given)
        return
    mask = given["options"]["reset_mask"] if named == "reset_mask" else None
    if isinstance(mask, np.ndarray):
        given = {"options": {"reset_mask": library.array(mask)}}
    if isinstance(given, np.ndarray) and given.dtype == float:
        given = library.array(given)
    envs, twin = (library.make(delay=0, **NOISY) for _ in range(2))
    envs.reset(seed=0), twin.reset(seed=0)
    good = library.array(np.array([[1.0], [-0.8]]))
    for _ in range(3):
        with pytest.raises(ValueError, match=named):
            envs.step(given) if way == "step" else envs.reset(**given)
        assert_equal(envs.step(good), twin.step(good))
    assert_equal(envs.reset(), twin.reset())


def test_any_numbers_are_actions(library):
    large = np.array([[1e150], [-1e150]])
    for actions in ([[1], [-0.8]], [[True], [False]], np.array([[1], [0]]), large):
        envs = library.make()
        envs.reset(seed=0)
        infos = plain(envs.step(actions)[-1])
        wanted = 10.0 * np.ravel(actions).astype(float)
        np.testing.assert_allclose(infos["command"], wanted, rtol=1e-15)
        np.testing.assert_allclose(infos["applied"], wanted.clip(-10, 10), rtol=1e-15)


def test_the_action_of_a_plant_that_is_reset_is_ignored(library):
    envs = library.make(max_episode_steps=1)
    envs.reset(seed=0)
    assert envs.step(np.zeros((2, 1)))[3].tolist() == [True, True]
    envs.reset(options={"reset_mask": np.array([True, False])})
    bad = np.array([[0.0], [np.nan]])
    envs.step(bad)
    with pytest.raises(ValueError, match="actions"):
        envs.step(bad)


def test_reset_is_asked_for(library):
    envs = library.make(max_episode_steps=2, autoreset_mode="Disabled")
    actions = np.zeros((2, 1))
    first = {"reset_mask": np.arange(2) == 0}
    with pytest.raises(ResetNeeded):
        envs.step(actions)
    with pytest.raises(ResetNeeded):
        envs.reset(options=first)
    envs.reset(seed=0)
    for _ in range(2):
        envs.step(actions)
    envs.reset(options=first)
    with pytest.raises(ResetNeeded, match=r"\[1\]"):
        envs.step(actions)


def test_the_time_limit_is_that_of_the_registration_unless_one_is_given(library):
    for envs, ends in [
        (library.make(max_episode_steps=7), [*range(6, 1210, 8)]),  # a reset lies between
        (library.make(max_episode_steps=-1), []),
        (gymnasium.make_vec("MiddlePoint-v0", 2), [1199]),
    ]:
        envs.reset(seed=0)
        truncated = [plain(envs.step(np.zeros((2, 1)))[3]).all() for _ in range(1210)]
        assert np.flatnonzero(truncated).tolist() == ends


def overwrite(returned, value, shared):
    named = returned.items() if isinstance(returned, dict) else enumerate(returned)
    for name, each in named:
        if isinstance(each, dict):
            overwrite(each, value, shared)
        elif each.dtype != object and name not in shared:
            each[...] = bool(value % 2) if "bool" in str(each.dtype) else value


@pytest.mark.parametrize("plant", [NOISY, {"setpoint": 5.0}, PRESETS["hard"]])
@pytest.mark.parametrize("window", [0, 3])
def test_what_is_returned_can_be_overwritten(library, plant, window, rng):
    arguments = {"autoreset_mode": "SameStep", "move_weight": 0.1, "output_window": 1}
    arguments |= {"max_episode_steps": 30, "action_window": window, **plant}
    envs, twin = library.make(4, **arguments), library.make(4, **arguments)
    returned = envs.reset(seed=1)
    twin.reset(seed=1)
    for k in range(80):
        overwrite(returned, 76 + k % 2, shared=library.shared)
        actions = rng.normal(0, 1, (4, 1))
        returned = envs.step(library.array(actions))
        assert_equal(returned, twin.step(actions))
        if k % 10 == 0:
            options = {"reset_mask": np.array([True, False, False, True])}
            returned = envs.reset(options=options)
            assert_equal(returned, twin.reset(options=options))


def assert_mean(values, expected):
    """Compare a mean to within five standard errors, those between plants if they are columns.

    Chance exceeds them once in two million times.
    """
    means = np.atleast_2d(values).mean(0)
    assert abs(means.mean() - expected) <= 5 * means.std() / means.size**0.5


class TestDraws:
    @pytest.mark.parametrize("name", ["noise", "measurement_noise"])
    def test_noise_is_normal_and_that_of_the_plant_has_the_colour_of_c(self, library, name):
        variance, c = 0.5, np.array([1.0, -0.35740, -0.03392])
        env = library.make(400, output_window=1, c=c, **{f"{name}_variance": variance})
        env.reset(seed=4)
        steps = [plain(env.step(np.zeros((400, 1)))) for _ in range(250)]
        noise = np.array([infos["noise"] for *_, infos in steps])[2:]
        if name == "measurement_noise":  # white, and all of the reading
            noise, c = np.array([observations[:, -1] for observations, *_ in steps]), np.ones(1)
        noise = noise / variance**0.5
        for lag in (0, 1, 2, 3, 7, 19, 20):
            product = noise[lag:] * noise[: len(noise) - lag]
            assert_mean(product, np.dot(c[lag:], c[: max(len(c) - lag, 0)]))
        normal = noise / (c @ c) ** 0.5
        for power, moment in ((1, 0.0), (3, 0.0), (4, 3.0)):
            assert_mean(normal**power, moment)
        assert_mean(np.abs(normal) < 0.6745, 0.5)  # the quartiles of a normal distribution

    @pytest.mark.parametrize(
        ("period", "interval", "walk", "resets"),
        [
            (240, 50.0, 0.0, 0.0),
            (60, 1e9, 0.01, 0.02),
            (7, 2.0, 0.0, 0.02),
            (1, 50.0, 0.01, 0),
        ],
    )
    def test_signals_are_distributed_by_the_age_of_the_episode(
        self, library, period, interval, walk, resets
    ):
        n, variance, size, jump = 600, 2.0, 4.0, 2.0
        env = library.make(
            n, noise_variance=variance, c=[1.0, 3.0], setpoint="random", setpoint_period=period,
            setpoint_amplitude=size, disturbance_amplitude=jump, disturbance_interval=interval,
            disturbance_walk_variance=walk, delay=25, max_episode_steps=130,
        )  # fmt: skip
        names = "setpoint", "noise", "disturbance"
        infos = plain(env.reset(seed=6)[1])
        rng, age, ended = np.random.default_rng(0), np.zeros(n, int), np.zeros(n, bool)
        rows = [(age, *(infos[name] for name in names))]
        for _ in range(250):
            _, _, _, truncated, infos = plain(env.step(np.zeros((n, 1))))
            mask = rng.random(n) < resets
            first = plain(env.reset(options={"reset_mask": mask})[1]) if resets else infos
            age = np.where(ended | mask, 0, age + 1)
            ended = truncated & ~mask
            rows.append((age, *(np.where(mask, first[name], infos[name]) for name in names)))
        ages, setpoint, noise, load = np.swapaxes(rows, 0, 1)
        assert_mean(noise[ages == 1] ** 2, variance)
        assert_mean(noise[ages == 2] ** 2, variance * (1 + 3**2))
        assert_mean((noise[1:] * noise[:-1])[ages[1:] == 2], variance * 3)
        # Every ten samples a load takes a step of its walk, and may jump to another level.
        moves, due = np.diff(load, axis=0), (ages[1:] % 10 == 0) & (ages[1:] > 0)
        assert not load[ages < 10].any()
        assert not moves[(ages[1:] > 0) & ~due].any()
        jumps = min(10 / interval, 1)
        jumped = 1 - (1 - jumps) ** (ages[1:][due] / 10 - 1)
        assert_mean(moves[due] != 0.0, 1.0 if walk else jumps)
        assert_mean(moves[due], 0.0)
        squares = 10 * walk + jumps * (1 + jumped) * jump**2 / 3
        assert_mean(moves[due] ** 2, squares.mean())
        assert walk or np.abs(load).max() <= jump
        # Set points change at the renewals of what they are held for, uniform within two ends.
        shortest, longest = max(1, -(-period // 6)), max(1, -(-period // 6), period // 2)
        held = np.zeros(longest + 1)
        held[shortest:] = 1 / (longest + 1 - shortest)
        renewals = lfilter([1.0], [1.0, *-held[1:]], np.eye(1, 131)[0]).round(9)
        changes = np.diff(setpoint, axis=0, prepend=0.0) != 0.0
        for decade in range(13):
            at = ages // 10 == decade
            assert_mean(changes[at], renewals[ages[at].astype(int)].mean())
        for power, moment in ((1, 0.0), (2, size**2 / 3), (4, size**4 / 5)):
            assert_mean(setpoint[changes] ** power, moment)
        assert np.abs(setpoint).max() <= size

    def test_the_seed_is_all_that_differs(self, library):
        def trajectory(seed):
            signals = {**PRESETS["hard"], "measurement_noise_variance": 0.1}
            env = library.make(5, **signals, max_episode_steps=50)
            env.reset(seed=seed)
            # Of the set point and of all noises.
            return [plain(env.step(np.zeros((5, 1)))[0]) for _ in range(120)]

        assert_the_seed_is_all_that_differs(trajectory)
        assert not np.array_equal(trajectory(None), trajectory(None))
