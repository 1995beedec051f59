"""Policies and environments of many forms: scored as in a plain loop, or refused by a rule."""

from contextlib import closing
from functools import partial
from itertools import repeat
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import wrappers
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv, VectorWrapper
from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
)

from agents import DirectNNController, PIController
from mptc_gym import MiddlePointEnv, MiddlePointVectorEnv, evaluate
from mptc_gym.evaluation import SEED
from mptc_gym.sb3 import GymnasiumVecEnv, like, make_vec_env
from mptc_gym.torch_env import MiddlePointTorchEnv

NOISY = "MiddlePointNoisy-v0"
LENGTH = 30  # samples of an episode
EPISODES = 3
N = 2  # plants of a vector environment, which therefore runs two rounds of episodes
# Without a dead zone, every action matters.
SHORT = {"dead_zone": 0.0, "max_episode_steps": LENGTH}
CHANGE = {"action": "change", "max_move": 0.3, "compensated_dead_zone": 4.0}


# Environments


def one(**arguments):
    return gymnasium.make(NOISY, **{**SHORT, **arguments})


def many(**arguments):
    return gymnasium.make_vec(NOISY, N, **{**SHORT, **arguments})


def dummy(make=one):
    return DummyVecEnv([make] * N)


def processes(make=one):
    return SubprocVecEnv([make] * N, start_method="fork")


def gymnasium_processes(make=one):
    return AsyncVectorEnv([make] * N, context="fork")


def batch(**arguments):
    return make_vec_env(NOISY, N, **{**SHORT, **arguments})


def trained(normaliser):
    """Return a wrapper that normalises, with statistics as if from a training."""
    statistics = normaliser.obs_rms
    statistics.mean = np.linspace(-1.0, 2.0, statistics.mean.shape[-1])
    statistics.var = statistics.mean + 2.0
    statistics.count = 1000
    return normaliser


def stacked():
    return wrappers.FlattenObservation(
        wrappers.FrameStackObservation(one(), 2, padding_type="zero")
    )


def scaled():
    return wrappers.TransformObservation(one(), lambda seen: seen * np.float32(0.1), None)


class Cheating(gymnasium.Wrapper):
    """A wrapper that changes what `reset` or `step` of its environment returns."""

    def __init__(self, seed=None, end=None, **infos):
        super().__init__(one())
        self.wanted_seed, self.wanted_infos, self.end = seed, infos, end

    def reset(self, *, seed=None, options=None):
        return self.env.reset(seed=seed if self.wanted_seed is None else self.wanted_seed)

    def step(self, action):
        *returned, _, truncated, info = self.env.step(action)
        has_ended = self.end is not None and info["error"] > self.end
        return *returned, has_ended, truncated, info | self.wanted_infos


# Policies


def law(observations):
    return np.clip(-0.3 * observations[..., 3:4], -1.0, 1.0)


class Integrator:
    """A policy that sums the errors of an episode."""

    def __init__(self):
        self.reset()

    def reset(self):
        self.sum = 0.0

    def act(self, observations):
        self.sum = self.sum + observations[..., 3:4]
        return -0.05 * observations[..., 3:4] - 0.002 * self.sum


class Predicting(Integrator):
    """A policy with `predict`, which explores unless told otherwise."""

    def predict(self, observations, deterministic=False):
        return self.act(observations) + (0.0 if deterministic else 0.5), None


def model_of(env, algorithm=PPO):
    """Return an untrained model whose actions are large and differ."""
    settings = {"n_steps": 16, "batch_size": 16, "seed": 0, "device": "cpu"}
    policy = "MlpLstmPolicy" if algorithm is RecurrentPPO else "MlpPolicy"
    model = algorithm(policy, env, **settings)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for weight in model.policy.parameters():
            weight.add_(0.05 * torch.randn(weight.shape, generator=generator))
    return model


def loaded(model, folder, **arguments):
    model.save(folder / "model.zip")
    return type(model).load(folder / "model.zip", device="cpu", **arguments)


# The plain loop


def plain_runs(new_act, make=one):
    """Return the mean error, degC, and the valve travel, t/h, of each episode, in two columns.

    `new_act()` gives the law of an episode.
    """
    results = []
    for seed in range(SEED, SEED + EPISODES):
        with closing(make()) as env:
            act = new_act()
            errors, flows = [], [0.0]
            observation, _ = env.reset(seed=seed)
            for _ in range(LENGTH):
                observation, *_, info = env.step(act(observation))
                errors.append(abs(info["error"]))
                flows.append(info["applied"])
        results.append((np.mean(errors), np.abs(np.diff(flows)).sum()))
    return np.transpose(results)


