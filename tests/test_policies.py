"""Policies and environments of many kinds: scored as in a plain loop, or refused by a rule."""

import copy
import gc
import random
import threading
import warnings
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from functools import partial
from multiprocessing import Pipe
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import wrappers
from gymnasium.spaces import Box, Dict, Discrete
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from sb3_contrib import RecurrentPPO
from stable_baselines3 import DQN, PPO, SAC
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecMonitor,
    VecNormalize,
)
from stable_baselines3.common.vec_env import VecFrameStack as Stack

from agents import DirectNNController, PIController
from mptc_gym import MiddlePointEnv, MiddlePointVectorEnv, evaluate
from mptc_gym.environments.layers import layers
from mptc_gym.evaluation import SEED
from mptc_gym.sb3 import load, make_vec_env, save, spec_of
from mptc_gym.torch_env import MiddlePointTorchEnv
from mptc_gym.wrappers import IncrementalAction
from mptc_gym.wrappers.vector import IncrementalAction as IncrementalBatch

NOISY = "MiddlePointNoisy-v0"
LENGTH, EPISODES, N = 30, 3, 2  # so that N environments run two rounds
# Without a dead zone, every action matters.
PLANT = {"dead_zone": 0.0}
SHORT = {**PLANT, "max_episode_steps": LENGTH}
VELOCITY = {"max_move": 0.3, "compensate_dead_zone": 4.0}
BARE = {"noise_variance": 0.5, **PLANT}


def made(**arguments):
    return gymnasium.make(NOISY, **{**SHORT, **arguments})


def many(**arguments):
    return gymnasium.make_vec(NOISY, N, **{**SHORT, **arguments})


def moved(env):
    return IncrementalAction(env, **VELOCITY)


def normal(wrapper):
    """Return environments that normalise, with statistics as if of a training."""
    size = wrapper.obs_rms.mean.shape[-1]
    wrapper.obs_rms.mean = np.linspace(-1.0, 2.0, size)
    wrapper.obs_rms.var = np.linspace(1.0, 4.0, size)
    wrapper.obs_rms.count = 1000
    return wrapper


def errors_of(new_act, make=made, episodes=EPISODES):
    """Return the mean errors of a plain loop; `new_act()` gives a function for an episode."""
    errors = []
    for seed in range(SEED, SEED + episodes):
        with closing(make()) as env:
            act, total = new_act(), []
            observation, _ = env.reset(seed=seed)
            for _ in range(LENGTH):
                observation, *_, info = env.step(act(observation))
                total.append(abs(info["error"]))
        errors.append(np.mean(total))
    return errors


def predicting(model):
    """Return how a model of Stable-Baselines3 acts in one episode."""

    def new_act():
        memory = {"state": None, "episode_start": np.ones(1)}

        def act(observation):
            seen = batched(observation)
            actions, state = model.predict(seen, deterministic=True, **memory)
            memory.update(state=state, episode_start=np.zeros(1))
            return actions[0]

        return act

    return new_act


def batched(observation):
    if isinstance(observation, dict):
        return {name: each[None] for name, each in observation.items()}
    return np.asarray(observation)[None]


def model_of(algorithm, env):
    """Return an untrained model whose actions are large and differ."""
    policy = "MultiInputPolicy" if isinstance(env.observation_space, Dict) else "MlpPolicy"
    tiny = {"learning_starts": 8, "buffer_size": 200, "batch_size": 8, "train_freq": 16}
    if algorithm in (PPO, RecurrentPPO):
        tiny = {"n_steps": 16, "batch_size": 16, "n_epochs": 1}
    if algorithm is RecurrentPPO:
        policy, tiny["policy_kwargs"] = "MlpLstmPolicy", {"lstm_hidden_size": 8}
    model = algorithm(policy, env, seed=0, device="cpu", **tiny)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for weight in model.policy.parameters():
            weight.add_(0.05 * torch.randn(weight.shape, generator=generator))
    return model


def law(observations):
    return np.clip(-0.3 * observations[..., 3:4], -1.0, 1.0)


class Integrator:
    """A policy that remembers, with a method that forgets."""

    def __init__(self):
        self.reset()

    def reset(self):
        self.sum = 0.0

    def __call__(self, observations):
        self.sum = self.sum + observations[..., 3:4]
        return -0.05 * observations[..., 3:4] - 0.002 * self.sum

    act = __call__


