"""Compare the steps a second of this and other environments: `python -m benchmarks.speed`."""

from __future__ import annotations

import copy
import importlib.util
import os
import subprocess
import sys
import time
import tracemalloc
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pandas as pd
import torch
from rich.console import Console
from torch import nn
from tqdm import tqdm

from agents import DirectNNController
from benchmarks.lib.command import blame
from benchmarks.lib.tables import ScreenTable
from benchmarks.loop.rollout import make_plants, rollout
from benchmarks.speed.__main__ import Options
from mptc_gym import PRESETS, MiddlePointEnv, MiddlePointVectorEnv
from mptc_gym.torch_env import MiddlePointTorchEnv

SINGLE_STEPS = 20_000
FRAMES = 400  # the chart is full for half of them
EPISODE = 1200
BATCHES = (8, 64, 1024, 16384)
LOOPS = (1, 64, 1000)
DEVICE_BATCHES = tuple(4**power for power in range(5, 12))  # 1,024 to 4,194,304 plants
DEVICE_STEPS = 200
GRADIENTS, BACKWARD = 1024, 300  # plants and samples of the gradient
REFERENCE, PLANT = "CartPole-v1", "MiddlePoint-v0"
# Arguments of the plants, by the suffix of their names.
NOISE: dict[str, Any] = {"noise_variance": 0.5}
PLANTS: dict[str, dict[str, Any]] = {"": {}, ", R = 0.5": NOISE, ", hard": PRESETS["hard"]}


@dataclass(frozen=True)
class Timed:
    """A piece of code to time."""

    name: str
    run: Callable[[], object]
    steps: int
    """Environment steps per call."""


def execute(options: Options, console: Console) -> str:
    """Measure, print the tables and return the closing lines."""
    rounds = options.rounds
    torch.set_num_threads(1)  # one core, as for the others

    def show(title: str, table: pd.DataFrame) -> None:
        console.print(title, ScreenTable(table), sep="\n")

    if options.device is not None:
        with blame("--device"):
            MiddlePointTorchEnv(1, device=options.device)
        show(f"Steps a second on {options.device}", measure_on(options.device, rounds))
        return f"Medians of {rounds} rounds."
    single = [
        *map(_single, (REFERENCE, "Pendulum-v1", PLANT)),
        _single(PLANT, ", R = 0.5", **NOISE),
        _single(PLANT, ", 20 past actions", action_window=20),
    ]
    drawn = [_single(name, render_mode="rgb_array") for name in (REFERENCE, PLANT)]
    learners = f"Plants with R = 0.5 and NNs that learn, one each: {EPISODE} samples together"
    policy = "Through the plant: a policy of two layers of 64, forward and backward"
    show("One environment, from gymnasium.make", compare(single, rounds))
    show('Steps with a picture of each, render_mode="rgb_array"', compare(drawn, rounds))
    for n in BATCHES:
        show(f"Vector environments, n = {n}", compare(list(_vector(n)), rounds))
    show(learners, compare([_closed_loop(n) for n in LOOPS], rounds))
    show(policy, compare([_through_the_plant(GRADIENTS)], rounds))
    show("Memory of a plant, 20 past actions", measure_memory())

    imports = [
        Timed(module, partial(subprocess.run, [sys.executable, "-c", f"import {module}"]), 1)
        for module in ("gymnasium", "mptc_gym")
    ]
    taken = 1000 * _time_in_turns(imports, rounds)
    low, more, high = (taken["mptc_gym"] - taken["gymnasium"]).quantile([0.1, 0.5, 0.9])
    missing = " and ".join(peer for peer in PEERS if not importlib.util.find_spec(peer))
    install = "pip install envpool gymnax six, in a virtual environment."
    return (f"Without {missing}: {install}\n" if missing else "") + (
        f"import gymnasium: {taken['gymnasium'].median():.0f} ms; import mptc_gym: "
        f"{more:+.0f} ms ({low:+.0f} to {high:+.0f})\n"
        f"Medians of {rounds} rounds; in parentheses, 10th to 90th percentile."
    )


