"""Tests of `mptc_gym.sb3`: the batch against DummyVecEnv, zips, and the callback."""

import copy
import zipfile
from functools import partial

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.wrappers import DelayObservation, NormalizeObservation, TransformObservation
from stable_baselines3 import PPO
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
)

from mptc_gym import MiddlePointEnv, evaluate
from mptc_gym.evaluation import VALIDATION_SEED
from mptc_gym.sb3 import GymnasiumVecEnv, ScoreCallback, load, make_vec_env, save, spec_of
from mptc_gym.sb3.models import SPEC_FILE
from mptc_gym.wrappers import IncrementalAction

HARD = "MiddlePointHard-v0"
INCREMENTS = {"max_move": 0.3, "compensate_dead_zone": True}
TRAINING = {"action_window": 20, "setpoint": "random", "reward": "absolute"}
SHORT = {"setpoint": "random", "setpoint_period": 20, "max_episode_steps": 30}
# Numbers and arguments of the plants in two batches.
TWO_KINDS = [(3, {"noise_variance": 0.5, **SHORT}), (1, SHORT)]


def two_batches(mode="SameStep"):
    batches = [
        gymnasium.make_vec("MiddlePoint-v0", n, autoreset_mode=mode, **arguments)
        for n, arguments in TWO_KINDS
    ]
    return GymnasiumVecEnv(*batches)


def one(**arguments):
    return gymnasium.make("MiddlePoint-v0", **arguments)


def model_of(plants, **arguments):
    small = {"n_steps": 32, "batch_size": 32, "n_epochs": 2, "device": "cpu"}
    return PPO("MlpPolicy", plants, **small, **arguments)


class TestBatches:
    @pytest.mark.parametrize("kind", ["wrapped", "two"])
    def test_they_equal_dummy_vec_env(self, kind, rng):
        if kind == "two":
            batch = two_batches()
            makers = [partial(one, **arguments) for n, arguments in TWO_KINDS for _ in range(n)]
        else:
            arguments = {**TRAINING, "max_episode_steps": 7}
            wrapper = partial(IncrementalAction, **INCREMENTS)
            batch = make_vec_env(HARD, 4, wrapper=wrapper, **arguments)
            makers = [lambda: wrapper(gymnasium.make(HARD, **arguments))] * 4
        dummy = DummyVecEnv([lambda make=make: Monitor(make()) for make in makers])
        batch.seed(3)
        dummy.seed(3)
        for name in ("num_envs", "observation_space", "action_space"):
            assert getattr(batch, name) == getattr(dummy, name)
        ends = 0
        for _ in range(2):
            np.testing.assert_array_equal(batch.reset(), dummy.reset())
            for _ in range(70):
                actions = rng.normal(0, 1, (4, 1)).astype(np.float32)
                *arrays, infos = batch.step(actions)
                *expected_arrays, expected_infos = dummy.step(actions)
                for array, expected in zip(arrays, expected_arrays, strict=True):
                    np.testing.assert_array_equal(array, expected)
                    assert array.dtype == expected.dtype
                ended = arrays[2]
                assert [bool(info) for info in infos] == ended.tolist()
                for i in np.flatnonzero(ended):
                    episode = infos[i].pop("episode")
                    expected = expected_infos[i].pop("episode")
                    assert episode["r"] == pytest.approx(expected["r"], abs=2e-6)
                    assert episode["l"] == expected["l"]
                    assert data_equivalence(infos[i], expected_infos[i], exact=True)
                ends += ended.sum()
                assert batch.reset_infos == dummy.reset_infos
        assert ends >= 16

    def test_only_plants_of_a_group_have_the_same_random_numbers(self, rng):
        plants = make_vec_env(HARD, 6, seed=3, group=3)
        apart = make_vec_env(HARD, 2, seed=3)
        for _ in range(2):  # of the seed, and of what follows it
            seen = plants.reset()
            np.testing.assert_array_equal(seen, np.repeat(apart.reset(), 3, axis=0))
            assert not np.array_equal(seen[0], seen[3])
            plants.step(rng.normal(0, 1, (6, 1)))
            assert len(np.unique(plants.infos["noise"])) == 2

    def test_attributes_and_pictures_are_those_of_the_batches(self):
        pictured = make_vec_env("MiddlePoint-v0", 2, render_mode="rgb_array")
        pictured.reset()
        np.testing.assert_array_equal(pictured.get_images(), pictured.batches[0].render())
        batch = two_batches()
        batch.reset()
        batch.step(np.ones((4, 1), np.float32))
        assert list(batch.infos["command"]) == [10.0] * 4
        assert list(batch.infos["noise"] != 0.0) == [True, True, True, False]
        assert [p.noise_variance for p in batch.get_attr("parameters", [0, 3])] == [0.5, 0.0]
        assert batch.env_is_wrapped(Monitor) == [False] * 4
        for refuse in (batch.set_attr, batch.env_method):
            with pytest.raises(NotImplementedError, match=r"use `batches`, .*parameters"):
                refuse("parameters", None)
        with pytest.raises(ValueError, match=r"autoreset_mode 'SameStep', got .*NEXT_STEP"):
            two_batches("NextStep")

    def test_bad_arguments_are_named(self):
        for message, arguments in {
            "n_envs must be an integer from 1": {"n_envs": 0},
            "group must be an integer from 1": {"group": 2},
            "seed must be an integer from 0": {"seed": "a"},
            "env must be of this pack": {"env": DelayObservation(one(), delay=2).spec},
            "max_move must be": {"wrapper": {"max_move": 7}},
            "wrapper must be arguments of Incr": {"wrapper": {"maxmove": 1.0}},
            "wrapper must be IncrementalAction, or": {"wrapper": "IncrementalAction"},
            "env must be the id of an environment": {"env": "Point-v0"},
        }.items():
            with pytest.raises(ValueError, match=message):
                make_vec_env(**arguments)