def act_of_model(model):
    """Return how a model of Stable-Baselines3 acts in one episode."""
    memory = {"state": None, "episode_start": np.ones(1)}
    normaliser = model.get_vec_normalize_env()

    def act(observation):
        if normaliser is not None:
            observation = normaliser.normalize_obs(observation)
        actions, state = model.predict(observation[None], deterministic=True, **memory)
        memory.update(state=state, episode_start=np.zeros(1))
        return actions[0]

    return act


def assert_as_in_a_plain_loop(evaluation, new_act, make=one):
    errors, travels = plain_runs(new_act, make)
    np.testing.assert_allclose(evaluation.errors, errors, rtol=0, atol=1e-6)
    np.testing.assert_allclose(evaluation.travels, travels, rtol=0, atol=1e-4)
    assert evaluation.mean_error == pytest.approx(errors.mean(), abs=1e-6)
    assert np.ptp(errors) > 1e-3
    assert travels.min() > 1.0


ENVIRONMENTS = {
    "spec": (one().spec, one),
    "spec of a batch": (many().spec, one),
    "spec with a wrapper": (scaled().spec, scaled),
    "one": (one, one),
    "one in a wrapper": (scaled, scaled),
    "one without a spec": (
        lambda: wrappers.TimeLimit(MiddlePointEnv(noise_variance=0.5, dead_zone=0.0), LENGTH),
        one,
    ),
    "changes": (make := partial(one, **CHANGE), make),
    "random plants": (make := partial(one, delay=[2, 9]), make),
    "batch": (many, one),
    "batch, SameStep": (partial(many, autoreset_mode="SameStep"), one),
    "SyncVectorEnv": (lambda: SyncVectorEnv([one, one]), one),
    "AsyncVectorEnv": (gymnasium_processes, one),
    "vector wrapper": (lambda: wrappers.vector.TransformReward(many(), abs), one),
    "make_vec_env": (batch, one),
    "DummyVecEnv": (dummy, one),
    "SubprocVecEnv": (lambda: VecMonitor(processes()), one),
    "Monitor": (lambda: dummy(lambda: Monitor(one())), one),
    "VecFrameStack": (lambda: VecFrameStack(dummy(), 2), stacked),
}


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_an_environment_gives_what_a_plain_loop_gives(name):
    env, make = ENVIRONMENTS[name]
    evaluation = evaluate(Integrator(), env, episodes=EPISODES)
    assert_as_in_a_plain_loop(evaluation, lambda: Integrator().act, make)


@pytest.mark.parametrize("make", [
    lambda: VecNormalize(batch()),
    lambda: VecNormalize(dummy()),
    lambda: wrappers.vector.NormalizeObservation(many()),
    lambda: wrappers.NormalizeObservation(one()),
])  # fmt: skip
def test_statistics_stay_as_they_were_trained(make):
    statistics = trained(make()).obs_rms

    def act(observation):
        return law((observation - statistics.mean) / np.sqrt(statistics.var + 1e-8))

    evaluation = evaluate(law, lambda: trained(make()), episodes=EPISODES)
    assert_as_in_a_plain_loop(evaluation, lambda: act)


MODULE = torch.nn.Linear(6, 1)
# A policy for `evaluate`, and how it acts in an episode of the plain loop.
POLICIES = {
    "act and reset": (Integrator(), lambda: Integrator().act),
    "predict": (Predicting(), lambda: Integrator().act),
    "predict of actions alone": (SimpleNamespace(predict=law), lambda: law),  # as d3rlpy's
    "PI controller": (PIController(), lambda: PIController().act),
    "function of a module": (
        act := lambda o: MODULE(torch.as_tensor(o)).detach().numpy(), lambda: act),
    "function of one observation": (lambda o: np.stack([law(row) for row in o]), lambda: law),
}  # fmt: skip


@pytest.mark.parametrize("name", POLICIES)
def test_a_policy_acts_as_in_a_plain_loop(name):
    policy, new_act = POLICIES[name]
    assert_as_in_a_plain_loop(evaluate(policy, NOISY, episodes=EPISODES, **SHORT), new_act)


# Environments of a training, and one environment that shows what the policy observed there.
TRAININGS = {
    "one": (one, one),
    "windows": (make := partial(one, action_window=3, error_window=0, output_window=2), make),
    "Monitor": (lambda: dummy(lambda: Monitor(one())), one),
    "pictures": (partial(one, render_mode="rgb_array_list"), one),
    "batch": (partial(batch, action_window=3), partial(one, action_window=3)),
    "changes": (partial(batch, **CHANGE), partial(one, **CHANGE)),
    "processes": (processes, one),
    "VecNormalize": (lambda: trained(VecNormalize(batch())), one),
    "VecFrameStack": (lambda: VecFrameStack(dummy(), 2), stacked),
    "a wrapper": (lambda: dummy(scaled), scaled),
    "wrappers": (stacked, stacked),
    "normalised rewards": (lambda: VecNormalize(dummy(), norm_obs=False), one),
}
MODELS = [
    *((PPO, name) for name in TRAININGS), (RecurrentPPO, "VecNormalize"),
]  # fmt: skip


