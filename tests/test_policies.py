"""Policies and environments of many kinds: scored as in a plain loop, or refused by a rule."""

import copy
import gc
import random
import threading
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from functools import partial
from multiprocessing import Pipe
from types import SimpleNamespace
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import wrappers
from gymnasium.spaces import Box, Dict, Discrete
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv, VectorWrapper
from sb3_contrib import RecurrentPPO
from stable_baselines3 import DQN, PPO, SAC
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
)

from agents import DirectNNController, PIController
from mptc_gym import MiddlePointEnv, MiddlePointVectorEnv, Parameters, evaluate
from mptc_gym.environments.layers import layers
from mptc_gym.evaluation import SEED
from mptc_gym.sb3 import load, make_vec_env, save, spec_of
from mptc_gym.torch_env import MiddlePointTorchEnv
from mptc_gym.wrappers import IncrementalAction
from mptc_gym.wrappers.vector import IncrementalAction as VectorIncrementalAction

NOISY = "MiddlePointNoisy-v0"
LENGTH = 30  # samples of an episode
EPISODES = 3
N = 2  # plants of a vector environment, which therefore runs two rounds of episodes
# Without a dead zone, every action matters.
SHORT = {"dead_zone": 0.0, "max_episode_steps": LENGTH}
INCREMENTS = {"max_move": 0.3, "compensate_dead_zone": 4.0}


# Environments


def one(**arguments):
    return gymnasium.make(NOISY, **{**SHORT, **arguments})


def many(**arguments):
    return gymnasium.make_vec(NOISY, N, **{**SHORT, **arguments})


def dummy(make=one, n=N):
    return DummyVecEnv([make] * n)


def processes(make=one, n=N):
    return SubprocVecEnv([make] * n, start_method="fork")


def gymnasium_processes(*makers):
    return AsyncVectorEnv(makers or [one] * N, context="fork")


def incremental():
    return IncrementalAction(one(), **INCREMENTS)


def trained(normaliser):
    """Return a wrapper that normalises, with statistics as if from a training."""
    statistics = normaliser.obs_rms
    statistics.mean = np.linspace(-1.0, 2.0, statistics.mean.shape[-1])
    statistics.var = statistics.mean + 2.0
    statistics.count = 1000
    return normaliser


def discrete(n=5):
    """Return an environment whose action chooses one of n flows."""

    def action_of(choice):
        return np.array([2.0 * choice / (n - 1) - 1.0], np.float32)

    return wrappers.TransformAction(one(), action_of, Discrete(n))


def named():
    """Return an environment whose observation is a dict of set points and errors."""
    space = Dict({"setpoints": Box(-200, 200, (3,)), "errors": Box(-200, 200, (3,))})

    def in_dict(observation):
        return {"setpoints": observation[:3], "errors": observation[3:]}

    return wrappers.TransformObservation(one(), in_dict, space)


def stacked(**padding):
    return wrappers.FrameStackObservation(one(), 2, **padding)


def scaled():
    return wrappers.TransformObservation(
        one(), lambda observation: observation * np.float32(0.1), None
    )


def overriding(**methods):
    """Return an environment in a wrapper with these methods, which get the environment."""
    env = gymnasium.Wrapper(one())
    for name, method in methods.items():
        setattr(env, name, partial(method, env.env))
    return env


def with_infos(change):
    """Return an environment in a wrapper that changes the infos of `step`."""

    def step(env, action):
        *returned, info = env.step(action)
        return *returned, change(info)

    return overriding(step=step)


def without_errors(info):
    return {name: value for name, value in info.items() if name != "error"}


def with_early_ends():
    """Return an environment that ends an episode at a large error."""

    def step(env, action):
        observation, reward, _, truncated, info = env.step(action)
        return observation, reward, info["error"] > 6.5, truncated, info

    return overriding(step=step)


class NoResetInfos(DummyVecEnv):
    """A vector environment from before `reset_infos`."""

    def reset(self):
        observations = super().reset()
        self.reset_infos = [{} for _ in self.envs]
        return observations


def in_mid_episode(env):
    env.reset(seed=1)
    for _ in range(7):
        env.step(env.action_space.sample())
    return env


def closed(env):
    env.close()
    return env


def maker_of(env):
    return lambda: env


def differing(first, second):
    return SyncVectorEnv([lambda: one(**first), lambda: one(**second)])


# Policies


def law(observations):
    return np.clip(-0.3 * observations[..., 3:4], -1.0, 1.0)


class Integrator:
    """A policy that sums the errors of an episode."""

    def __init__(self):
        self.reset()

    def reset(self):
        self.sum = 0.0

    def __call__(self, observations):
        self.sum = self.sum + observations[..., 3:4]
        return -0.05 * observations[..., 3:4] - 0.002 * self.sum

    act = __call__