class TestZips:
    def test_a_model_comes_back_with_environments_like_its_own(self, tmp_path):
        plants = make_vec_env(HARD, 3, wrapper=INCREMENTS, action_window=4, max_episode_steps=9)
        model = model_of(plants)
        save(model, tmp_path / "model")
        assert [file.name for file in tmp_path.iterdir()] == ["model.zip"]
        loaded = load(tmp_path / "model", device="cpu")
        assert loaded.get_env().num_envs == 3
        assert loaded.get_env().get_attr("spec")[0].max_episode_steps == 9
        assert spec_of(loaded, HARD) == spec_of(model, HARD)
        # It is a zip of Stable-Baselines3 all the same.
        bare = PPO.load(tmp_path / "model.zip", device="cpu")
        observation = np.ones((1, 10), np.float32)
        actions = [m.predict(observation, deterministic=True)[0] for m in (loaded, bare, model)]
        assert actions[0] == actions[1] == actions[2]
        loaded.learn(64)

    def test_a_name_stays_as_it_is_and_one_that_is_too_long_is_refused(self, tmp_path):
        save(model := model_of(make_vec_env()), tmp_path / "model.step8")
        (tmp_path / "other").touch()
        modes = {file.name: file.stat().st_mode for file in tmp_path.iterdir()}
        assert modes["model.step8"] == modes["other"]
        with pytest.raises(ValueError, match="cannot be written: File name too long"):
            save(model, tmp_path / ("m" * 300))

    @pytest.mark.parametrize(
        ("make", "message"),
        [
            (
                lambda: VecNormalize(make_vec_env()),
                "no VecEnvWrapper, to be .* VecNormalize: .*env",
            ),
            (lambda: VecFrameStack(make_vec_env(), 2), "to be saved here, got VecFrameStack"),
            (MiddlePointEnv, "must come from gymnasium.make or make_vec_env, .* got None"),
            (two_batches, "must come from gymnasium.make or make_vec_env"),
            (
                lambda: DummyVecEnv([one, lambda: gymnasium.make("MiddlePointNoisy-v0")]),
                "differ",
            ),
            (lambda: TransformObservation(one(), abs, None), "can be imported and rec"),
            (lambda: NormalizeObservation(one()), "in no wrapper that normalises by running"),
            (lambda: type("Local", (DelayObservation,), {})(one(), 2), "can be imported"),
        ],
    )
    def test_what_cannot_be_saved_is_refused_before_a_training(self, make, message, tmp_path):
        model = model_of(make())
        with pytest.raises(ValueError, match=message):
            save(model, tmp_path / "model.zip")
        with pytest.raises(ValueError, match=message):
            model.learn(64, ScoreCallback(one, path=tmp_path / "best.zip"))
        assert model.num_timesteps == 0
        assert not [*tmp_path.iterdir()]

    def test_damaged_and_other_zips_are_refused(self, tmp_path):
        model, file = model_of(make_vec_env(wrapper=INCREMENTS)), tmp_path / "model.zip"
        save(model, file)
        with zipfile.ZipFile(file) as archive:
            record = archive.read(SPEC_FILE).decode()
        for edited, message in (
            ("{}", "KeyError"),
            (record.replace("PPO", "PPOO"), "AttributeError"),
            (record.replace("MiddlePointEnv", "Nothing"), "save .AttributeErr.*Nothing"),
            (None, "cannot be loaded as a zip of mptc_gym.sb3.save .*; load other zips by"),
        ):
            model.save(file)
            if edited:
                with zipfile.ZipFile(file, "a") as archive:
                    archive.writestr(SPEC_FILE, edited)
            with pytest.raises(ValueError, match=message):
                load(file)
        save(model, file)
        file.write_bytes(file.read_bytes()[:500])
        with pytest.raises(ValueError, match="cannot be loaded as a zip of mptc_gym"):
            load(file)
        with pytest.raises(ValueError, match=r"path must be an existing file, .*none\.zip"):
            load(tmp_path / "none.zip")


