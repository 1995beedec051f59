"""Compare steps a second with those of Gymnasium's CartPole: `python -m benchmarks.speed`."""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np

from benchmarks.lib.command import Runs, blame, command, options
from mptc_gym import PRESETS

if TYPE_CHECKING:
    import pandas as pd

EPISODE = 1200  # steps
BATCHES = (8, 64, 1024, 16384)
ON_DEVICE = tuple(4**power for power in range(5, 12))  # 1,024 to 4,194,304 plants
REFERENCE, PLANT = "CartPole-v1", "MiddlePoint-v0"
# By what follows the name.
PLANTS: dict[str, Any] = {"": {}, ", R = 0.5": PRESETS["noisy"], ", hard": PRESETS["hard"]}

Case = tuple[Callable[[], object], int]  # a function, and its steps
Cases = dict[str, Case]  # by name


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
        for n in ON_DEVICE if options.device else (1, *BATCHES):
            title = "One environment, from gymnasium.make"
            if n > 1:
                title = f"Vector environments, n = {n:,}"
            cases = one_by_one() if n == 1 else in_batch(n, options.device)
            print(f"\n{title}\n{on_screen(compare(cases, options.rounds))}", flush=True)
    return f"Medians of {options.rounds} rounds; in parentheses, 10th to 90th percentile."


def one_by_one() -> Cases:
    """Return the cases of one environment, reset whenever an episode ends."""

    def run(env: Any, actions: list[Any]) -> None:
        env.reset(seed=0)
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()

    cases: Cases = {}
    for name in (REFERENCE, PLANT):
        env = gymnasium.make(name)
        env.action_space.seed(0)
        actions = [env.action_space.sample() for _ in range(10 * EPISODE)]
        cases[name] = partial(run, env, actions), len(actions)
    return cases


def in_batch(n: int, device: str | None) -> Cases:
    """Return the cases of `n` environments; those of a device are PyTorch's alone."""
    made: dict[str, Any] = {}
    if device is None:
        make = partial(gymnasium.make_vec, num_envs=n, vectorization_mode="vector_entry_point")
        made = {REFERENCE: make(REFERENCE)}
        made |= {PLANT + name: make(PLANT, **each) for name, each in PLANTS.items()}
    if device or importlib.util.find_spec("torch"):
        import torch

        from mptc_gym.torch_env import MiddlePointTorchEnv

        torch.set_num_threads(1)  # one core, as for the others
        on_device = partial(MiddlePointTorchEnv, n, device=device or "cpu")
        made |= {f"in PyTorch{name}": on_device(**each) for name, each in PLANTS.items()}
    return {name: stepping(envs) for name, envs in made.items()}


def stepping(envs: Any) -> Case:
    """Return the case of a vector environment: an episode and its reset, all awaited."""
    envs.reset(seed=0)
    envs.action_space.seed(0)
    actions = [envs.action_space.sample() for _ in range(20)]
    wait: Callable[[], object] = list
    if hasattr(envs, "device"):
        import torch

        actions = [torch.as_tensor(each, device=envs.device) for each in actions]
        wait = torch.accelerator.synchronize if envs.device.type != "cpu" else list

    def run() -> None:
        for k in range(EPISODE + 1):
            envs.step(actions[k % len(actions)])
        wait()

    envs.step(actions[0])  # the first is slow on a device
    return run, envs.num_envs * (EPISODE + 1)


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


main = command("speed", Options, work)

if __name__ == "__main__":
    raise SystemExit(main(None))