class Resetless:
    """An object whose method of another name acts, and which must not be reset."""

    def reset(self):
        raise AssertionError("a reset of a trainer")

    def choose(self, observations):
        return law(observations)


class Exploring:
    def act(self, observations, deterministic=False):
        return law(observations) + (0.0 if deterministic else 0.5)


class Network(torch.nn.Module):
    num_envs = 64  # of its training
    u_min, u_max, observation_space = -1, 1, "a stranger's attribute"

    def __init__(self, dtype=torch.float32):
        super().__init__()
        torch.manual_seed(0)
        layers = torch.nn.Linear(6, 9), torch.nn.Dropout(), torch.nn.Linear(9, 1)
        self.layers = torch.nn.Sequential(*layers).to(dtype)

    def forward(self, seen, scale=1.0):
        return torch.tanh(scale * self.layers(seen))


def of_partial():
    made = Network()
    made.forward = partial(made.forward, scale=0.5)
    return made


class OfBlocks(torch.nn.Module):
    def forward(self, seen):
        return -0.3 * seen["errors"][..., :1]


class Acting(Network):
    def act(self, observations):
        assert isinstance(observations, np.ndarray)
        return self(torch.as_tensor(observations))


class Exploration(Network):
    """A module whose noise depends on its mode, by a `train` of its own."""

    noisy = True

    def train(self, mode=True):
        self.noisy = mode
        return super().train(mode)

    def forward(self, seen):
        return super().forward(seen) + 0.5 * self.noisy


class Trainer(torch.nn.Module):
    """A module with a training called `train`, and two ways to act."""

    def __init__(self):
        super().__init__()
        self.network = Network()

    def train(self, data):
        raise AssertionError("a training that nobody asked for")

    def reset(self):
        raise AssertionError("a reset of a trainer")

    def get_action(self, seen):
        assert seen.dtype == torch.float32
        assert not torch.is_grad_enabled()
        return self.network(seen)

    def in_arrays(self):
        return lambda seen: self.network(torch.as_tensor(seen)).detach().numpy()


def frozen_script():
    with warnings.catch_warnings(action="ignore", category=DeprecationWarning):
        scripted = torch.jit.script(torch.nn.Sequential(*Network().layers).eval())
        return torch.jit.freeze(scripted)


def network_act(network):
    evaluating = copy.deepcopy(network).eval()
    dtype = next(network.parameters()).dtype
    return lambda seen: evaluating(torch.tensor(seen, dtype=dtype)).detach().numpy()


def levels(n=5):
    """Return an environment whose action chooses among a few flows."""
    flow = lambda action: np.array([2.0 * action / (n - 1) - 1.0], np.float32)  # noqa: E731
    return wrappers.TransformAction(made(), flow, Discrete(n))


def blocks():
    """Return an environment that shows set points and errors by name."""
    env = made()
    low, high = env.observation_space.low, env.observation_space.high
    parts = {"setpoints": Box(low[:3], high[:3]), "errors": Box(low[3:], high[3:])}
    show = lambda seen: {"setpoints": seen[:3], "errors": seen[3:]}  # noqa: E731
    return wrappers.TransformObservation(env, show, Dict(parts))


def frames(**padding):
    return wrappers.FrameStackObservation(made(), 2, **padding)


def scaled():
    return wrappers.TransformObservation(made(), lambda seen: seen * np.float32(0.1), None)


def odd(**methods):
    """Return an environment in a wrapper with these methods."""
    env = gymnasium.Wrapper(made())
    for name, method in methods.items():
        setattr(env, name, partial(method, env.env))
    return env


def telling(tell):
    """Return an environment that tells other infos than those of the plant."""
    return odd(step=lambda env, action: (*(found := env.step(action))[:4], tell(found[4])))


class NoResetInfos(DummyVecEnv):
    """A vector environment of somebody's, from before `reset_infos`."""

    def reset(self):
        observations = super().reset()
        self.reset_infos = [{} for _ in self.envs]
        return observations


def halfway(env):
    env.reset(seed=1)
    for _ in range(7):
        env.step(env.action_space.sample())
    return env


def dummy(make=made, n=N):
    return DummyVecEnv([make] * n)


def processes(make=made, n=N):
    return SubprocVecEnv([make] * n, start_method="fork")


