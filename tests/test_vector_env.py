"""The vector environment: equal, to the bit, to one environment after the other."""

import pickle
import tracemalloc
from copy import deepcopy
from unittest.mock import patch

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.vector import AutoresetMode, VectorEnv
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mptc_gym import PRESETS, MiddlePointEnv, MiddlePointVectorEnv
from tests.conftest import MODES, NOISY, native_and_sync, random_actions, valid_arguments

CHANGE = {"action": "change", "max_move": 0.3, "compensated_dead_zone": 5.0}


def assert_equal(ours, theirs):
    assert data_equivalence(ours, theirs, exact=True), f"{ours}\n\n{theirs}"
    # 0 and -0 are equal, but not the same.
    (observations, *_, infos), (other_observations, *_, other_infos) = ours, theirs
    pairs = [(infos[name], other_infos[name]) for name in ("applied", "output")]
    for values, other_values in [(observations, other_observations), *pairs]:
        np.testing.assert_array_equal(np.signbit(values), np.signbit(other_values))


def compare(native, sync, *, steps, rng, partial_resets):
    n, mode = native.num_envs, native.metadata["autoreset_mode"]
    ended = np.zeros(n, np.bool_)  # and reset by the next step, which takes no action
    for _ in range(steps):
        actions = random_actions(rng, n)
        actions[ended] = np.nan
        ours, theirs = native.step(actions), sync.step(actions)
        assert_equal(ours, theirs)
        # More often of those that have ended.
        mask = rng.random(n) < partial_resets * np.where(ours[3], 3.0, 1.0)
        if mode is AutoresetMode.DISABLED:
            mask |= ours[3]
        if mask.any():
            seeds = [None if rng.random() < 0.5 else int(rng.integers(100)) for _ in range(n)]
            arguments = {"seed": seeds, "options": {"reset_mask": mask}}
            # Gymnasium's environment removes the mask from the options.
            assert_equal(native.reset(**deepcopy(arguments)), sync.reset(**deepcopy(arguments)))
        ended = ours[3] & ~mask & (mode is AutoresetMode.NEXT_STEP)


@settings(max_examples=20, deadline=None)
@given(
    arguments=valid_arguments,
    num_envs=st.integers(1, 6),
    mode=st.sampled_from(MODES),
    limit=st.none() | st.integers(1, 10) | st.integers(11, 40),
    partial_resets=st.sampled_from([0.0, 0.05, 0.3]),
    seed=st.integers(0, 2**40) | st.none(),
    randomness=st.integers(0, 2**32),
)
# Plants that end often, and whose flow is then 0 again.
@example({"action": "change"}, 3, "NextStep", 4, 0.3, 0, 0)
def test_it_equals_one_environment_after_the_other(
    arguments, num_envs, mode, limit, partial_resets, seed, randomness
):
    rng = np.random.default_rng(randomness)
    if seed is None:
        seed = rng.integers(0, 2**40, num_envs).tolist()
    # So small that many blocks are made and the window is moved back often. The blocks of the
    # single environments are not shortened.
    _, sync = native_and_sync(num_envs, mode, limit, **arguments)
    with (
        patch("mptc_gym.vector_env.STEPS_PER_SHIFT", 3),
        patch("mptc_gym.plant.signals.PLANTS_AT_A_TIME", 2),
    ):
        with patch("mptc_gym.plant.signals.BLOCK_BYTES", 7 * 4 * 8 * num_envs):
            native, _ = native_and_sync(num_envs, mode, limit, **arguments)
        assert_equal(native.reset(seed=seed), sync.reset(seed=seed))
        compare(native, sync, steps=40, rng=rng, partial_resets=partial_resets)
        assert_equal(native.reset(), sync.reset())
        compare(native, sync, steps=10, rng=rng, partial_resets=partial_resets)


@pytest.mark.parametrize("samples", [1, 7, 10, 64])
@pytest.mark.parametrize("mode", MODES)
def test_shortened_blocks_change_nothing(mode, samples, rng):
    arguments = {**PRESETS["hard"], "setpoint_period": 30, "measurement_noise_variance": 0.1}
    _, sync = native_and_sync(3, mode, 45, **arguments)
    values_per_sample = 3 * 4  # of 3 plants with 4 random signals
    with patch("mptc_gym.plant.signals.BLOCK_BYTES", 8 * values_per_sample * samples):
        native, _ = native_and_sync(3, mode, 45, **arguments)
    assert len(native._signals.noise._block) <= samples
    assert_equal(native.reset(seed=5), sync.reset(seed=5))
    compare(native, sync, steps=150, rng=rng, partial_resets=0.02)


