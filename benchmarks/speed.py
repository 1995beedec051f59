"""Compare steps a second with those of Gymnasium's CartPole: `python -m benchmarks.speed`."""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np

from agents import DirectNNController
from benchmarks.lib.command import Runs, blame, command, options
from mptc_gym import PRESETS

if TYPE_CHECKING:
    import pandas as pd

EPISODE = 1200  # steps of a call
BATCHES = (8, 64, 1024, 16384)
ON_DEVICE = tuple(4**power for power in range(5, 12))  # 1,024 to 4,194,304 plants
LEARNERS = 1000
REFERENCE, PLANT = "CartPole-v1", "MiddlePoint-v0"
# Arguments of the plants, by the suffix of their names.
NOISE: dict[str, Any] = {"noise_variance": 0.5}
PLANTS: dict[str, dict[str, Any]] = {"": {}, ", R = 0.5": NOISE, ", hard": PRESETS["hard"]}

Cases = dict[str, tuple[Callable[[], object], int]]  # by name: a function, and its steps


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Compare the steps a second of the environments with those of CartPole.

    The cases of a table are timed in turns. Its ratios are those within a round.
    """

    rounds: Runs = 15
    """Number of measurements of each case."""
    device: str | None = None
    """Measure only the PyTorch environment, on this device, such as cuda."""


def work(options: Options) -> str:
    """Measure, print the tables and return the closing line."""
    from benchmarks.lib.report import on_screen

    with blame("--device"):
        for title, cases in tables(options.device):
            print(f"\n{title}\n{on_screen(compare(cases, options.rounds))}", flush=True)
    return f"Medians of {options.rounds} rounds; in parentheses, 10th to 90th percentile."


def tables(device: str | None) -> Iterator[tuple[str, Cases]]:
    """Yield the title and the cases of each table; those of a device are PyTorch's alone."""
    from benchmarks.loop.rollout import make_plants, rollout

    if device is not None:
        for n in ON_DEVICE:
            yield f"In PyTorch on {device}, n = {n:,}", in_torch(n, device, steps=200)
        return
    yield "One environment, from gymnasium.make", single(REFERENCE) | single(PLANT)
    has_torch = importlib.util.find_spec("torch") is not None
    for n in BATCHES:
        cases = in_batch(REFERENCE, n, {"": {}}) | in_batch(PLANT, n, PLANTS)
        yield f"Vector environments, n = {n:,}", cases | (in_torch(n) if has_torch else {})
    plants = make_plants(LEARNERS, EPISODE, **NOISE)
    networks = DirectNNController(num_envs=LEARNERS)
    cases = in_batch(REFERENCE, LEARNERS, {"": {}})
    episode = partial(rollout, plants, networks, EPISODE, seed=0)
    cases["plants and networks"] = episode, LEARNERS * EPISODE
    yield f"Noisy plants and their networks, which learn, n = {LEARNERS:,}", cases


def compare(cases: Cases, rounds: int) -> pd.DataFrame:
    """Time cases in turns for some rounds, and return one row for each.

    The ratio compares a case's steps a second with those of the first case in the same round.
    """
    import pandas as pd  # here, as in all commands: it would slow the help down

    seconds = []
    for _ in range(rounds):
        clock = [time.perf_counter()]
        for run, _ in cases.values():
            run()
            clock.append(time.perf_counter())
        seconds.append(np.diff(clock))
    rates = pd.DataFrame([steps for _, steps in cases.values()] / np.array(seconds))
    low, ratio, high = (
        rates.div(rates[0], axis="index").quantile(share).map("{:.2f}".format)
        for share in (0.1, 0.5, 0.9)
    )
    return pd.DataFrame(
        {
            "case": [*cases],
            "steps a second": rates.median().map("{:,.0f}".format),
            f"ratio to {next(iter(cases))}": ratio + " (" + low + " to " + high + ")",
        }
    )


def single(name: str) -> Cases:
    """Return the case of one environment, reset whenever an episode ends."""
    env = gymnasium.make(name)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(10 * EPISODE)]

    def run() -> None:
        env.reset(seed=0)
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()

    return {name: (run, len(actions))}


def in_batch(name: str, n: int, plants: dict[str, dict[str, Any]]) -> Cases:
    """Return cases of NumPy's vector environment; a call is an episode and its reset."""
    cases: Cases = {}
    for special, arguments in plants.items():
        envs = gymnasium.make_vec(name, n, vectorization_mode="vector_entry_point", **arguments)
        envs.reset(seed=0)
        envs.action_space.seed(0)
        actions = [envs.action_space.sample() for _ in range(20)]
        run = partial(_cycle, envs.step, actions, EPISODE + 1)
        cases[name + special] = run, n * (EPISODE + 1)
    return cases


def in_torch(n: int, device: str = "cpu", steps: int = EPISODE + 1) -> Cases:
    """Return the cases of the PyTorch environment; a call waits for the device to finish."""
    import torch

    from mptc_gym.torch_env import MiddlePointTorchEnv

    torch.set_num_threads(1)  # one core, as for the others
    wait = torch.accelerator.synchronize if device != "cpu" else lambda: None
    cases: Cases = {}
    for special, arguments in PLANTS.items():
        envs = MiddlePointTorchEnv(n, device=device, **arguments)
        envs.reset(seed=0)
        actions = [2.0 * torch.rand(n, 1, device=device) - 1.0 for _ in range(20)]
        run = partial(_cycle, envs.step, actions, steps, wait)
        run()  # the first call on a device is slow
        cases[f"in PyTorch{special}"] = run, n * steps
    return cases


def _cycle(
    step: Callable[[Any], object],
    actions: list[Any],
    steps: int,
    wait: Callable[[], object] = lambda: None,
) -> None:
    for k in range(steps):
        step(actions[k % len(actions)])
    wait()


main = command("speed", Options, work, interrupted="nothing is kept.")

if __name__ == "__main__":
    raise SystemExit(main(None))