def with_statistics(envs):
    """Return a policy in environments that normalise, and the plain loop."""
    kept = copy.deepcopy(normal(envs).obs_rms)
    see = lambda seen: (seen - kept.mean) / np.sqrt(kept.var + 1e-8)  # noqa: E731
    return law, envs, lambda: lambda seen: law(see(seen))


def bare_zip(folder):
    model = model_of(PPO, made())
    model.save(folder / "bare.zip")
    return PPO.load(folder / "bare.zip"), NOISY, predicting(model)


def closed(env):
    env.close()
    return env


def closed_processes(folder):
    make = lambda: moved(made())  # noqa: E731
    model = model_of(PPO, closed(processes(make)))
    return model, make, predicting(model), make


def saved(folder, make, plants):
    """Return a model from the zip of `save`, on the spec of its environments."""
    save(model_of(PPO, plants), folder / "model.zip")
    model = load(folder / "model.zip", device="cpu")
    return model, spec_of(model, NOISY, **SHORT), predicting(model), make


def live(algorithm, env, make=made):
    model = model_of(algorithm, env)
    return model, model.get_env(), predicting(model), make


def memory(env, make=made):
    return Integrator(), env, Integrator, make


def plain(policy, env=NOISY, make=made):
    return policy, env, lambda: policy, make


def network(policy, original=None):
    return policy, NOISY, lambda: network_act(original or policy)


# Each gives a policy, where it acts, how it acts in a plain loop, and the environment there.
RIGHT = {
    "function": lambda _: plain(law),
    "object with act and reset": lambda _: memory(NOISY),
    "its bound method": lambda _: (Integrator().act, NOISY, Integrator),
    "predict of one's own": lambda _: (
        SimpleNamespace(reset=(i := Integrator()).reset, predict=lambda seen: i(seen)),
        many(), Integrator),
    "predict behind **keywords": lambda _: (
        SimpleNamespace(predict=lambda seen, **k: Exploring().act(seen, k["deterministic"])),
        NOISY, lambda: law),
    "act with an option": lambda _: (Exploring(), NOISY, lambda: lambda s: law(s) + 0.5),
    "partial that wants to explore": lambda _: (
        partial(Exploring().act, deterministic=False), NOISY, lambda: lambda s: law(s) + 0.5),
    "PI controller": lambda _: (PIController(), NOISY, lambda: PIController().act),
    "network that learns": lambda _: (
        DirectNNController(num_envs=EPISODES, learning=False), NOISY, None),
    "module": lambda _: network(Network()),
    "module in float64": lambda _: network(Network(torch.float64)),
    "its forward is a partial": lambda _: network(of_partial()),
    "its forward": lambda _: network((m := Network()).forward, m),
    "other method of a module": lambda _: network((t := Trainer()).get_action, t.network),
    "module with a train of its own": lambda _: network(Exploration()),
    "frozen script": lambda _: (
        f := frozen_script(), NOISY,
        lambda: lambda seen: f(torch.as_tensor(seen)[None]).numpy()[0]),
    "bound predict": lambda _: ((m := model_of(PPO, made())).predict, NOISY, predicting(m)),
    "other method of an object": lambda _: (
        (p := Resetless()).choose, NOISY, lambda: p.choose),
    "infos listed by plant": lambda _: memory(wrappers.vector.DictInfoToList(many())),
    "a partial of a module": lambda _: network(partial(m := Network(), scale=1.0), m),
    "module with act": lambda _: network(Acting()),
    "module of dicts": lambda _: (
        OfBlocks(), dummy(blocks), lambda: lambda seen: -0.3 * seen["errors"][:1], blocks),
    "spec with wrappers": lambda _: plain(law, moved(made()).spec, lambda: moved(made())),
    "function that makes one": lambda _: memory(made),
    "the same, in a wrapper": lambda _: memory(scaled, scaled),
    "the same, without a spec": lambda _: memory(
        lambda: wrappers.TimeLimit(MiddlePointEnv(**BARE), LENGTH)),
    "one environment": lambda _: memory(made()),
    "drawn limits": lambda _: memory(make := partial(
        made, u_min=[-12.0, -8.0], u_max=[8.0, 12.0]), make),
    "wrapper that returns tensors": lambda _: plain(
        law, wrappers.TransformObservation(made(), torch.as_tensor, None)),
    "one in mid-episode": lambda _: memory(halfway(made())),
    "native batch": lambda _: memory(many()),
    "native batch, SameStep": lambda _: memory(many(autoreset_mode="SameStep")),
    "AsyncVectorEnv": lambda _: memory(AsyncVectorEnv([made] * N, context="fork")),
    "vector IncrementalAction": lambda _: memory(
        IncrementalBatch(many(), **VELOCITY), lambda: moved(made())),
    "DummyVecEnv": lambda _: memory(dummy()),
    "DummyVecEnv in mid-episode": lambda _: memory(dummy(lambda: halfway(made()))),
    "SubprocVecEnv": lambda _: memory(processes()),
    "plants in groups": lambda _: memory(make_vec_env(NOISY, N, group=N, **SHORT)),
    "VecEnv without reset_infos": lambda _: memory(NoResetInfos([made] * N)),
    "plants that differ in rewards": lambda _: memory(
        DummyVecEnv([made, partial(made, reward="absolute")])),
    "VecNormalize": lambda _: with_statistics(VecNormalize(dummy())),
    "vec_normalize.pkl": lambda folder: with_statistics(
        normal(VecNormalize(dummy())).save(path := str(folder / "vec_normalize.pkl"))
        or VecNormalize.load(path, dummy())),
    "VecNormalize on a batch": lambda _: with_statistics(
        VecNormalize(make_vec_env(NOISY, N, **SHORT))),
    "NormalizeObservation": lambda _: with_statistics(wrappers.NormalizeObservation(made())),
    "vector NormalizeObservation": lambda _: with_statistics(
        wrappers.vector.NormalizeObservation(many())),
    "VecFrameStack": lambda _: live(
        PPO, Stack(dummy(), 2),
        lambda: wrappers.FlattenObservation(frames(padding_type="zero"))),
    "FrameStackObservation": lambda _: live(PPO, frames(), frames),
    "dict observations": lambda _: live(PPO, dummy(blocks), blocks),
    "PPO in IncrementalAction": lambda _: live(
        PPO, make_vec_env(NOISY, N, wrapper=VELOCITY, **SHORT), lambda: moved(made())),
    "PPO, rewards normalised": lambda _: (
        m := model_of(PPO, VecNormalize(dummy(), norm_obs=False)), NOISY, predicting(m)),
    "DQN": lambda _: live(DQN, levels(), levels),
    "RecurrentPPO": lambda _: live(RecurrentPPO, dummy()),
    "policy of a model": lambda _: ((m := model_of(PPO, made())).policy, NOISY, predicting(m)),
    "model without environments, such as best_model.zip": bare_zip,
    "model of closed processes": closed_processes,
    "zip of save": lambda folder: saved(
        folder, lambda: moved(made(action_window=3)),
        make_vec_env(NOISY, N, wrapper=VELOCITY, action_window=3, **SHORT)),
    "zip of save, own wrapper": lambda folder: saved(folder, frames, frames()),
}  # fmt: skip