class Exploring:
    def act(self, observations, deterministic=False):
        return law(observations) + (0.0 if deterministic else 0.5)


class Network(torch.nn.Module):
    def __init__(self, dtype=torch.float32):
        super().__init__()
        torch.manual_seed(0)
        layers = torch.nn.Linear(6, 9), torch.nn.Dropout(), torch.nn.Linear(9, 1)
        self.layers = torch.nn.Sequential(*layers).to(dtype)

    def forward(self, observations, scale=1.0):
        return torch.tanh(scale * self.layers(observations))


def network_with_partial_forward():
    network = Network()
    network.forward = partial(network.forward, scale=0.5)
    return network


class DictNetwork(torch.nn.Module):
    def forward(self, observations):
        return -0.3 * observations["errors"][..., :1]


class ActingNetwork(Network):
    def act(self, observations):
        assert isinstance(observations, np.ndarray)
        return self(torch.as_tensor(observations))


class ExploringNetwork(Network):
    """A module whose noise depends on its mode, by a `train` of its own."""

    noisy = True

    def train(self, mode=True):
        self.noisy = mode
        return super().train(mode)

    def forward(self, observations):
        return super().forward(observations) + 0.5 * self.noisy


class Trainer(torch.nn.Module):
    """A module that acts by a method of another name, and trains by the method `train`."""

    def __init__(self):
        super().__init__()
        self.network = Network()

    def train(self, data):
        raise AssertionError("a training that nobody asked for")

    def reset(self):
        raise AssertionError("a reset that nobody asked for")

    def get_action(self, observations):
        assert observations.dtype == torch.float32
        assert not torch.is_grad_enabled()
        return self.network(observations)


def model_of(algorithm, env):
    """Return an untrained model whose actions are large and differ."""
    policy = "MultiInputPolicy" if isinstance(env.observation_space, Dict) else "MlpPolicy"
    settings = {"learning_starts": 8, "buffer_size": 200, "batch_size": 8, "train_freq": 16}
    if algorithm in (PPO, RecurrentPPO):
        settings = {"n_steps": 16, "batch_size": 16, "n_epochs": 1}
    if algorithm is RecurrentPPO:
        policy = "MlpLstmPolicy"
        settings["policy_kwargs"] = {"lstm_hidden_size": 8}
    model = algorithm(policy, env, seed=0, device="cpu", **settings)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for weight in model.policy.parameters():
            weight.add_(0.05 * torch.randn(weight.shape, generator=generator))
    return model


def normalised_model():
    return model_of(PPO, trained(VecNormalize(dummy())))


def incremental_model():
    return model_of(PPO, make_vec_env(NOISY, N, wrapper=INCREMENTS))


# The plain loop


def plain_errors(new_act, make=one):
    """Return the mean error of each episode, degC; `new_act()` gives the law of an episode."""
    mean_errors = []
    for seed in range(SEED, SEED + EPISODES):
        with closing(make()) as env:
            act = new_act()
            errors = []
            observation, _ = env.reset(seed=seed)
            for _ in range(LENGTH):
                observation, *_, info = env.step(act(observation))
                errors.append(abs(info["error"]))
        mean_errors.append(np.mean(errors))
    return mean_errors


def act_of_network(network):
    evaluating = copy.deepcopy(network).eval().requires_grad_(False)
    dtype = next(network.parameters()).dtype
    return lambda observation: evaluating(torch.tensor(observation, dtype=dtype)).numpy()


def act_of_model(model):
    """Return how a model of Stable-Baselines3 acts in one episode."""
    memory = {"state": None, "episode_start": np.ones(1)}

    def act(observation):
        if isinstance(observation, dict):
            batch = {name: part[None] for name, part in observation.items()}
        else:
            batch = np.asarray(observation)[None]
        actions, state = model.predict(batch, deterministic=True, **memory)
        memory.update(state=state, episode_start=np.zeros(1))
        return actions[0]

    return act


class Case(NamedTuple):
    """A policy and an environment for `evaluate`, and what acts where in the plain loop."""

    policy: Any
    env: Any
    new_act: Callable  # returns how the policy acts in one episode of one plant
    make: Callable = one  # makes the environment of one plant


def of_function(function, env=NOISY, make=one):
    return Case(function, env, lambda: function, make)


def of_integrator(env, make=one):
    return Case(Integrator(), env, Integrator, make)


def of_network(policy, network=None):
    return Case(policy, NOISY, lambda: act_of_network(network or policy))


def of_model(model, env, make=one):
    return Case(model, env, lambda: act_of_model(model), make)