@pytest.mark.parametrize(("algorithm", "name"), MODELS)
def test_a_model_finds_the_interface_of_its_training(algorithm, name):
    training, make = TRAININGS[name]
    model = model_of(training(), algorithm)
    with closing(model.get_env()):
        evaluation = evaluate(model, NOISY, episodes=EPISODES, **SHORT)
        assert_as_in_a_plain_loop(evaluation, lambda: act_of_model(model), make)


def test_frames_are_stacked_in_the_order_of_the_training():
    model = model_of(VecFrameStack(trained(VecNormalize(dummy())), 2))
    assert not like(model, NOISY, **SHORT).venv.training  # of the VecNormalize
    evaluation = evaluate(model, NOISY, episodes=EPISODES, **SHORT)
    made = evaluate(
        model, lambda: VecFrameStack(trained(VecNormalize(dummy())), 2), episodes=EPISODES
    )
    # The batches have 3 and 2 plants, for which float32 products round differently.
    largest = made.errors.max()
    np.testing.assert_allclose(evaluation.errors, made.errors, rtol=0, atol=1e-6 * largest)


def test_a_plain_model_from_a_file_needs_no_environments(tmp_path):
    model = model_of(one())
    evaluation = evaluate(loaded(model, tmp_path), NOISY, episodes=EPISODES, **SHORT)
    assert_as_in_a_plain_loop(evaluation, lambda: act_of_model(model))


def idle(observations):
    return np.zeros((len(observations), 1))