@pytest.mark.parametrize("name", RIGHT)
def test_it_is_the_plain_loop(name, tmp_path):
    policy, env, new_act, *make = RIGHT[name](tmp_path)
    given = SHORT if env == NOISY else {}
    found = evaluate(policy, env, episodes=EPISODES, **given)
    if new_act is None:  # each loop has a network of its own
        seeds = iter(range(EPISODES))
        new_act = lambda: DirectNNController(seed=next(seeds), learning=False).act  # noqa: E731
    expected = errors_of(new_act, *make)
    np.testing.assert_allclose(found.errors, expected, rtol=0, atol=1e-6)
    assert np.ptp(found.errors) > 1e-3
    assert found.travels.min() > 1.0
    if hasattr(env, "close"):
        env.close()


def unlike(first, second):
    return SyncVectorEnv([lambda: made(**first), lambda: made(**second)])


# Each gives a policy and where it acts.
REFUSED = {
    "actions of another shape": (
        lambda: (lambda seen: np.zeros(len(seen)), NOISY), r"shape \(3, 1\), .*\(3,\)"),
    "actions that are not finite": (
        lambda: (lambda seen: np.full((len(seen), 1), np.nan), NOISY), "(?s)finite .*nan"),
    "actions that are masked": (
        lambda: (lambda seen: np.ma.masked_less(law(seen), 0.0), NOISY),
        r"finite actions, shape \(3, 1\), got masked_array"),
    "actions that are text": (
        lambda: (lambda seen: [["open"]] * len(seen), NOISY), "finite.*open"),
    "tensors with gradients": (
        lambda: (lambda seen: torch.zeros(len(seen), 1, requires_grad=True), NOISY),
        r"tensor\.detach\("),
    "no policy": (lambda: (3, NOISY), "must be a function, .*, or an obj"),
    "a class": (lambda: (PIController, NOISY), "predict or act, not a class"),
    "controller of another actuator": (
        lambda: (PIController(u_max=6.0), NOISY), "limits of env, u_min=-10.0, u_max=10.0"),
    "controller in a wrapper": (
        lambda: (PIController(), moved(made())), "not be wrapped.*Increm"),
    "controller in frames": (
        lambda: (PIController(), Stack(VecNormalize(dummy(), norm_obs=False), 2)),
        "not be wrapped.*VecFrameStack"),
    "controller of too few loops": (
        lambda: (DirectNNController(num_envs=2), NOISY), "num_envs=3"),
    "unknown id": (
        lambda: (law, "MiddlePointNosy-v0"), r"id of an env.*Did you mean: .MiddlePointNoisy"),
    "another environment": (lambda: (law, "CartPole-v1"), "of MiddlePointEnv .*CartPole-v1"),
    "tuple of actions and more": (
        lambda: (lambda seen: (law(seen), None), NOISY),
        r"returns actions alone, such as lambda o: agent\.get_action\(o\)\[0\]"),
    "swapped arguments": (lambda: (made(), law), r"which comes first: evaluate\(policy, env\)"),
    "environment in PyTorch": (
        lambda: (law, MiddlePointTorchEnv(N)), "of MiddlePointEnv in NumPy, and open, such as"),
    "no environment": (lambda: (law, 7), "env must be an id, an EnvSpec, environments, or a f"),
    "function that makes a batch": (lambda: (law, many), "where it makes many, call it"),
    "function that makes the same": (
        lambda: (law, lambda e=made(): e), "run the episodes of its seeds"),  # noqa: B008
    "another seed": (
        lambda: (law, odd(reset=lambda env, seed, options: env.reset(seed=5))),
        "of its seeds, whose noise at sample"),
    "flattering errors": (
        lambda: (law, telling(lambda info: info | {"error": 0.1})),
        "whose error at sample 1 is"),
    "no errors": (
        lambda: (law, telling(lambda info: {k: info[k] for k in info if k != "error"})),
        "whose error at sample 1 is.* got None"),
    "plants that differ": (
        lambda: (law, unlike({}, {"delay": 3})), "must have the same plants"),
    "episodes that differ": (
        lambda: (law, unlike({}, {"max_episode_steps": 9})), "all episodes at once, .* 9 s"),
    "rounds that differ": (
        lambda: (law, odd(step=lambda env, action: (
            *(found := env.step(action))[:2], found[4]["error"] > 6.5, *found[3:]))),
        "all episodes at once"),
    "VecNormalize without statistics": (
        lambda: (law, VecNormalize(dummy())), "in VecNormalize, got initial"),
    "new NormalizeObservation": (
        lambda: (law, wrappers.NormalizeObservation(made())),
        "in NormalizeObservation, got initial"),
    "normalised in one of the processes": (
        lambda: (law, AsyncVectorEnv(
            [made, lambda: wrappers.NormalizeReward(made())], context="fork")),
        "not normalise in other processes"),
    "closed processes": (lambda: (law, closed(processes())), "in NumPy, and open"),
    "Monitor in mid-episode": (
        lambda: (law, halfway(Monitor(made(), allow_early_resets=False))),
        "allow_early_resets=T"),
    "model of other windows": (
        lambda: (model_of(PPO, made(action_window=3)), NOISY),
        r"windows .* \(3, 3, 0, 3\), got \(3, 3, 0, 0\): .*model\.get_env\(\)\), or spec_of"),
    "the same, without environments": (
        lambda: (model_of(PPO, made(action_window=3)).policy, NOISY),
        r"observation space of policy's training, shape \(9,\) within .* got shape \(6,\)"),
    "model of windows with these bounds": (
        lambda: (model_of(PPO, made(error_window=0, output_window=3)),
                 made(setpoint_window=6, error_window=0)), "windows .* of policy's training"),
    "model whose IncrementalAction is forgotten": (
        lambda: (model_of(PPO, make_vec_env(NOISY, N, wrapper=VELOCITY)), NOISY),
        "wrappers of policy's training, IncrementalAction.*, got none"),
    "the same, in processes": (
        lambda: (model_of(PPO, processes(lambda: moved(made()))), NOISY),
        "wrappers of policy's training, IncrementalAction.*, got none"),
    "the same, with other increments": (
        lambda: (model_of(PPO, make_vec_env(NOISY, N, wrapper=VELOCITY)),
                 lambda: IncrementalAction(made())),
        r"IncrementalAction\(0\.3, 4\.0\), got IncrementalAction\(0\.4, False\)"),
    "the same, in a VecEnv": (
        lambda: (model_of(PPO, make_vec_env(NOISY, N, wrapper=VELOCITY)), dummy()),
        "wrappers of policy's training, IncrementalAction.*, got none"),
    "model whose VecNormalize is forgotten": (
        lambda: (model_of(PPO, normal(VecNormalize(dummy()))), NOISY),
        "wrappers of policy's training, VecNormalize.clip_obs=10., got none"),
    "the same, in a plain batch": (
        lambda: (model_of(PPO, normal(VecNormalize(dummy()))), make_vec_env(NOISY, N)),
        "wrappers of policy's training, VecNormalize.clip_obs=10., got none"),
    "what its VecNormalize wraps": (
        lambda: ((m := model_of(PPO, normal(VecNormalize(dummy())))), m.get_env().unwrapped),
        "wrappers of policy's training, VecNormalize.clip_obs=10., got none"),
    "one of the plants of its VecNormalize": (
        lambda: ((m := model_of(PPO, normal(VecNormalize(dummy())))), m.get_env().envs[0]),
        "wrappers of policy's training, VecNormalize.clip_obs=10., got none"),
    "model whose TransformObservation is forgotten": (
        lambda: (model_of(PPO, dummy(scaled)), make_vec_env(NOISY, N, **SHORT)),
        "wrappers of policy's training, TransformObservation, got none"),
    "processes of its training": (
        lambda: ((m := model_of(PPO, processes())), m.get_env()),
        r"as these cannot be copied \(SubprocVecEnv runs in .*spec_of\(model, id"),
    "the policy of a model, in processes of its training": (
        lambda: ((m := model_of(PPO, processes())).policy, m.get_env()),
        r"as these cannot be copied \(SubprocVecEnv runs in .*pass the model itself"),
    "statistics of its VecNormalize with another limit": (
        lambda: (model_of(PPO, normal(VecNormalize(dummy()))),
                 normal(VecNormalize(dummy(), clip_obs=0.1))),
        r"VecNormalize.clip_obs=10., got VecNormalize.clip_obs=0.1."),
    "window of its training": (
        lambda: ((m := model_of(PPO, made(render_mode="human"))), m.get_env()),
        r"as these cannot be copied \(MiddlePointEnv shows a window"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_it_is_refused_by_a_rule(name):
    given, message = REFUSED[name]
    policy, env = given()
    with pytest.raises(ValueError, match=message):
        evaluate(policy, env, episodes=EPISODES, **(SHORT if env == NOISY else {}))


BAD_IDS = "", " ", "a\0b", "MiddlePoint-v0\n", "no_such_module:Plant-v0"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"env": made, "delay": 3}, "delay must be given where env is made"),
        ({"delay": -1}, "delay must be"),
        *(({"env": env}, "env must be the id of an environment .") for env in BAD_IDS),
        ({"seed": -1}, "seed must be an integer from 0"),
        *(({"episodes": n}, "episodes must be an integer from 2") for n in (1, 2.5, "many")),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        evaluate(law, **arguments)