def compare(cases: list[Timed], rounds: int) -> pd.DataFrame:
    """Time cases in turns for some rounds, and return one row per case.

    The ratio compares a case's steps a second with those of the first case in the same round.
    """
    seconds = _time_in_turns(cases, rounds)
    rates = seconds.rdiv([case.steps for case in cases], axis="columns")
    first = cases[0].name
    low, ratio, high = (
        rates.div(rates[first], axis="index").quantile(share).map("{:.2f}".format)
        for share in (0.1, 0.5, 0.9)
    )
    return pd.DataFrame(
        {
            "steps a second": rates.median().map("{:,.0f}".format),
            "seconds a round": seconds.median().map("{:.3f}".format),
            f"ratio to {first}": ratio + " (" + low + " to " + high + ")",
        }
    ).reset_index(names="case")


def _time_in_turns(cases: list[Timed], rounds: int) -> pd.DataFrame:
    """Time the cases in turns, and return seconds: one row per round, one column per case."""
    rows = []
    for _ in tqdm(range(rounds), leave=False):
        row = {}
        for case in cases:
            began = time.perf_counter()
            case.run()
            row[case.name] = time.perf_counter() - began
        rows.append(row)
    return pd.DataFrame(rows)


def measure_memory() -> pd.DataFrame:
    """Measure the memory per plant, in a batch and alone."""
    rows = []
    for name, given in {
        "R = 0": {},
        "R = 0.5, random set point": {**NOISE, "setpoint": "random"},
    }.items():
        arguments = {**given, "action_window": 20}
        batch = MiddlePointVectorEnv(100, max_episode_steps=EPISODE, **arguments)
        sizes = _memory(batch) / 100, _memory(MiddlePointEnv(**arguments))
        rows.append([name, *(f"{size / 1024:.1f} KiB" for size in sizes)])
    return pd.DataFrame(rows, columns=["case", "in a batch of 100", "alone"])


def _memory(env: Any) -> int:
    """Return the memory of an environment after a step, in bytes."""
    tracemalloc.start()
    env = copy.deepcopy(env)
    env.reset(seed=0)
    env.step(np.zeros(env.action_space.shape, np.float32))
    size, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return size


def _single(name: str, special: str = "", **arguments: Any) -> Timed:
    """Return the case of one environment, rendered at each step if it has a render mode."""
    env = gymnasium.make(name, **arguments)
    env.action_space.seed(0)
    draws = env.render_mode is not None
    actions = [env.action_space.sample() for _ in range(FRAMES if draws else SINGLE_STEPS)]

    def run() -> None:
        env.reset(seed=0)
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()
            if draws:
                env.render()

    return Timed(name + special, run, len(actions))


def _vector(n: int) -> Iterable[Timed]:
    """Yield the cases of vector environments; a call is one plant episode and its reset."""
    kinds = [(REFERENCE, "", {}), *((PLANT, *plant) for plant in PLANTS.items())]
    for name, special, arguments in kinds:
        envs = gymnasium.make_vec(name, n, vectorization_mode="vector_entry_point", **arguments)
        envs.reset(seed=0)
        envs.action_space.seed(0)
        actions = [envs.action_space.sample() for _ in range(20)]
        yield _steps(name + special, envs.step, actions, EPISODE + 1)
    yield from _in_torch(n, "cpu", EPISODE + 1)
    for peer in filter(importlib.util.find_spec, PEERS):
        yield from PEERS[peer](n)


def _steps(
    name: str,
    step: Callable[[Any], object],
    actions: list[Any],
    steps: int,
    wait: Callable[[], object] = lambda: None,
) -> Timed:
    """Return the case of a batch that cycles through the actions, then waits for its device."""

    def run() -> None:
        for k in range(steps):
            step(actions[k % len(actions)])
        wait()

    return Timed(name, run, steps * len(actions[0]))


