"""Tests of `mptc_gym.sb3`: the batch against DummyVecEnv, and the callback."""

from functools import partial

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import SyncVectorEnv
from gymnasium.wrappers import DelayObservation
from stable_baselines3 import PPO
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from mptc_gym import MiddlePointEnv, evaluate
from mptc_gym.evaluation import SEED
from mptc_gym.sb3 import GymnasiumVecEnv, ScoreCallback, load, make_vec_env, spec_of
from mptc_gym.wrappers import IncrementalAction
from mptc_gym.wrappers.vector import IncrementalAction as VectorIncrementalAction

N = 4
HARD = "MiddlePointHard-v0"
ARGUMENTS = {
    "max_episode_steps": 30, "noise_variance": 0.5, "setpoint": "random", "setpoint_period": 20,
}  # fmt: skip
TWO = [(3, ARGUMENTS), (1, {**ARGUMENTS, "noise_variance": 0.0})]
VELOCITY = {"max_move": 0.3, "compensate_dead_zone": True}
TRAINING = {"action_window": 20, "setpoint": "random", "reward": "absolute"}


def two_batches():
    return GymnasiumVecEnv(*(
        gymnasium.make_vec("MiddlePoint-v0", n, autoreset_mode="SameStep", **given)
        for n, given in TWO
    ))  # fmt: skip


def make_both(kind):
    """Return a batch, and the same in Stable-Baselines3's own way, both with the seed 3."""
    if kind == "wrapped":
        given = {**TRAINING, "max_episode_steps": 7}
        ours = make_vec_env(HARD, N, seed=3, wrapper=VELOCITY, **given)
        made = [lambda: IncrementalAction(gymnasium.make(HARD, **given), **VELOCITY)] * N
    elif kind == "two":
        ours = two_batches()
        made = [
            partial(gymnasium.make, "MiddlePoint-v0", **each)
            for n, each in TWO
            for _ in range(n)
        ]
    else:
        made = [partial(gymnasium.make, "CartPole-v1", max_episode_steps=15)] * N
        ours = GymnasiumVecEnv(SyncVectorEnv(made, autoreset_mode="SameStep"))
    theirs = DummyVecEnv([lambda one=one: Monitor(one()) for one in made])
    for each in (theirs,) if kind == "wrapped" else (ours, theirs):
        each.seed(3)
    return ours, theirs


def test_a_group_draws_the_same_and_no_other_does(rng):
    plants = make_vec_env(HARD, 6, seed=3, group=3)
    apart = make_vec_env(HARD, 2, seed=3)
    for _ in range(2):  # of the seed, and of what follows it
        seen = plants.reset()
        np.testing.assert_array_equal(seen, np.repeat(apart.reset(), 3, axis=0))
        assert not np.array_equal(seen[0], seen[3])
        seen = plants.step(rng.normal(0, 1, (6, 1)))[0]
        assert len(np.unique(plants.infos["noise"])) == 2


@pytest.mark.parametrize("kind", ["wrapped", "two", "terminate"])
def test_trajectories_equal_those_of_dummy_vec_env(kind, rng):
    ours, theirs = make_both(kind)
    assert ours.num_envs == theirs.num_envs
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    truncated = []
    for _ in range(2):
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
                assert ("terminal_observation" in info) == ("episode" in info) == done
                if done:
                    last = info["terminal_observation"]
                    np.testing.assert_array_equal(last, other["terminal_observation"])
                    truncated.append(info["TimeLimit.truncated"])
                    own, its = info["episode"], other["episode"]
                    assert own["r"] == pytest.approx(its["r"], abs=2e-6)
                    assert own["l"] == its["l"]
    assert set(truncated) == ({True, False} if kind == "terminate" else {True})


def test_pictures_are_those_of_the_batch():
    ours = make_vec_env("MiddlePoint-v0", 2, render_mode="rgb_array")
    ours.reset()
    np.testing.assert_array_equal(ours.get_images(), ours.batches[0].render())
    assert ours.render().shape == (2 * 540, 960, 3)


def test_batches_of_another_mode_or_of_other_spaces_are_refused():
    with pytest.raises(ValueError, match=r"autoreset_mode 'SameStep', got .*NEXT_STEP"):
        GymnasiumVecEnv(gymnasium.make_vec("MiddlePoint-v0", N))
    batches = [
        gymnasium.make_vec("MiddlePoint-v0", 2, autoreset_mode="SameStep", action_window=window)
        for window in (0, 1)
    ]
    with pytest.raises(ValueError, match="same spaces"):
        GymnasiumVecEnv(*batches)


