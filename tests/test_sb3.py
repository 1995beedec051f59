"""Tests of `mptc_gym.sb3`: the batch against DummyVecEnv, and the callback."""

import csv
from contextlib import closing
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.error import Error
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.wrappers import FlattenObservation
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env as monitored_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
)
from torch.nn.utils import parameters_to_vector

from mptc_gym import evaluate
from mptc_gym.evaluation import VALIDATION_SEED
from mptc_gym.sb3 import GymnasiumVecEnv, ScoreCallback, make_vec_env

HARD = "MiddlePointHard-v0"
CHANGE = {"action": "change", "max_move": 0.3, "compensated_dead_zone": 5.0}
TRAINING = {"action_window": 20, "setpoint": "random", "reward": "absolute"}


def one(**arguments):
    return gymnasium.make("MiddlePoint-v0", **arguments)


def model_of(plants, **arguments):
    small = {"n_steps": 32, "batch_size": 32, "n_epochs": 2, "device": "cpu"}
    return PPO("MlpPolicy", plants, **small, **arguments)


class TestBatch:
    @pytest.mark.parametrize("form", [{}, CHANGE])
    def test_it_equals_dummy_vec_env(self, form, rng):
        arguments = {**TRAINING, **form, "max_episode_steps": 7}
        batch = make_vec_env(HARD, 4, **arguments)
        dummy = DummyVecEnv([lambda: Monitor(gymnasium.make(HARD, **arguments))] * 4)
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
                for i in np.flatnonzero(arrays[2]):
                    episode = infos[i].pop("episode")
                    expected = expected_infos[i].pop("episode")
                    assert episode["r"] == pytest.approx(expected["r"], abs=2e-6)
                    assert episode["l"] == expected["l"]
                    assert data_equivalence(infos[i], expected_infos[i], exact=True)
                    ends += 1
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

    def test_attributes_and_pictures_are_those_of_the_batch(self):
        pictured = make_vec_env("MiddlePoint-v0", 2, render_mode="rgb_array", delay=3)
        pictured.reset()
        np.testing.assert_array_equal(pictured.get_images(), pictured.batch.render())
        assert [plant.delay for plant in pictured.get_attr("parameters", [1])] == [3]
        assert pictured.env_is_wrapped(VecMonitor) == [False, False]
        with pytest.raises(ValueError, match=r"autoreset_mode 'SameStep', got .*NEXT_STEP"):
            GymnasiumVecEnv(gymnasium.make_vec("MiddlePoint-v0", 2))


def rewards_of_evaluations(plants, folder):
    """Return the mean rewards of a policy, evaluated in both ways of Stable-Baselines3."""
    plants = VecNormalize(plants, training=False)
    plants.ret_rms.var = np.array(50.0)  # so that normalised rewards differ from the plant's
    model = model_of(plants, seed=0)
    callback = EvalCallback(
        plants, n_eval_episodes=4, eval_freq=16, log_path=folder, verbose=0, warn=False
    )
    model.learn(32, callback)
    plants.seed(5)
    reward, _ = evaluate_policy(model, plants, n_eval_episodes=4)
    with np.load(folder / "evaluations.npz") as evaluations:
        return [reward, *evaluations["results"].ravel()]


def test_evaluations_report_the_rewards_of_the_plants_as_with_monitors(tmp_path):
    arguments = {"max_episode_steps": 9, "setpoint": [5.0, 3.0]}
    both = [
        make_vec_env("MiddlePointNoisy-v0", 2, seed=0, **arguments),
        monitored_vec_env("MiddlePointNoisy-v0", 2, seed=0, env_kwargs=arguments),
    ]
    rewards, expected = (rewards_of_evaluations(plants, tmp_path) for plants in both)
    assert rewards == pytest.approx(expected, abs=2e-6)  # those of a Monitor are rounded
    assert max(rewards) < -1.0


class Weights(BaseCallback):
    """Record the policy's weights, and the global random numbers, at each step."""

    def __init__(self):
        super().__init__()
        self.states = []

    def _on_step(self):
        weights = parameters_to_vector(self.model.policy.parameters()).detach().numpy()
        numbers = np.random.get_state()[1], torch.get_rng_state().numpy()  # noqa: NPY002
        self.states.append(np.concatenate([weights, *numbers]))
        return True

    _on_training_end = _on_step