def _envpool(n: int) -> Iterable[Timed]:
    """Yield the case of CartPole in C++, on one thread."""
    import envpool

    envs = envpool.make_gymnasium(REFERENCE, num_envs=n, num_threads=1, seed=0)
    envs.reset()
    actions = list(np.random.default_rng(0).integers(0, 2, (20, n), dtype=np.int32))
    yield _steps(f"{REFERENCE} of envpool", envs.step, actions, 100)


def _gymnax(n: int) -> Iterable[Timed]:
    """Yield CartPole in JAX on one CPU thread, step by step and as one compiled loop."""
    flags = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    os.environ.setdefault("XLA_FLAGS", flags)  # read on the first use of JAX
    import gymnax
    import jax

    env, parameters = gymnax.make(REFERENCE)
    actions = jax.random.randint(jax.random.key(1), (100, n), 0, 2)
    keys = jax.random.split(jax.random.key(0), n)
    start = jax.random.key(2), jax.vmap(env.reset, (0, None))(keys, parameters)[1]

    def advance(carry: tuple[Any, Any], action: Any) -> tuple[tuple[Any, Any], Any]:
        keys = jax.random.split(carry[0], n + 1)
        step = jax.vmap(env.step, (0, 0, 0, None))
        observations, state, *others = step(keys[1:], carry[1], action, parameters)
        return (keys[0], state), (observations, others)

    loop, step = jax.jit(partial(jax.lax.scan, advance)), jax.jit(advance)
    one_by_one = list(actions)

    def run_steps() -> None:
        carry = start
        for action in one_by_one:
            carry, returned = step(carry, action)
        jax.block_until_ready(returned)

    def run_loop() -> None:
        jax.block_until_ready(loop(start, actions))

    for name, run in {"": run_steps, ", one compiled loop": run_loop}.items():
        run()  # the first call compiles
        yield Timed(f"{REFERENCE} of gymnax{name}", run, n * 100)


PEERS: dict[str, Callable[[int], Iterable[Timed]]] = {"envpool": _envpool, "gymnax": _gymnax}


def _in_torch(n: int, device: str, steps: int) -> Iterable[Timed]:
    """Yield the cases of the PyTorch environment; a call waits for the device to finish."""
    wait = (lambda: None) if device == "cpu" else torch.accelerator.synchronize
    for special, arguments in PLANTS.items():
        envs = MiddlePointTorchEnv(n, device=device, **arguments)
        envs.reset(seed=0)
        actions = [2.0 * torch.rand(n, 1, device=device) - 1.0 for _ in range(20)]
        yield _steps(f"in PyTorch{special}", envs.step, actions, steps, wait)


def measure_on(device: str, rounds: int) -> pd.DataFrame:
    """Return the PyTorch environment's steps a second on a device, one row per batch size."""
    rows = []
    for n in DEVICE_BATCHES:
        row = {"n": f"{n:,}"}
        for case in _in_torch(n, device, DEVICE_STEPS):
            case.run()  # warm-up
            rates = case.steps / _time_in_turns([case], rounds)[case.name]
            row[case.name] = f"{rates.median():.3g}"
        rows.append(row)
    return pd.DataFrame(rows)


def _through_the_plant(n: int) -> Timed:
    """Return the case of a forward and backward pass through plants and a policy."""
    envs = MiddlePointTorchEnv(n, max_episode_steps=None, differentiable=True)
    size = envs.parameters.observation_size
    policy = nn.Sequential(
        nn.Linear(size, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, 1)
    )

    def train() -> None:
        observations, _ = envs.reset(seed=0)
        total = torch.zeros(())
        for _ in range(BACKWARD):
            observations, rewards, *_ = envs.step(policy(observations))
            total = total + rewards.mean()
        total.backward()

    return Timed(f"gradient through {n:,} plants and {BACKWARD} samples", train, n * BACKWARD)


def _closed_loop(n: int) -> Timed:
    """Return the case of a batch of plants and their networks."""
    plants, controller = make_plants(n, EPISODE, **NOISE), DirectNNController(num_envs=n)
    run = partial(rollout, plants, controller, EPISODE, seed=0)
    return Timed(f"batch of {n:,}", run, n * EPISODE)