def test_the_blocks_of_many_plants_take_at_most_256_mib():
    envs = MiddlePointVectorEnv(50_000, **PRESETS["hard"])
    blocks = [signal._block for signal in envs._signals]
    assert 200 * 2**20 < sum(block.nbytes for block in blocks) <= 256 * 2**20


@pytest.mark.parametrize(
    ("mode", "limit", "steps", "arguments"),
    [
        *((m, 300, 700, {"action_window": 20, "move_weight": 0.1, **NOISY}) for m in MODES),
        ("NextStep", 1200, 700, PRESETS["hard"]),
        ("NextStep", 150, 400, {"delay": [0, 100], "b": [0.3, -0.2, 0.1]}),
        # An actuator that does not reach zero flow, and one that ends there, at minus zero.
        ("NextStep", 9, 30, {"u_min": 6.0, "u_max": 8.0, "dead_zone": 2.0, "move_weight": 0.5}),
        ("NextStep", 9, 30, {"u_min": -0.0, "dead_zone": 0.0}),
        *((m, 7, 60, {**PRESETS["hard"], "move_weight": 0.1, **CHANGE}) for m in MODES),
    ],
    ids=str,
)
def test_it_equals_them_over_long_times_and_at_the_edge(mode, limit, steps, arguments, rng):
    native, sync = native_and_sync(3, mode, limit, **{"action_window": 3, **arguments})
    assert_equal(native.reset(seed=5), sync.reset(seed=5))
    # Signals of one plant are generated for 600 samples at a time, unless a reset comes first.
    partial_resets = 0.005 if limit < 600 else 0.0
    compare(native, sync, steps=steps, rng=rng, partial_resets=partial_resets)


def test_tensors_that_numpy_cannot_read_are_refused_with_the_reason():
    torch = pytest.importorskip("torch", reason="its tensors are the actions")
    zeros = torch.zeros(2, 1)
    for actions, reason in [
        (torch.zeros(2, 1, requires_grad=True), r"requires grad\. Use tensor\.detach\(\)"),
        (zeros.bfloat16(), r"BFloat16; pass tensor\.detach\(\)\.float\(\)\.cpu\(\)"),
        (zeros.to("meta"), r"meta device .* Use Tensor\.cpu\(\)"),
    ]:
        for env, name in (MiddlePointVectorEnv(2), "actions"), (MiddlePointEnv(), "action"):
            env.reset(seed=0)
            with pytest.raises(ValueError, match=rf"(?s)^{name} must be .*{reason}"):
                env.step(actions)
    native = MiddlePointVectorEnv(2)
    native.reset(seed=0)
    native.step(zeros)


def test_a_plant_costs_a_few_kib_and_nothing_grows_in_the_long_run():
    arguments = {"max_episode_steps": 10**6, "action_window": 20, **NOISY}
    tracemalloc.start()
    envs = MiddlePointVectorEnv(500, **arguments)
    envs.reset(seed=0)
    envs.step(np.zeros((500, 1)))
    size, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert size / 500 < 16 * 1024  # of which two blocks of 600 samples take 9.4 KiB
    envs, sizes = MiddlePointVectorEnv(2, **arguments), []
    envs.reset(seed=0)
    for _ in range(2):
        for _ in range(1_200):
            envs.step(np.full((2, 1), 0.6, np.float32))
        sizes.append(len(pickle.dumps(envs)))
    assert sizes[1] <= sizes[0] + 100  # the counters become longer numbers, no more


@pytest.mark.parametrize("copied", [deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
@pytest.mark.parametrize("mode", [None, "NextStep", "SameStep"])
def test_copies_in_the_middle_of_an_episode_go_on_alike(copied, mode, rng):
    env = gymnasium.make("MiddlePoint-v0", **NOISY)
    if mode:
        env = MiddlePointVectorEnv(3, max_episode_steps=100, autoreset_mode=mode, **NOISY)
    env.reset(seed=0)
    for _ in range(130):
        env.step(rng.uniform(-1, 1, env.action_space.shape))
    twin = copied(env)
    for _ in range(700):
        actions = rng.uniform(-1, 1, env.action_space.shape)
        assert_equal(env.step(actions), twin.step(actions))
    assert data_equivalence(env.reset(), twin.reset(), exact=True)


def test_the_seed_of_each_plant_can_be_read():
    envs = MiddlePointVectorEnv(3)
    assert envs.np_random_seed == (None, None, None)
    envs.reset()
    assert len(set(envs.np_random_seed)) == 3  # none meets the noise of another
    envs.reset(seed=np.int64(3))
    assert envs.np_random_seed == (3, 4, 5)
    envs.reset(seed=[7, None, 9])
    assert envs.np_random_seed == (7, 4, 9)


def test_it_is_a_direct_child_of_gymnasium_s():
    # By which skrl tells whose environment it is.
    assert VectorEnv in MiddlePointVectorEnv.__bases__