def in_file(folder):
    return lambda: Monitor(made(), str(folder / "one"))


# The environments of a training, made in a folder for their files.
TRAININGS = {
    "DummyVecEnv": lambda _: dummy(),
    "make_vec_env": lambda _: make_vec_env(NOISY, N, seed=0, **SHORT),
    "groups": lambda _: make_vec_env(NOISY, N, seed=0, group=N, wrapper=VELOCITY, **SHORT),
    "VecNormalize": lambda _: VecNormalize(dummy()),
    "VecFrameStack": lambda _: Stack(make_vec_env(NOISY, N, **SHORT), 2),
    "VecMonitor": lambda folder: VecMonitor(dummy(), str(folder / "all")),
    "Monitor": lambda _: dummy(lambda: Monitor(made())),
    "Monitor with a file": lambda folder: dummy(in_file(folder), n=1),
    "NormalizeObservation": lambda _: dummy(lambda: wrappers.NormalizeObservation(made())),
}


def state_of(model):
    """Return all that a training may leave in a model and around it, by name."""
    buffer = getattr(model, "rollout_buffer", None) or model.replay_buffer
    state = {f"buffer {k}": v for k, v in vars(buffer).items() if isinstance(v, np.ndarray)}
    state |= {f"weights {k}": v.numpy() for k, v in model.policy.state_dict().items()}
    state |= {"episodes": np.array([[e["r"], e["l"]] for e in model.ep_info_buffer])}
    state |= {"seen": model._last_obs, "numpy": np.random.get_state()[1]}  # noqa: NPY002
    state |= {"torch": torch.get_rng_state().numpy(), "python": np.array(random.getstate()[1])}
    for layer in layers(model.get_env()):
        for name in ("obs_rms", "ret_rms"):
            if statistics := getattr(layer, name, None):
                state |= {f"{name} {k}": np.array(v) for k, v in vars(statistics).items()}
    return state


