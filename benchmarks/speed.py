"""Compare steps a second with those of Gymnasium's CartPole: `python -m benchmarks.speed`."""

import importlib.util
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import gymnasium
import numpy as np

from benchmarks.lib.command import Runs, blame, command, options
from mptc_gym import PRESETS

EPISODE = 1200  # steps
BATCHES = (1, 8, 64, 1024, 16384)
ON_DEVICE = tuple(4**power for power in range(5, 12))  # 1,024 to 4,194,304 plants
REFERENCE, PLANT = "CartPole-v1", "MiddlePoint-v0"
# By what follows the name.
PLANTS: dict[str, Any] = {"": {}, ", R = 0.5": PRESETS["noisy"], ", hard": PRESETS["hard"]}

Case = tuple[Callable[[], object], int]  # a function, and its steps


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
        for n in ON_DEVICE if options.device else BATCHES:
            cases = {name: stepping(env) for name, env in made(n, options.device).items()}
            print(f"\nn = {n:,}\n{on_screen(compare(cases, options.rounds))}", flush=True)
    return f"Medians of {options.rounds} rounds; in parentheses, 10th to 90th percentile."


def made(n: int, device: str | None) -> dict[str, Any]:
    """Return one environment of each kind or batches of n; on a device, those of PyTorch."""
    if n == 1:
        return {name: gymnasium.make(name) for name in (REFERENCE, PLANT)}
    found: dict[str, Any] = {}
    if device is None:
        make = partial(gymnasium.make_vec, num_envs=n, vectorization_mode="vector_entry_point")
        found = {REFERENCE: make(REFERENCE)}
        found |= {PLANT + name: make(PLANT, **each) for name, each in PLANTS.items()}
    if device or importlib.util.find_spec("torch"):
        import torch

        from mptc_gym.torch_env import MiddlePointTorchEnv

        torch.set_num_threads(1)  # one core, as for the others
        on_device = partial(MiddlePointTorchEnv, n, device=device or "cpu")
        found |= {f"in PyTorch{name}": on_device(**each) for name, each in PLANTS.items()}
    return found


def stepping(envs: Any) -> Case:
    """Return the case of environments: steps and the resets that they need, all awaited."""
    wait: Callable[[], object] = list
    envs.reset(seed=0)
    envs.action_space.seed(0)
    one = isinstance(envs, gymnasium.Env)
    steps = 10 * EPISODE if one else EPISODE + 1
    actions = [envs.action_space.sample() for _ in range(EPISODE if one else 20)]
    if hasattr(envs, "device"):
        import torch

        actions = [torch.as_tensor(each, device=envs.device) for each in actions]
        wait = torch.accelerator.synchronize if envs.device.type != "cpu" else list

    def run() -> None:
        for k in range(steps):
            _, _, terminated, truncated, _ = envs.step(actions[k % len(actions)])
            if one and (terminated or truncated):
                envs.reset()
        wait()

    envs.step(actions[0])  # the first is slow on a device
    return run, steps * (1 if one else envs.num_envs)


def compare(cases: Mapping[str, Case], rounds: int) -> Any:
    """Time cases in turns for some rounds, and return a table with one row for each.

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