def of_model_at_home(algorithm, env, make=one):
    model = model_of(algorithm, env)
    return of_model(model, model.get_env(), make)


def of_statistics(normaliser):
    statistics = copy.deepcopy(trained(normaliser).obs_rms)

    def act(observation):
        return law((observation - statistics.mean) / np.sqrt(statistics.var + 1e-8))

    return Case(law, normaliser, lambda: act)


def of_loaded_statistics(folder):
    path = str(folder / "vec_normalize.pkl")
    trained(VecNormalize(dummy())).save(path)
    return of_statistics(VecNormalize.load(path, dummy()))


def of_bare_zip(folder):
    model_of(PPO, one()).save(folder / "bare.zip")
    return of_model(PPO.load(folder / "bare.zip"), NOISY)


def of_saved(folder, make, plants):
    """Return a model from the zip of `save`, on the spec of its environments."""
    save(model_of(PPO, plants), folder / "model.zip")
    model = load(folder / "model.zip", device="cpu")
    return of_model(model, spec_of(model, NOISY, **SHORT), make)


def of_frozen_script():
    with warnings.catch_warnings(action="ignore", category=DeprecationWarning):
        script = torch.jit.freeze(torch.jit.script(Network().layers.eval()))

    def act(observation):
        return script(torch.as_tensor(observation)[None]).numpy()[0]

    return Case(script, NOISY, lambda: act)


def of_predict():
    integrator = Integrator()
    policy = SimpleNamespace(reset=integrator.reset, predict=lambda seen: integrator(seen))
    return Case(policy, many(), Integrator)


def of_keywords():
    def predict(observations, **keywords):
        return Exploring().act(observations, keywords["deterministic"])

    return Case(SimpleNamespace(predict=predict), NOISY, lambda: law)


def of_controller_batch():
    """Return a batch of networks, each of which acts in an episode of its own."""
    seeds = iter(range(EPISODES))
    return Case(
        DirectNNController(num_envs=EPISODES, learning=False),
        NOISY,
        lambda: DirectNNController(seed=next(seeds), learning=False).act,
    )


