"""Compare steps a second with those of Gymnasium's CartPole: `python -m benchmarks.speed`."""

import importlib.util
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

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


class Case(NamedTuple):
    """What is timed: a function, and the number of steps that it makes."""

    run: Callable[[], object]
    steps: int


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Compare the steps a second of the environments with those of CartPole.

    The cases of a table are timed in turns. A ratio compares two cases of the same round.
    """

    rounds: Runs = 15
    """Number of measurements of each case."""
    device: str | None = None
    """Measure only the PyTorch environment, on this device, such as cuda."""


def work(options: Options) -> str:
    """Measure, print the tables and return the closing line."""
    from benchmarks.lib.report import on_screen

    numbers_of_plants = ON_DEVICE if options.device else BATCHES
    with blame("--device"):
        for n in numbers_of_plants:
            environments = make_environments(n, options.device)
            cases = {name: stepping(envs) for name, envs in environments.items()}
            print(f"\nn = {n:,}\n{on_screen(compare(cases, options.rounds))}", flush=True)
    return f"Medians of {options.rounds} rounds; in parentheses, 10th to 90th percentile."


def make_environments(n: int, device: str | None) -> dict[str, Any]:
    """Return environments with n plants by their names in the table.

    Without a device, these are CartPole and the plants in NumPy and, if PyTorch is installed,
    in PyTorch. With a device, these are the plants in PyTorch alone.
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

        torch.set_num_threads(1)  # one core, as for the NumPy environments
        for name, arguments in PLANTS.items():
            plants = MiddlePointTorchEnv(n, device=device or "cpu", **arguments)
            environments[f"in PyTorch{name}"] = plants
    return environments


def stepping(envs: Any) -> Case:
    """Return a case that steps one environment, or a vector environment, and resets it.

    A single environment is stepped for ten episodes of the plant, and reset after each of its
    episodes; a vector environment resets itself. The function of the case returns when the
    device has finished.
    """
    is_single = isinstance(envs, gymnasium.Env)
    if is_single:
        plants = 1
        steps = 10 * EPISODE
        distinct_actions = EPISODE
    else:
        plants = envs.num_envs
        steps = EPISODE + 1  # the episode, and the reset after it
        distinct_actions = 20
    envs.reset(seed=0)
    envs.action_space.seed(0)
    actions = [envs.action_space.sample() for _ in range(distinct_actions)]
    device = getattr(envs, "device", None)
    if device is not None:
        import torch

        actions = [torch.as_tensor(action, device=device) for action in actions]

    def run() -> None:
        for k in range(steps):
            _, _, terminated, truncated, _ = envs.step(actions[k % len(actions)])
            if is_single and (terminated or truncated):
                envs.reset()
        if device is not None and device.type != "cpu":
            torch.accelerator.synchronize()

    envs.step(actions[0])  # The first step is slow on a device.
    return Case(run, steps * plants)


def compare(cases: Mapping[str, Case], rounds: int) -> Any:
    """Time cases in turns for some rounds, and return a table of text with a row for each case.

    The ratio compares the steps a second of a case with those of the first case in the same
    round.
    """
    import pandas as pd  # here, as in all commands: it would slow the help down

    seconds = []
    for _ in range(rounds):
        times = [time.perf_counter()]
        for case in cases.values():
            case.run()
            times.append(time.perf_counter())
        seconds.append(np.diff(times))
    steps = [case.steps for case in cases.values()]
    rates = pd.DataFrame(steps / np.array(seconds), columns=[*cases])
    first = rates.columns[0]
    ratios = rates.div(rates[first], axis="index").quantile([0.1, 0.5, 0.9])
    texts = ratios.map("{:.2f}".format)
    table = {
        "steps a second": rates.median().map("{:,.0f}".format),
        f"ratio to {first}": texts.loc[0.5]
        + " ("
        + texts.loc[0.1]
        + " to "
        + texts.loc[0.9]
        + ")",
    }
    return pd.DataFrame(table).reset_index(names="case")


main = command("speed", Options, work)

if __name__ == "__main__":
    raise SystemExit(main(None))