class TestNothingThatIsHandedOverChanges:
    @pytest.mark.parametrize("part", [False, True], ids=["whole", "part"])
    @pytest.mark.parametrize("algorithm", [PPO, SAC, RecurrentPPO])
    @pytest.mark.parametrize("kind", TRAININGS)
    def test_a_training_is_the_same_with_scores_and_without(
        self, kind, algorithm, part, tmp_path
    ):
        def trained(folder, score):
            folder.mkdir()
            random.seed(0)
            model = model_of(algorithm, TRAININGS[kind](folder))
            env = model.get_env()
            if part and not hasattr(env, "envs"):
                pytest.skip("its environments are no environments of their own")
            # The wrappers of all environments around one of them would not fit.
            env = env.envs[0] if part and isinstance(env, DummyVecEnv) else env

            def score_now(*_):
                if score and model.num_timesteps in (20, 40):
                    results.append(evaluate(model, env, episodes=2, seed=model.num_timesteps))
                return True

            model.learn(48, callback=score_now)
            state = state_of(model)
            model.get_env().close()
            return state, sorted(file.read_text() for file in folder.iterdir())

        results = []
        (scored, files), (plain, plain_files) = (
            trained(tmp_path / name, name == "scored") for name in ("scored", "plain")
        )
        assert len(results) == 2
        assert np.ptp([found.mean_error for found in results]) > 1e-3
        assert scored.keys() == plain.keys()
        for name, value in scored.items():
            np.testing.assert_array_equal(value, plain[name], err_msg=name)
        rows = [[line.count(",") for line in text.splitlines()] for text in files]
        assert rows == [[line.count(",") for line in text.splitlines()] for text in plain_files]

    def test_it_is_the_same_where_an_evaluation_fails(self):
        envs = normal(VecNormalize(dummy(lambda: wrappers.NormalizeReward(made()))))
        before = {name: value.copy() for name, value in self.numbers(envs).items()}
        network = Exploration()
        network.layers[0].eval()

        def act(seen):
            assert not any((network.training, network.noisy, network.layers[1].training))
            return np.full((N, 1), np.nan)

        network.forward = act
        with pytest.raises(ValueError, match="finite"):
            evaluate(network, envs, episodes=EPISODES)
        assert all((envs.training, network.training, network.noisy))
        assert envs.venv.envs[0].update_running_mean
        assert [part.training for part in network.layers] == [False, True, True]
        for name, value in self.numbers(envs).items():
            np.testing.assert_array_equal(value, before[name])

    @staticmethod
    def numbers(envs):
        statistics = vars(envs.obs_rms) | vars(envs.venv.envs[0].return_rms)
        return {name: np.asarray(value) for name, value in statistics.items()}

    @pytest.mark.parametrize(
        "make",
        [made, many, dummy, lambda: make_vec_env(NOISY, **SHORT),
         lambda: SyncVectorEnv([made] * N)],
    )  # fmt: skip
    def test_they_are_not_closed_and_may_be_scored_again(self, make):
        env = make()
        for layer in layers(env):
            layer.close = lambda: pytest.fail("closed")
        first, again = (evaluate(Integrator(), env, episodes=EPISODES) for _ in range(2))
        np.testing.assert_array_equal(first.errors, again.errors)
        for layer in layers(env):
            del layer.close

    def test_a_recorder_records_nothing(self):
        class Recorder(wrappers.RecordVideo):
            def __init__(self, env):
                gymnasium.Wrapper.__init__(self, env)

            def step(self, action):
                pytest.fail("recorded")

        plants = wrappers.TransformReward(Recorder(made()), abs)
        assert evaluate(law, plants, episodes=2).travel > 1.0

    def test_a_module_may_be_scored_in_several_threads(self):
        network = Network()
        expected = evaluate(network, NOISY, episodes=2, **SHORT).errors
        with ThreadPoolExecutor(4) as pool:
            score = partial(evaluate, network, NOISY, episodes=2, **SHORT)
            results = [found.errors for found in pool.map(lambda _: score(), range(12))]
        assert all(np.array_equal(errors, expected) for errors in results)
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
    @pytest.mark.parametrize("make", [
        processes, lambda: AsyncVectorEnv([made] * N, context="fork"),
        lambda: VecMonitor(processes()), lambda: Locked(made()), lambda: Piped(made()),
        lambda: dummy(lambda: wrappers.TransformReward(Locked(made()), abs)),
        lambda: made(render_mode="human"),
    ])  # fmt: skip
    def test_it_runs_itself_and_begins_a_new_episode(self, make):
        with closing(make()) as env:
            for _ in range(2):
                found = evaluate(law, env, episodes=EPISODES)
                assert np.ptp(found.errors) > 1e-3
            gc.collect()
            if isinstance(env, Piped):
                first, second = env.line.ends
                first.send(1)
                assert second.recv() == 1
            if hasattr(env, "get_attr"):
                seeds = env.get_attr("np_random_seed")
                env.step(np.zeros((N, 1), np.float32))
            else:
                seeds = [env.unwrapped.np_random_seed]
                env.step(np.zeros(1, np.float32))
            assert not {*seeds} & {*range(SEED, SEED + 9)}

    def test_a_model_of_other_processes_may_act_in_this_one(self):
        with closing(processes(lambda: moved(made()))) as training:
            model = model_of(PPO, training)
            found = evaluate(model, lambda: moved(made()), episodes=EPISODES)
        expected = errors_of(predicting(model), lambda: moved(made()))
        np.testing.assert_allclose(found.errors, expected, rtol=0, atol=1e-6)

    def test_it_is_refused_without_harm_where_a_model_trains_in_it(self):
        model = model_of(PPO, VecNormalize(processes()))
        with closing(model.get_env()):
            for policy in (model, model.predict):
                with pytest.raises(ValueError, match="others like them"):
                    evaluate(policy, model.get_env(), episodes=2)
            assert model.get_env().training
            model.learn(64)

    def test_an_error_of_the_last_reset_is_not_hidden(self):
        class Lost(Locked):
            resets = 0

            def reset(self, **keywords):
                self.resets += 1
                if self.resets > 2:
                    raise ConnectionError("connection lost")
                return super().reset(**keywords)

        with pytest.raises(ConnectionError):
            evaluate(law, Lost(made()), episodes=2)

    def test_an_error_of_their_own_is_not_hidden(self):
        with pytest.raises(ZeroDivisionError):
            evaluate(law, odd(step=lambda *_: 1 / 0), episodes=EPISODES)


@pytest.mark.parametrize("learns", [False, True])
def test_what_is_learnt_carries_over_to_the_next_round(learns):
    network = DirectNNController(num_envs=N, learning=learns)
    plants = gymnasium.make_vec("MiddlePoint-v0", N, max_episode_steps=LENGTH)
    errors = evaluate(network, plants, episodes=2 * N).errors
    assert np.array_equal(errors[:N], errors[N:]) is not learns


def test_without_an_end_of_its_own_it_has_1200_samples():
    for limit in (None, 2000):
        plants = MiddlePointVectorEnv(N, max_episode_steps=limit)
        assert evaluate(law, plants, episodes=2).score is not None
    for limit in (-1, 2000):
        assert evaluate(law, episodes=2, max_episode_steps=limit).score is not None
    # Its spec says 1200.
    short = gymnasium.make_vec("MiddlePoint-v0", N, max_episode_steps=50)
    assert evaluate(law, short, episodes=2).score is None