def test_spec_of_a_model_has_its_windows_and_wrappers():
    model = model_of(make_vec_env("MiddlePoint-v0", 2, wrapper=INCREMENTS, **TRAINING))
    other = DelayObservation(gymnasium.make(HARD, output_window=2), 3).spec
    for env in (HARD, other):
        env = gymnasium.make(spec_of(model, env, delay=3))
        assert isinstance(env, IncrementalAction)
        parameters = env.unwrapped.parameters
        assert (parameters.action_window, parameters.output_window) == (20, 0)
        assert (parameters.delay, parameters.setpoint) == (3, "random")
    with pytest.raises(ValueError, match=r"windows .* of policy's training"):
        evaluate(model, spec_of(model, HARD, action_window=3))
    with pytest.raises(ValueError, match="model must have its environments"):
        spec_of(model.policy)
    # Plants may differ in a training.
    both = DummyVecEnv([one, lambda: gymnasium.make("MiddlePointNoisy-v0")])
    assert spec_of(model_of(both), HARD).kwargs["error_window"] == 3


class TestScoreCallback:
    def test_it_records_scores_and_keeps_the_best_policy(self, tmp_path, capsys):
        plants = make_vec_env("MiddlePoint-v0", 2, seed=0, wrapper=INCREMENTS, **TRAINING)
        noisy, best = "MiddlePointNoisy-v0", tmp_path / "best.zip"
        callback = ScoreCallback(noisy, every=128, episodes=3, path=best)
        model = model_of(plants, seed=2, learning_rate=0.01)  # gets worse
        model.set_logger(configure(str(tmp_path / "log"), ["csv"]))
        model.learn(192, callback=callback)
        model.logger.close()
        assert [samples for samples, _ in callback.scores] == [128, 192]
        errors = [evaluation.mean_error for _, evaluation in callback.scores]
        assert callback.best.mean_error == min(errors)
        kept = load(best, device="cpu")
        again = evaluate(kept, spec_of(kept, noisy), episodes=3, seed=VALIDATION_SEED)
        assert again.mean_error == min(errors)
        shown = capsys.readouterr().out.splitlines()
        assert shown[0].startswith(f"128 of 192 samples: {noisy}: mean error ")
        least = np.minimum.accumulate([np.inf, *errors])[:-1]
        assert [line.endswith("; best") for line in shown] == list(errors < least)
        logged = (tmp_path / "log" / "progress.csv").read_text()
        assert "score/mean_error" in logged
        assert "score/score" in logged

    def test_each_training_has_its_own_scores(self):
        model = model_of(make_vec_env("MiddlePointNoisy-v0", 2, max_episode_steps=5)).learn(64)
        callback = ScoreCallback(every=64, episodes=2, verbose=0, max_episode_steps=5)
        model.learn(128, callback=callback, reset_num_timesteps=False)
        model.learn(96, callback=callback)
        assert [samples for samples, _ in callback.scores] == [128, 192, 64, 128]

    def test_statistics_of_the_training_are_handed_over(self):
        made = partial(make_vec_env, HARD, 2, max_episode_steps=40)
        model = model_of(VecNormalize(made(seed=0)))
        separate = VecNormalize(made())
        before = vars(copy.deepcopy(separate.obs_rms))
        callback = ScoreCallback(separate, every=64, episodes=2, verbose=0)
        model.learn(64, callback)
        again = evaluate(model, model.get_env(), episodes=2, seed=VALIDATION_SEED)
        assert again.mean_error == callback.best.mean_error
        for name, value in vars(separate.obs_rms).items():
            np.testing.assert_array_equal(value, before[name])

    @pytest.mark.parametrize("wrap", [lambda env: env, VecMonitor])
    def test_it_takes_the_environments_of_the_training(self, wrap):
        def weights(score):
            env = VecNormalize(make_vec_env(HARD, 2, seed=0, max_episode_steps=40))
            model = model_of(env, seed=0)
            callback = ScoreCallback(wrap(env), every=32, episodes=2, verbose=0)
            model.learn(192, callback if score else None)
            assert len(callback.scores) == 6 * score
            return [weight.detach().numpy() for weight in model.policy.parameters()]

        for scored, plain in zip(weights(True), weights(False), strict=True):
            np.testing.assert_array_equal(scored, plain)

    def test_it_overwrites_no_file_but_its_own(self, tmp_path):
        best, hidden = tmp_path / "best.zip", tmp_path / ".best.zip"
        hidden.write_text("a user's")
        made = partial(make_vec_env, max_episode_steps=5)
        callback = ScoreCallback(path=best, every=32, episodes=2, verbose=0)
        model = model_of(made())
        model.learn(32, callback)
        model.learn(32, callback)  # may replace its own
        first = best.read_bytes()
        with pytest.raises(ValueError, match="path must be a file that does not exist yet"):
            model_of(made()).learn(32, ScoreCallback(path=best, episodes=2, verbose=0))
        assert best.read_bytes() == first
        assert hidden.read_text() == "a user's"
        assert {*tmp_path.iterdir()} == {best, hidden}

    def test_it_refuses_what_cannot_be_scored(self, tmp_path):
        with pytest.raises(ValueError, match="every must be an integer from 1"):
            ScoreCallback(every=0)
        with pytest.raises(ValueError, match="zip cannot be written: No such file"):
            model_of(make_vec_env()).learn(64, ScoreCallback(path=tmp_path / "none" / "best"))
        model = model_of(VecNormalize(make_vec_env()))
        for env, message in (
            (model.get_env().venv, "training, VecNormalize.clip_obs=10., got none"),
            (make_vec_env(), "training, VecNormalize.clip_obs=10., got none"),
            ("MiddlePoint-v0", "wrappers of policy's training, VecNormalize"),
            (one, "wrappers of policy's training, VecNormalize"),
        ):
            with pytest.raises(ValueError, match=message):
                model.learn(64, ScoreCallback(env))
        assert model.num_timesteps == 0