# For each reason, a policy, an environment, and the message.
REFUSED = {
    "actions of shape (n,)": lambda _: (
        lambda seen: np.zeros(len(seen)), NOISY,
        r"shape \(3, 1\), .*, shape \(3,\)"),
    "a policy of one observation": lambda _: (
        lambda seen: seen[3:4], NOISY, r"lambda o: numpy.stack\(\[policy\(row\) for row in o"),
    "actions that are not finite": lambda _: (
        lambda seen: np.full((len(seen), 1), np.nan), NOISY, "finite .*nan"),
    "a module": lambda _: (
        MODULE, NOISY, r"lambda o: module\(torch.as_tensor\(o\)\).detach\(\).numpy\(\)"),
    "controller of another actuator": lambda _: (
        PIController(u_max=6.0), NOISY, "limits of env, u_min=-10.0, u_max=10.0"),
    "an environment": lambda _: (idle, one(), "such as lambda: ..."),
    "a vector environment": lambda _: (idle, many(), "function that makes a new environment"),
    "a VecEnv": lambda _: (
        (m := model_of(dummy())), m.get_env(), "an EnvSpec such as that of an environment"),
    "a wrapper of a batch": lambda _: (
        model_of(GymnasiumVecEnv(VectorWrapper(many(autoreset_mode="SameStep")))),
        NOISY, "are in a VectorWrapper, which cannot be made again"),
    "the same environment": lambda _: (
        idle, repeat(one()).__next__, "a new environment at each call"),
    "the same inner environment": lambda _: (
        idle, partial(VecMonitor, dummy()), "a new environment at each call"),
    "environments of a training": lambda _: (
        (m := model_of(dummy())), m.get_env, "a new environment at each call"),
    "another environment": lambda _: (idle, "CartPole-v1", "must be of mptc_gym .*CartPole"),
    "another environment, made": lambda _: (
        idle, lambda: gymnasium.make("CartPole-v1"), "must be of mptc_gym and in NumPy"),
    "environment in PyTorch": lambda _: (
        idle, lambda: MiddlePointTorchEnv(N), "must be of mptc_gym and in NumPy"),
    "another seed": lambda _: (
        law, lambda: Cheating(seed=5), "of its seeds, whose noise at sample 1 is"),
    "flattering errors": lambda _: (
        law, lambda: Cheating(error=0.1), "whose error at sample 1 is"),
    "plants that share a seed": lambda _: (
        law, partial(batch, group=N), "of its seeds, whose noise at sample 1 is"),
    "early ends": lambda _: (law, lambda: Cheating(end=6.5), "end an episode early"),
    "VecNormalize without statistics": lambda _: (
        idle, lambda: VecNormalize(dummy()), r"in VecNormalize, got initial .*load\(path, env"),
    "NormalizeObservation without statistics": lambda _: (
        model_of(wrappers.NormalizeObservation(one())), NOISY, "NormalizeObservation, got ini"),
    "normaliser in a process": lambda _: (
        idle, lambda: gymnasium_processes(lambda: wrappers.NormalizeReward(one())),
        "not normalise in worker processes"),
    "normaliser in a process of a VecEnv": lambda _: (
        idle, lambda: processes(lambda: wrappers.NormalizeObservation(one())),
        "not normalise in worker processes"),
    "model of other windows": lambda _: (
        model_of(one(action_window=3)), one, "action_window=3, got action_window=0"),
    "model of windows with these bounds": lambda _: (
        model_of(one(error_window=0, output_window=3)),
        lambda: one(setpoint_window=6, error_window=0),
        "setpoint_window=3, output_window=3, got setpoint_window=6, output_window=0"),
    "VecNormalize forgotten": lambda _: (
        model_of(trained(VecNormalize(dummy()))), dummy, "normalised=True, got normalised=F"),
    "action form forgotten": lambda _: (
        model_of(batch(**CHANGE)), one, "action=change, max_move=0.3, .* got action=flow"),
    "another dead zone": lambda _: (
        model_of(batch(**CHANGE)), partial(one, **CHANGE | {"compensated_dead_zone": 0.0}),
        "compensated_dead_zone=4.0, got compensated_dead_zone=0.0"),
    "frames forgotten": lambda _: (
        model_of(VecFrameStack(dummy(), 2)), dummy, r"\(\(12,\), Box.* got \(\(6,\), Box"),
    "windows of a file": lambda folder: (
        loaded(model_of(one(action_window=3)), folder), NOISY, r"PPO.load\(path, env=...\)"),
    "a wrapper that cannot be made again": lambda _: (
        model_of(dummy(lambda: gymnasium.Wrapper(one()))), NOISY, "cannot be recreated"),
    "environments without a spec": lambda _: (
        model_of(DummyVecEnv([MiddlePointEnv])), NOISY, "must come from gymnasium.make"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_it_is_refused_by_a_rule(name, tmp_path):
    policy, env, message = REFUSED[name](tmp_path)
    arguments = SHORT if env == NOISY else {}
    with pytest.raises(ValueError, match=f"(?s){message}"):
        evaluate(policy, env, episodes=EPISODES, **arguments)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"env": one, "delay": 3}, ValueError, "delay must be given where env is made"),
        ({"delay": -1}, ValueError, "delay must be"),
        ({"seed": -1}, ValueError, "seed must be an integer from 0"),
        ({"episodes": 1}, ValueError, "episodes must be an integer from 2"),
        ({"env": "MiddlePointNosy-v0"}, gymnasium.error.NameNotFound, "MiddlePointNoisy"),
    ],
)
def test_bad_arguments_are_named(arguments, error, message):
    with pytest.raises(error, match=message):
        evaluate(law, **arguments)


@pytest.mark.parametrize("make", [one, many, dummy])
def test_what_is_made_is_closed(make):
    closed = []

    def recording():
        env = make()
        env.close = lambda *_, **__: closed.append(env)
        return env

    evaluate(law, recording, episodes=EPISODES)
    assert len({id(env) for env in closed}) == (EPISODES if make is one else 2)


@pytest.mark.parametrize(
    ("arguments", "name"),
    [({"delay": 3, "dead_zone": 1.0}, f"{NOISY} with another delay, dead_zone"),
     ({"action_window": 9, "noise_variance": 0.0}, "MiddlePoint-v0")],
)  # fmt: skip
def test_the_name_says_which_arguments_are_not_those_of_the_id(arguments, name):
    assert evaluate(law, NOISY, episodes=2, **arguments).env == name


@pytest.mark.parametrize("learns", [False, True])
def test_what_is_learnt_carries_over_to_the_next_round(learns):
    networks = DirectNNController(num_envs=N, learning=learns)
    make = partial(gymnasium.make_vec, "MiddlePoint-v0", N, max_episode_steps=LENGTH)
    errors = evaluate(networks, make, episodes=2 * N).errors
    assert np.array_equal(errors[:N], errors[N:]) is not learns


def test_an_episode_has_at_most_1200_samples():
    for limit in (None, 2000):
        plants = partial(MiddlePointVectorEnv, N, max_episode_steps=limit)
        assert evaluate(law, plants, episodes=2).score is not None
    for limit in (-1, 2000):
        assert evaluate(law, episodes=2, max_episode_steps=limit).score is not None
