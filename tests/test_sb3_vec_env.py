"""The adapter to Stable-Baselines3, against DummyVecEnv."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import SyncVectorEnv
from stable_baselines3 import PPO
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from benchmarks.train.sb3_vec_env import GymnasiumVecEnv
from tests.test_ppo import parameters_of

N = 4
ARGUMENTS = {
    "max_episode_steps": 30, "noise_variance": 0.5, "setpoint": "random", "setpoint_period": 20,
}  # fmt: skip


def make_both():
    def make():
        return gymnasium.make("MiddlePoint-v0", **ARGUMENTS)

    envs = gymnasium.make_vec("MiddlePoint-v0", N, autoreset_mode="SameStep", **ARGUMENTS)
    return GymnasiumVecEnv(envs), DummyVecEnv([make] * N)


def make_both_of_episodes_that_terminate():
    def make():
        return gymnasium.make("CartPole-v1", max_episode_steps=15)

    envs = SyncVectorEnv([make] * N, autoreset_mode="SameStep")
    return GymnasiumVecEnv(envs), DummyVecEnv([make] * N)


def make_both_of_two_batches():
    calm = {**ARGUMENTS, "noise_variance": 0.0}
    parts = [(3, ARGUMENTS), (1, calm)]
    batches = [
        gymnasium.make_vec("MiddlePoint-v0", count, autoreset_mode="SameStep", **arguments)
        for count, arguments in parts
    ]
    single = [
        lambda arguments=arguments: gymnasium.make("MiddlePoint-v0", **arguments)
        for count, arguments in parts
        for _ in range(count)
    ]
    return GymnasiumVecEnv(*batches), DummyVecEnv(single)


@pytest.mark.parametrize(
    "make", [make_both, make_both_of_two_batches, make_both_of_episodes_that_terminate]
)
def test_trajectories_equal_those_of_dummy_vec_env(make, rng):
    ours, theirs = make()
    assert ours.num_envs == theirs.num_envs
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    truncated = []
    for seed in (3, None):
        if seed is not None:
            assert ours.seed(seed) == theirs.seed(seed)
        np.testing.assert_array_equal(ours.reset(), theirs.reset())
        for _ in range(70):
            actions = rng.normal(0, 1, (N, 1)).astype(np.float32)
            if ours.action_space.shape == ():
                actions = (actions[:, 0] > 0).astype(int)
            *arrays, infos = ours.step(actions)
            *expected, expected_infos = theirs.step(actions)
            for array, other in zip(arrays, expected, strict=True):
                np.testing.assert_array_equal(array, other)
                assert array.dtype == other.dtype
            for info, other, done in zip(infos, expected_infos, arrays[2], strict=True):
                assert info.get("TimeLimit.truncated", False) is other["TimeLimit.truncated"]
                assert ("terminal_observation" in info) == done
                if done:
                    last = info["terminal_observation"]
                    np.testing.assert_array_equal(last, other["terminal_observation"])
                    truncated.append(info["TimeLimit.truncated"])
    terminate = make is make_both_of_episodes_that_terminate
    assert set(truncated) == ({True, False} if terminate else {True})


def test_training_ends_in_the_same_weights():
    trained = [
        PPO("MlpPolicy", envs, n_steps=64, batch_size=64, n_epochs=2, seed=3, device="cpu")
        .learn(1024)
        for envs in make_both()
    ]  # fmt: skip
    assert torch.equal(*map(parameters_of, trained))
    untrained = PPO("MlpPolicy", make_both()[0], seed=3, device="cpu")
    assert not torch.equal(parameters_of(trained[0]), parameters_of(untrained))


def test_infos_of_the_batch_are_at_hand():
    ours, _ = make_both()
    ours.reset()
    assert ours.infos["output"].shape == (N,)
    ours.step(np.ones((N, 1), np.float32))
    assert list(ours.infos["command"]) == [10.0] * N


def test_pictures_are_those_of_the_batch():
    envs = gymnasium.make_vec(
        "MiddlePoint-v0", 2, autoreset_mode="SameStep", render_mode="rgb_array"
    )
    ours = GymnasiumVecEnv(envs)
    ours.reset()
    np.testing.assert_array_equal(ours.get_images(), envs.render())
    assert ours.render().shape == (2 * 540, 960, 3)


def test_another_autoreset_mode_is_refused():
    with pytest.raises(ValueError, match=r"autoreset_mode 'SameStep', got .*NEXT_STEP"):
        GymnasiumVecEnv(gymnasium.make_vec("MiddlePoint-v0", N))


def test_batches_of_other_spaces_are_refused():
    batches = [
        gymnasium.make_vec("MiddlePoint-v0", 2, autoreset_mode="SameStep", action_window=window)
        for window in (0, 1)
    ]
    with pytest.raises(ValueError, match="same spaces"):
        GymnasiumVecEnv(*batches)


def test_infos_and_attributes_of_two_batches():
    ours, _ = make_both_of_two_batches()
    ours.reset()
    ours.step(np.ones((N, 1), np.float32))
    assert list(ours.infos["command"]) == [10.0] * N
    assert np.all(ours.infos["noise"][:3] != 0.0)
    assert ours.infos["noise"][3] == 0.0
    assert [p.noise_variance for p in ours.get_attr("parameters")] == [0.5, 0.5, 0.5, 0.0]


def test_attributes_are_those_of_the_batch():
    ours, _ = make_both()
    assert ours.get_attr("render_mode") == [None] * N
    assert [p.noise_variance for p in ours.get_attr("parameters", [0, 1])] == [0.5, 0.5]
    assert ours.env_is_wrapped(Monitor) == [False] * N
    with pytest.raises(NotImplementedError, match="parameters"):
        ours.set_attr("parameters", None)
    with pytest.raises(NotImplementedError, match="reset"):
        ours.env_method("reset")
    ours.set_options({"level": 3})
    with pytest.raises(ValueError, match="options"):
        ours.reset()
