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
# Arguments of the measured plants, by the end of their names in the table.
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
            environments = make_environments(n, options.device)
            cases = {name: stepping(envs) for name, envs in environments.items()}
            print(f"\nn = {n:,}\n{on_screen(compare(cases, options.rounds))}", flush=True)
    return f"Medians of {options.rounds} rounds; in parentheses, 10th to 90th percentile."


def make_environments(n: int, device: str | None) -> dict[str, Any]:
    """Return environments with n plants by their names in the table.

    Without a device, these are CartPole and the plants in NumPy and, if it is installed, in
    PyTorch. With a device, these are the plants in PyTorch alone.
    """
    if n == 1:
        return {name: gymnasium.make(name) for name in (REFERENCE, PLANT)}
    environments: dict[str, Any] = {}
    if device is None:
        make = partial(gymnasium.make_vec, num_envs=n, vectorization_mode="vector_entry_point")
        environments[REFERENCE] = make(REFERENCE)
        for name, arguments in PLANTS.items():
            environments[PLANT + name] = make(PLANT, **arguments)
    if device or importlib.util.find_spec("torch"):
        import torch

        from mptc_gym.torch_env import MiddlePointTorchEnv

        torch.set_num_threads(1)  # one core, as for the others
        make_on_device = partial(MiddlePointTorchEnv, n, device=device or "cpu")
        for name, arguments in PLANTS.items():
            environments[f"in PyTorch{name}"] = make_on_device(**arguments)
    return environments


def stepping(envs: Any) -> Case:
    """Return a case: a function that steps the environments and resets them where needed.

    The function returns when the device has finished.
    """
    is_single = isinstance(envs, gymnasium.Env)
    if is_single:
        steps = 10 * EPISODE
        distinct_actions = EPISODE
        plants = 1
    else:
        steps = EPISODE + 1  # and the reset after an episode
        distinct_actions = 20
        plants = envs.num_envs
    envs.reset(seed=0)
    envs.action_space.seed(0)
    actions = [envs.action_space.sample() for _ in range(distinct_actions)]
    wait: Callable[[], object] = list  # does nothing
    if hasattr(envs, "device"):
        import torch

        actions = [torch.as_tensor(action, device=envs.device) for action in actions]
        if envs.device.type != "cpu":
            wait = torch.accelerator.synchronize

    def run() -> None:
        for k in range(steps):
            _, _, terminated, truncated, _ = envs.step(actions[k % len(actions)])
            if is_single and (terminated or truncated):
                envs.reset()
        wait()

    envs.step(actions[0])  # the first is slow on a device
    return run, steps * plants


def compare(cases: Mapping[str, Case], rounds: int) -> Any:
    """Time cases in turns for some rounds, and return a table with one row for each.

    The ratio compares a case's steps a second with those of the first case in the same round.
    """
    import pandas as pd  # here, as in all commands: it would slow the help down

    seconds = []
    for _ in range(rounds):
        times = [time.perf_counter()]
        for run, _ in cases.values():
            run()
            times.append(time.perf_counter())
        seconds.append(np.diff(times))
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