def test_infos_and_attributes_are_those_of_the_batches():
    ours = two_batches()
    ours.reset()
    ours.step(np.ones((N, 1), np.float32))
    assert list(ours.infos["command"]) == [10.0] * N
    assert np.all(ours.infos["noise"][:3] != 0.0)
    assert ours.infos["noise"][3] == 0.0
    assert [p.noise_variance for p in ours.get_attr("parameters")] == [0.5, 0.5, 0.5, 0.0]
    assert [p.noise_variance for p in ours.get_attr("parameters", [0, 3])] == [0.5, 0.0]
    assert ours.get_attr("render_mode") == [None] * N
    assert ours.env_is_wrapped(Monitor) == [False] * N
    with pytest.raises(NotImplementedError, match="parameters"):
        ours.set_attr("parameters", None)
    with pytest.raises(NotImplementedError, match="reset"):
        ours.env_method("reset")
    ours.set_options({"level": 3})
    with pytest.raises(ValueError, match="options"):
        ours.reset()


def model_of(plants, **arguments):
    return PPO(
        "MlpPolicy", plants, n_steps=32, batch_size=32, n_epochs=2, device="cpu", **arguments
    )


class TestMakeVecEnv:
    @pytest.mark.parametrize(
        "wrapper",
        [
            VELOCITY, partial(IncrementalAction, **VELOCITY),
            partial(VectorIncrementalAction, **VELOCITY),
            lambda env: IncrementalAction(env, **VELOCITY),
        ],
    )  # fmt: skip
    def test_the_spec_makes_the_same_environment(self, wrapper):
        spec = make_vec_env("MiddlePoint-v0", 2, wrapper=wrapper, **TRAINING).spec
        env = gymnasium.make(EnvSpec.from_json(spec.to_json()))
        assert isinstance(env, IncrementalAction)
        assert spec.additional_wrappers[0].kwargs == VELOCITY
        assert env.unwrapped.parameters.action_window == 20

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ({"n_envs": 0}, "n_envs must be an integer from 1"),
            ({"wrapper": 3}, "wrapper must be the arguments of IncrementalAction"),
            ({"wrapper": partial(DelayObservation, delay=2)}, "wrapper must be IncrementalAct"),
            ({"wrapper": {"max_move": 7}}, "max_move must be"),
            ({"env": "MiddlePointEasy-v0"}, "env must be the id of an environment"),
            ({"delay": -2}, "delay must be"),
        ],
    )
    def test_what_is_refused(self, arguments, message):
        with pytest.raises(ValueError, match=message):
            make_vec_env(**arguments)


class TestScoreCallback:
    def test_it_scores_keeps_the_best_and_tells(self, tmp_path, capsys):
        plants = make_vec_env("MiddlePoint-v0", 2, seed=0, wrapper=VELOCITY, **TRAINING)
        callback = ScoreCallback(
            "MiddlePointNoisy-v0", every=128, episodes=3, path=tmp_path / "best.zip"
        )
        model = model_of(plants, seed=2, learning_rate=0.01)  # gets worse
        model.set_logger(configure(str(tmp_path / "log"), ["csv"]))
        model.learn(192, callback=callback)
        model.logger.close()
        assert [samples for samples, _ in callback.scores] == [128, 192]
        errors = [found.mean_error for _, found in callback.scores]
        assert callback.best.mean_error == min(errors)
        spec = spec_of(tmp_path / "best.zip", "MiddlePointNoisy-v0")
        kept = load(tmp_path / "best.zip", device="cpu")
        found = evaluate(kept, spec, episodes=3, seed=SEED + 100)
        assert found.mean_error == min(errors)
        shown = capsys.readouterr().out.splitlines()
        assert shown[0].startswith("128 of 192 samples: MiddlePointNoisy-v0: mean error ")
        least = np.minimum.accumulate([np.inf, *errors])[:-1]
        assert [line.endswith("; best") for line in shown] == list(errors < least)
        logged = (tmp_path / "log" / "progress.csv").read_text()
        assert "score/mean_error" in logged
        assert "score/score" in logged

    def test_each_training_has_its_own_scores(self):
        model = model_of(
            make_vec_env("MiddlePointNoisy-v0", 2, seed=0, max_episode_steps=5)
        ).learn(256)
        callback = ScoreCallback(every=64, episodes=2, verbose=0, max_episode_steps=5)
        model.learn(128, callback=callback, reset_num_timesteps=False)
        assert [samples for samples, _ in callback.scores] == [320, 384]
        model.learn(96, callback=callback)
        assert [samples for samples, _ in callback.scores[2:]] == [64, 128]
        model.learn(128, callback=callback)
        assert [samples for samples, _ in callback.scores[4:]] == [64, 128]

    def test_it_refuses_what_it_cannot_judge(self, tmp_path):
        with pytest.raises(ValueError, match="every must be an integer from 1"):
            ScoreCallback(every=0)
        with pytest.raises(ValueError, match="path must be the name of a zip"):
            ScoreCallback(path=tmp_path)
        env = DelayObservation(MiddlePointEnv(), 2)  # made without a spec
        with pytest.raises(ValueError, match="DelayObservation does not record its arguments"):
            model_of(env).learn(32, callback=ScoreCallback())