CASES = {
    "function": lambda _: of_function(law),
    "object with act and reset": lambda _: of_integrator(NOISY),
    "bound act": lambda _: Case(Integrator().act, NOISY, Integrator),
    "predict of a user": lambda _: of_predict(),
    "predict with **keywords": lambda _: of_keywords(),
    "act with an option": lambda _: Case(Exploring(), NOISY, lambda: Exploring().act),
    "partial that explores": lambda _: Case(
        partial(Exploring().act, deterministic=False), NOISY, lambda: Exploring().act),
    "PI controller": lambda _: Case(PIController(), NOISY, lambda: PIController().act),
    "controller of many loops": lambda _: of_controller_batch(),
    "module": lambda _: of_network(Network()),
    "module in float64": lambda _: of_network(Network(torch.float64)),
    "module whose forward is a partial": lambda _: of_network(network_with_partial_forward()),
    "module with act": lambda _: of_network(ActingNetwork()),
    "module with a train of its own": lambda _: of_network(ExploringNetwork()),
    "module of dicts": lambda _: Case(
        DictNetwork(), dummy(named),
        lambda: lambda observation: -0.3 * observation["errors"][:1], named),
    "bound forward": lambda _: of_network((n := Network()).forward, n),
    "other method of a module": lambda _: of_network((t := Trainer()).get_action, t.network),
    "partial of a module": lambda _: of_network(partial(n := Network(), scale=1.0), n),
    "frozen script": lambda _: of_frozen_script(),
    "spec with wrappers": lambda _: of_function(law, incremental().spec, incremental),
    "function that makes one": lambda _: of_integrator(one),
    "function that makes a wrapper": lambda _: of_integrator(scaled, scaled),
    "function that makes one without a spec": lambda _: of_integrator(
        lambda: wrappers.TimeLimit(MiddlePointEnv(noise_variance=0.5, dead_zone=0.0), LENGTH)),
    "one environment": lambda _: of_integrator(one()),
    "one environment in mid-episode": lambda _: of_integrator(in_mid_episode(one())),
    "wrapper that returns tensors": lambda _: of_function(
        law, wrappers.TransformObservation(one(), torch.as_tensor, None)),
    "batch": lambda _: of_integrator(many()),
    "batch, SameStep": lambda _: of_integrator(many(autoreset_mode="SameStep")),
    "batch with infos by plant": lambda _: of_integrator(
        wrappers.vector.DictInfoToList(many())),
    "batch in IncrementalAction": lambda _: of_integrator(
        VectorIncrementalAction(many(), **INCREMENTS), incremental),
    "AsyncVectorEnv": lambda _: of_integrator(gymnasium_processes()),
    "DummyVecEnv": lambda _: of_integrator(dummy()),
    "DummyVecEnv in mid-episode": lambda _: of_integrator(
        dummy(lambda: in_mid_episode(one()))),
    "SubprocVecEnv": lambda _: of_integrator(processes()),
    "plants in groups": lambda _: of_integrator(make_vec_env(NOISY, N, group=N, **SHORT)),
    "VecEnv without reset_infos": lambda _: of_integrator(NoResetInfos([one] * N)),
    "plants that differ in rewards": lambda _: of_integrator(
        DummyVecEnv([one, partial(one, reward="absolute")])),
    "VecNormalize": lambda _: of_statistics(VecNormalize(dummy())),
    "VecNormalize of a file": of_loaded_statistics,
    "VecNormalize of a batch": lambda _: of_statistics(
        VecNormalize(make_vec_env(NOISY, N, **SHORT))),
    "NormalizeObservation": lambda _: of_statistics(wrappers.NormalizeObservation(one())),
    "vector NormalizeObservation": lambda _: of_statistics(
        wrappers.vector.NormalizeObservation(many())),
    "PPO in VecFrameStack": lambda _: of_model_at_home(
        PPO, VecFrameStack(dummy(), 2),
        lambda: wrappers.FlattenObservation(stacked(padding_type="zero"))),
    "PPO in FrameStackObservation": lambda _: of_model_at_home(PPO, stacked(), stacked),
    "PPO of dicts": lambda _: of_model_at_home(PPO, dummy(named), named),
    "PPO in IncrementalAction": lambda _: of_model_at_home(
        PPO, make_vec_env(NOISY, N, wrapper=INCREMENTS, **SHORT), incremental),
    "PPO with normalised rewards": lambda _: of_model(
        model_of(PPO, VecNormalize(dummy(), norm_obs=False)), NOISY),
    "DQN": lambda _: of_model_at_home(DQN, discrete(), discrete),
    "RecurrentPPO": lambda _: of_model_at_home(RecurrentPPO, dummy()),
    "bound predict of a model": lambda _: Case(
        (m := model_of(PPO, one())).predict, NOISY, lambda: act_of_model(m)),
    "policy of a model": lambda _: of_model(model_of(PPO, one()).policy, NOISY),
    "model without environments": of_bare_zip,
    "model of closed processes": lambda _: of_model(
        model_of(PPO, closed(processes(incremental))), incremental, incremental),
    "zip of save": lambda folder: of_saved(
        folder, lambda: IncrementalAction(one(action_window=3), **INCREMENTS),
        make_vec_env(NOISY, N, wrapper=INCREMENTS, action_window=3, **SHORT)),
    "zip of save with another wrapper": lambda folder: of_saved(folder, stacked, stacked()),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_a_policy_acts_as_in_a_plain_loop(name, tmp_path):
    policy, env, new_act, make = CASES[name](tmp_path)
    arguments = SHORT if env == NOISY else {}
    evaluation = evaluate(policy, env, episodes=EPISODES, **arguments)
    expected = plain_errors(new_act, make)
    np.testing.assert_allclose(evaluation.errors, expected, rtol=0, atol=1e-6)
    assert np.ptp(evaluation.errors) > 1e-3
    assert evaluation.travels.min() > 1.0
    if hasattr(env, "close"):
        env.close()


# For each reason, a policy, an environment, and the message.
REFUSED = {
    "actions of another shape": lambda: (
        lambda seen: np.zeros(len(seen)), NOISY, r"shape \(3, 1\), .*\(3,\)"),
    "actions that are not finite": lambda: (
        lambda seen: np.full((len(seen), 1), np.nan), NOISY, "(?s)finite .*nan"),
    "actions that are masked": lambda: (
        lambda seen: np.ma.masked_less(law(seen), 0.0), NOISY,
        r"finite actions, shape \(3, 1\), got masked_array"),
    "actions that are text": lambda: (
        lambda seen: [["open"]] * len(seen), NOISY, "finite.*open"),
    "actions with gradients": lambda: (
        lambda seen: torch.zeros(len(seen), 1, requires_grad=True), NOISY,
        r"tensor\.detach\("),
    "actions and more in a tuple": lambda: (
        lambda seen: (law(seen), None), NOISY,
        r"returns actions alone, such as lambda o: agent\.get_action\(o\)\[0\]"),
    "no policy": lambda: (3, NOISY, "must be a function, .*, or an obj"),
    "a class": lambda: (PIController, NOISY, "predict or act, not a class"),
    "swapped arguments": lambda: (
        one(), law, r"which comes first: evaluate\(policy, env\)"),
    "controller of another actuator": lambda: (
        PIController(u_max=6.0), NOISY, "limits of env, u_min=-10.0, u_max=10.0"),
    "controller in a wrapper": lambda: (
        PIController(), incremental(), "not be wrapped.*Increm"),
    "controller in frames": lambda: (
        PIController(), VecFrameStack(VecNormalize(dummy(), norm_obs=False), 2),
        "not be wrapped.*VecFrameStack"),
    "controller of too few loops": lambda: (
        DirectNNController(num_envs=2), NOISY, "num_envs=3"),
    "unknown id": lambda: (
        law, "MiddlePointNosy-v0", r"id of an env.*Did you mean: .MiddlePointNoisy"),
    "another environment": lambda: (law, "CartPole-v1", "of MiddlePointEnv .*CartPole-v1"),
    "environment in PyTorch": lambda: (
        law, MiddlePointTorchEnv(N), "of MiddlePointEnv in NumPy, and open, such as"),
    "no environment": lambda: (law, 7, "env must be an id, an EnvSpec, environments, or a f"),
    "function that makes a batch": lambda: (law, many, "where it makes many, call it"),
    "function that makes the same": lambda: (
        law, maker_of(one()), "run the episodes of its seeds"),
    "closed processes": lambda: (law, closed(processes()), "in NumPy, and open"),
    "Monitor in mid-episode": lambda: (
        law, in_mid_episode(Monitor(one(), allow_early_resets=False)), "allow_early_resets=T"),
    "another seed": lambda: (
        law, overriding(reset=lambda env, seed, options: env.reset(seed=5)),
        "of its seeds, whose noise at sample"),
    "flattering errors": lambda: (
        law, with_infos(lambda info: info | {"error": 0.1}), "whose error at sample 1 is"),
    "no errors": lambda: (
        law, with_infos(without_errors), "whose error at sample 1 is.* got None"),
    "plants that differ": lambda: (
        law, differing({}, {"delay": 3}), "must have the same plants"),
    "episodes that differ in length": lambda: (
        law, differing({}, {"max_episode_steps": 9}), "all episodes at once, .* 9 s"),
    "rounds that differ in length": lambda: (law, with_early_ends(), "all episodes at once"),
    "VecNormalize without statistics": lambda: (
        law, VecNormalize(dummy()), "in VecNormalize, got initial"),
    "NormalizeObservation without statistics": lambda: (
        law, wrappers.NormalizeObservation(one()), "in NormalizeObservation, got initial"),
    "normaliser in one of the processes": lambda: (
        law, gymnasium_processes(one, lambda: wrappers.NormalizeReward(one())),
        "not normalise in other processes"),
    "model of other windows": lambda: (
        model_of(PPO, one(action_window=3)), NOISY,
        r"windows .* \(3, 3, 0, 3\), got \(3, 3, 0, 0\): .*model\.get_env\(\)\), or spec_of"),
    "policy of other windows": lambda: (
        model_of(PPO, one(action_window=3)).policy, NOISY,
        r"observation space of policy's training, shape \(9,\) within .* got shape \(6,\)"),
    "model of windows with these bounds": lambda: (
        model_of(PPO, one(error_window=0, output_window=3)),
        one(setpoint_window=6, error_window=0), "windows .* of policy's training"),
    "IncrementalAction forgotten": lambda: (
        incremental_model(), NOISY, "wrappers of policy's training, Increment.*, got none"),
    "IncrementalAction forgotten in a VecEnv": lambda: (
        incremental_model(), dummy(), "wrappers of policy's training, Increment.*, got none"),
    "IncrementalAction in processes forgotten": lambda: (
        model_of(PPO, processes(incremental)), NOISY,
        "wrappers of policy's training, Increment.*, got none"),
    "other increments": lambda: (
        incremental_model(), lambda: IncrementalAction(one()),
        r"IncrementalAction\(0\.3, 4\.0\), got IncrementalAction\(0\.4, False\)"),
    "VecNormalize forgotten": lambda: (
        normalised_model(), NOISY,
        "wrappers of policy's training, VecNormalize.clip_obs=10., got none"),
    "VecNormalize forgotten in a batch": lambda: (
        normalised_model(), make_vec_env(NOISY, N),
        "wrappers of policy's training, VecNormalize.clip_obs=10., got none"),
    "environments within a VecNormalize": lambda: (
        (m := normalised_model()), m.get_env().unwrapped,
        "wrappers of policy's training, VecNormalize.clip_obs=10., got none"),
    "one environment within a VecNormalize": lambda: (
        (m := normalised_model()), m.get_env().envs[0],
        "wrappers of policy's training, VecNormalize.clip_obs=10., got none"),
    "VecNormalize with another limit": lambda: (
        normalised_model(), trained(VecNormalize(dummy(), clip_obs=0.1)),
        r"VecNormalize.clip_obs=10., got VecNormalize.clip_obs=0.1."),
    "TransformObservation forgotten": lambda: (
        model_of(PPO, dummy(scaled)), make_vec_env(NOISY, N, **SHORT),
        "wrappers of policy's training, TransformObservation, got none"),
    "model in processes of its training": lambda: (
        (m := model_of(PPO, processes())), m.get_env(),
        r"as these cannot be copied \(SubprocVecEnv runs in .*spec_of\(model, id"),
    "policy in processes of its training": lambda: (
        (m := model_of(PPO, processes())).policy, m.get_env(),
        r"as these cannot be copied \(SubprocVecEnv runs in .*pass the model itself"),
    "model in a window of its training": lambda: (
        (m := model_of(PPO, one(render_mode="human"))), m.get_env(),
        r"as these cannot be copied \(MiddlePointEnv shows a window"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_it_is_refused_by_a_rule(name):
    policy, env, message = REFUSED[name]()
    with pytest.raises(ValueError, match=message):
        evaluate(policy, env, episodes=EPISODES, **(SHORT if env == NOISY else {}))


def tampered():
    """Return plants without delay that say that they are those of the paper."""
    plants = MiddlePointVectorEnv(EPISODES, delay=0)
    plants.parameters = Parameters()
    return plants


class Flattering(VectorWrapper):
    """Give infos whose errors are small for those who look them up by name."""

    class Infos(dict):
        """Infos with smaller errors."""

        def __getitem__(self, name):
            return super().__getitem__(name) * (0.1 if name == "error" else 1.0)

    def step(self, actions):
        *results, infos = self.env.step(actions)
        return *results, self.Infos(infos)


@pytest.mark.parametrize("make", [tampered, lambda: Flattering(MiddlePointVectorEnv(EPISODES))])
def test_plants_that_lie_about_themselves_are_refused(make):
    with pytest.raises(ValueError, match="env must run the episodes of its seeds"):
        evaluate(law, make(), episodes=EPISODES)


def test_infos_in_arrays_that_are_used_again_give_the_same_valve_travel():
    class Reusing(VectorWrapper):
        def step(self, actions):
            *results, infos = self.env.step(actions)
            if not hasattr(self, "infos"):
                self.infos = {name: np.array(value) for name, value in infos.items()}
            for name, value in infos.items():
                self.infos[name][:] = value
            return *results, self.infos

    plants = MiddlePointVectorEnv(EPISODES, max_episode_steps=100)
    travels = [
        evaluate(law, env, episodes=EPISODES).travels.tolist()
        for env in (plants, Reusing(plants))
    ]
    assert travels[0] == travels[1]
    assert max(travels[0]) > 0.0


def test_an_environment_that_copies_as_itself_is_reset_afterwards():
    class Single(MiddlePointEnv):
        def __deepcopy__(self, memo):
            return self

    env = in_mid_episode(Single())
    evaluate(law, env, episodes=2)
    with pytest.raises(ValueError, match=r"cannot be copied .*returns the original"):
        evaluate(model_of(PPO, DummyVecEnv([lambda: env])), env, episodes=2)


def test_a_module_gets_observations_in_the_type_of_its_weights():
    class Counting(Network):
        def __init__(self):
            super().__init__()
            self.steps = torch.nn.Parameter(torch.tensor(3), requires_grad=False)
            # The first of the parameters.
            self._parameters = {"steps": self.steps, **self._parameters}

    networks = Network(), Counting()
    errors = [evaluate(network, NOISY, episodes=2).errors.tolist() for network in networks]
    assert errors[0] == errors[1]


@pytest.mark.parametrize(
    ("arguments", "name"),
    [({"delay": 3, "dead_zone": 1.0}, f"{NOISY} with another delay, dead_zone"),
     ({"action_window": 9, "noise_variance": 0.5}, NOISY)],
)  # fmt: skip
def test_the_name_says_which_arguments_are_not_those_of_the_id(arguments, name):
    assert evaluate(law, NOISY, episodes=2, **arguments).env == name


BAD_IDS = "", " ", "a\0b", "MiddlePoint-v0\n", "no_such_module:Plant-v0"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"env": one, "delay": 3}, "delay must be given where env is made"),
        ({"delay": -1}, "delay must be"),
        *(({"env": env}, "env must be the id of an environment .") for env in BAD_IDS),
        ({"env": "hard"}, "write MiddlePointHard-v0 for the preset hard"),
        ({"seed": -1}, "seed must be an integer from 0"),
        *(({"episodes": n}, "episodes must be an integer from 2") for n in (1, 2.5, "many")),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        evaluate(law, **arguments)


# The environments of a training, made in a folder for their files.
TRAININGS = {
    "DummyVecEnv": lambda _: dummy(),
    "make_vec_env": lambda _: make_vec_env(NOISY, N, seed=0, **SHORT),
    "groups": lambda _: make_vec_env(NOISY, N, seed=0, group=N, wrapper=INCREMENTS, **SHORT),
    "VecNormalize": lambda _: VecNormalize(dummy()),
    "VecFrameStack": lambda _: VecFrameStack(make_vec_env(NOISY, N, **SHORT), 2),
    "VecMonitor": lambda folder: VecMonitor(dummy(), str(folder / "all")),
    "Monitor": lambda _: dummy(lambda: Monitor(one())),
    "Monitor with a file": lambda folder: dummy(
        lambda: Monitor(one(), str(folder / "one")), n=1),
    "NormalizeObservation": lambda _: dummy(lambda: wrappers.NormalizeObservation(one())),
}  # fmt: skip


# Those of one environment after another, each of which can act alone.
OF_ENVIRONMENTS = "DummyVecEnv", "Monitor", "Monitor with a file", "NormalizeObservation"


def state_of(model):
    """Return all that a training may leave in a model and around it, in arrays by name."""
    buffer = getattr(model, "rollout_buffer", None) or model.replay_buffer
    state = {
        "episodes": np.array([[e["r"], e["l"]] for e in model.ep_info_buffer]),
        "observations": model._last_obs,
        "numpy": np.random.get_state()[1],  # noqa: NPY002
        "torch": torch.get_rng_state().numpy(),
        "python": np.array(random.getstate()[1]),
    }
    for name, value in vars(buffer).items():
        if isinstance(value, np.ndarray):
            state[f"buffer {name}"] = value
    for name, weight in model.policy.state_dict().items():
        state[f"weights {name}"] = weight.numpy()
    for layer in layers(model.get_env()):
        for kind in ("obs_rms", "ret_rms"):
            if statistics := getattr(layer, kind, None):
                state |= {f"{kind} {n}": np.array(v) for n, v in vars(statistics).items()}
    return state


def train(algorithm, env, *, scores, part):
    """Return what a training leaves, and the evaluations in the course of it."""
    random.seed(0)
    model = model_of(algorithm, env)
    # The wrappers of all environments around one of them would not fit.
    scored = model.get_env().envs[0] if part else model.get_env()
    evaluations = []

    def score(*_):
        if scores and model.num_timesteps in (20, 40):
            evaluations.append(evaluate(model, scored, episodes=2, seed=model.num_timesteps))
        return True

    model.learn(48, callback=score)
    state = state_of(model)
    model.get_env().close()
    return state, evaluations


def shape_of_files(folder):
    """Return the number of commas in each line of each file, as times and paths differ."""
    texts = sorted(file.read_text() for file in folder.iterdir())
    return [[line.count(",") for line in text.splitlines()] for text in texts]


class TestNothingThatIsPassedChanges:
    @pytest.mark.parametrize("algorithm", [PPO, SAC, RecurrentPPO])
    @pytest.mark.parametrize(
        ("kind", "part"),
        [
            *((kind, False) for kind in TRAININGS),
            *((kind, True) for kind in OF_ENVIRONMENTS),
        ],
    )
    def test_a_training_is_the_same_with_scores_and_without(
        self, kind, part, algorithm, tmp_path
    ):
        states = []
        for scores in (True, False):
            folder = tmp_path / f"scores {scores}"
            folder.mkdir()
            env = TRAININGS[kind](folder)
            state, evaluations = train(algorithm, env, scores=scores, part=part)
            states.append(state)
            if scores:
                assert len(evaluations) == 2
                assert evaluations[0].mean_error != evaluations[1].mean_error
        scored, plain = states
        assert scored.keys() == plain.keys()
        for name, value in scored.items():
            np.testing.assert_array_equal(value, plain[name], err_msg=name)
        shapes = [shape_of_files(folder) for folder in tmp_path.iterdir()]
        assert shapes[0] == shapes[1]

    def test_nothing_changes_if_an_evaluation_fails(self):
        envs = trained(VecNormalize(dummy(lambda: wrappers.NormalizeReward(one()))))
        inner = envs.venv.envs[0]
        statistics = copy.deepcopy([vars(envs.obs_rms), vars(inner.return_rms)])
        network = ExploringNetwork()
        network.layers[0].eval()

        def fail(observations):
            assert not any((network.training, network.noisy, network.layers[1].training))
            return np.full((N, 1), np.nan)

        network.forward = fail
        with pytest.raises(ValueError, match="finite"):
            evaluate(network, envs, episodes=EPISODES)
        assert all((envs.training, inner.update_running_mean, network.training, network.noisy))
        assert [part.training for part in network.layers] == [False, True, True]
        np.testing.assert_equal([vars(envs.obs_rms), vars(inner.return_rms)], statistics)

    @pytest.mark.parametrize(
        "make",
        [one, many, dummy, lambda: make_vec_env(NOISY, **SHORT), lambda: differing({}, {})],
    )
    def test_environments_are_not_closed_and_may_be_scored_again(self, make):
        env = make()
        for layer in layers(env):
            layer.close = lambda: pytest.fail("closed")
        first, second = (evaluate(Integrator(), env, episodes=EPISODES) for _ in range(2))
        np.testing.assert_array_equal(first.errors, second.errors)
        for layer in layers(env):
            del layer.close

    def test_a_recorder_records_nothing(self):
        class Recorder(wrappers.RecordVideo):
            def __init__(self, env):
                gymnasium.Wrapper.__init__(self, env)

            def step(self, action):
                pytest.fail("recorded")

        env = wrappers.TransformReward(Recorder(one()), abs)
        assert evaluate(law, env, episodes=2).travel > 1.0

    def test_a_module_may_be_scored_in_several_threads(self):
        network = Network()
        score = partial(evaluate, network, NOISY, episodes=2, **SHORT)
        expected = score().errors
        with ThreadPoolExecutor(4) as pool:
            evaluations = [*pool.map(lambda _: score(), range(12))]
        assert all(np.array_equal(each.errors, expected) for each in evaluations)
        assert network.training
        assert network.layers[1].training


class Locked(gymnasium.Wrapper):
    """A wrapper that cannot be copied."""

    def __init__(self, env):
        super().__init__(env)
        self.lock = threading.Lock()


class Piped(gymnasium.Wrapper):
    """A wrapper with a pipe, which a copy would close."""

    def __init__(self, env):
        super().__init__(env)
        self.line = SimpleNamespace(ends=[*Pipe()])


class TestWhatCannotBeCopied:
    @pytest.mark.parametrize(
        "make",
        [
            processes,
            gymnasium_processes,
            lambda: VecMonitor(processes()),
            lambda: Locked(one()),
            lambda: dummy(lambda: wrappers.TransformReward(Locked(one()), abs)),
            lambda: one(render_mode="human"),
        ],
    )
    def test_it_acts_itself_and_begins_a_new_episode(self, make):
        with closing(make()) as env:
            for _ in range(2):
                assert np.ptp(evaluate(law, env, episodes=EPISODES).errors) > 1e-3
            if hasattr(env, "get_attr"):
                seeds = env.get_attr("np_random_seed")
                env.step(np.zeros((N, 1), np.float32))
            else:
                seeds = [env.unwrapped.np_random_seed]
                env.step(np.zeros(1, np.float32))
            assert not {*seeds} & {*range(SEED, SEED + 9)}

    def test_a_pipe_stays_open(self):
        env = Piped(one())
        evaluate(law, env, episodes=EPISODES)
        gc.collect()
        first, second = env.line.ends
        first.send(1)
        assert second.recv() == 1

    def test_a_model_of_other_processes_may_act_in_this_one(self):
        with closing(processes(incremental)) as training:
            model = model_of(PPO, training)
            evaluation = evaluate(model, incremental, episodes=EPISODES)
        expected = plain_errors(lambda: act_of_model(model), incremental)
        np.testing.assert_allclose(evaluation.errors, expected, rtol=0, atol=1e-6)

    def test_it_is_refused_without_harm_if_a_model_trains_in_it(self):
        model = model_of(PPO, VecNormalize(processes()))
        with closing(model.get_env()):
            for policy in (model, model.predict):
                with pytest.raises(ValueError, match="others like them"):
                    evaluate(policy, model.get_env(), episodes=2)
            assert model.get_env().training
            model.learn(64)


@pytest.mark.parametrize("learns", [False, True])
def test_what_is_learnt_carries_over_to_the_next_round(learns):
    network = DirectNNController(num_envs=N, learning=learns)
    plants = gymnasium.make_vec("MiddlePoint-v0", N, max_episode_steps=LENGTH)
    errors = evaluate(network, plants, episodes=2 * N).errors
    assert np.array_equal(errors[:N], errors[N:]) is not learns


def test_an_episode_has_at_most_1200_samples():
    for limit in (None, 2000):
        plants = MiddlePointVectorEnv(N, max_episode_steps=limit)
        assert evaluate(law, plants, episodes=2).score is not None
    for limit in (-1, 2000):
        assert evaluate(law, episodes=2, max_episode_steps=limit).score is not None
    short = gymnasium.make_vec("MiddlePoint-v0", N, max_episode_steps=50)  # its spec says 1200
    assert evaluate(law, short, episodes=2).score is None