# The environments of a training, in all kinds of wrappers.
TRAININGS = {
    "SubprocVecEnv": lambda: SubprocVecEnv(
        [lambda: Monitor(gymnasium.make(HARD))] * 2, start_method="fork"),
    "make_vec_env": lambda: make_vec_env(HARD, 2, seed=0, group=2, max_episode_steps=20),
    "VecNormalize": lambda: VecNormalize(make_vec_env(HARD, 2, max_episode_steps=20)),
    "VecFrameStack": lambda: VecFrameStack(make_vec_env(HARD, 2), 2),
    "wrapper": lambda: VecMonitor(
        DummyVecEnv([lambda: FlattenObservation(gymnasium.make(HARD))] * 2)),
}  # fmt: skip
ALGORITHMS = {
    PPO: {"n_steps": 16, "batch_size": 16, "n_epochs": 1},
    SAC: {"learning_starts": 8, "batch_size": 8, "train_freq": 8},
}


class TestScoreCallback:
    @pytest.mark.parametrize(
        ("algorithm", "kind"), [*((PPO, kind) for kind in TRAININGS), (SAC, "make_vec_env")]
    )
    def test_a_training_is_the_same_with_scores_and_without(self, algorithm, kind, tmp_path):
        trainings = []
        for scores in (True, False):
            with closing(TRAININGS[kind]()) as plants:
                settings = ALGORITHMS[algorithm]
                model = algorithm("MlpPolicy", plants, seed=0, device="cpu", **settings)
                weights = Weights()
                callback = ScoreCallback(
                    HARD, every=20, episodes=2, folder=tmp_path, verbose=0, max_episode_steps=9
                )
                model.learn(64, [callback, weights] if scores else weights)
                trainings.append(weights.states)
                assert len(callback.scores) >= 2 * scores
        np.testing.assert_array_equal(*trainings)

    def test_it_records_scores_and_keeps_the_best_policy(self, tmp_path, capsys):
        plants = VecNormalize(make_vec_env("MiddlePoint-v0", 2, seed=0, **TRAINING))
        noisy, folder = "MiddlePointNoisy-v0", tmp_path / "new" / "best"
        callback = ScoreCallback(noisy, every=128, episodes=3, folder=folder)
        model = model_of(plants, seed=2, learning_rate=0.1)  # gets worse
        model.set_logger(configure(str(tmp_path / "log"), ["csv"]))
        model.learn(192, callback=callback)
        model.logger.close()
        assert [samples for samples, _ in callback.scores] == [128, 192]
        errors = [evaluation.mean_error for _, evaluation in callback.scores]
        assert callback.best.mean_error == min(errors) < max(errors)
        env = VecNormalize.load(
            str(folder / "vecnormalize.pkl"), make_vec_env(noisy, 2, **TRAINING)
        )
        kept = PPO.load(folder / "best_model.zip", env=env, device="cpu")
        again = evaluate(kept, noisy, episodes=3, seed=VALIDATION_SEED)
        assert again.mean_error == min(errors)
        shown = capsys.readouterr().out.splitlines()
        assert shown[0].startswith(f"128 samples: {noisy}: mean error ")
        with (tmp_path / "log" / "progress.csv").open() as file:
            logged = [row["score/mean_error"] for row in csv.DictReader(file)]
        assert [float(error) for error in logged if error] == pytest.approx(errors)

    def test_the_last_policy_is_scored_and_no_policy_twice(self):
        model = model_of(make_vec_env("MiddlePointNoisy-v0", 2, max_episode_steps=5), seed=0)
        short = {"dead_zone": 0.0, "delay": 1, "max_episode_steps": 9}
        callback = ScoreCallback(every=64, episodes=2, verbose=0, **short)
        model.learn(64, callback)
        (_, untrained), (samples, trained) = callback.scores
        assert samples == 64
        expected = evaluate(model, episodes=2, seed=VALIDATION_SEED, **short).mean_error
        assert untrained.mean_error != trained.mean_error == expected
        callback.every = 1  # many scores in a rollout with the same weights are none
        model.learn(128, callback, reset_num_timesteps=False)
        assert [samples for samples, _ in callback.scores] == [64, 64, 130, 192]

    def test_an_algorithm_without_tensors_is_scored(self, monkeypatch):
        model = SAC("MlpPolicy", make_vec_env(HARD, 2), **ALGORITHMS[SAC], device="cpu")
        # As in SBX. The device is all that Stable-Baselines3 asks the parameters for.
        parameters = [SimpleNamespace(device=torch.device("cpu"))]
        monkeypatch.setattr(model.policy, "parameters", lambda: iter(parameters))
        callback = ScoreCallback(HARD, every=16, episodes=2, verbose=0, max_episode_steps=9)
        model.learn(48, callback)
        # The last update comes after the last sample.
        assert [samples for samples, _ in callback.scores] == [16, 32, 48, 48]

    def test_errors_come_before_a_training(self):
        model = model_of(make_vec_env(HARD, 2))
        with pytest.raises(Error, match="MiddlePointHard-v00"):
            model.learn(64, ScoreCallback("MiddlePointHard-v00"))
        assert model.num_timesteps == 0
