"""Compare the speed of the environments with that of CartPole: `python -m benchmarks.speed`."""

import importlib.util
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import gymnasium
import numpy as np

from benchmarks.lib.command import CommandError, Count, command, options
from mptc_gym import PRESETS

EPISODE = 1200  # number of steps in an episode of the plant
BATCHES = (1, 8, 64, 1024, 16384)  # numbers of plants that are stepped together
# Numbers of plants with the option --device: 1,024 to 4,194,304.
ON_DEVICE = tuple(4**power for power in range(5, 12))
REFERENCE, PLANT = "CartPole-v1", "MiddlePoint-v0"
# Arguments of the environment for the measured plants. Each key is the end of a plant's name in
# the table.
PLANTS: dict[str, Any] = {"": {}, ", R = 0.5": PRESETS["noisy"], ", hard": PRESETS["hard"]}


class Case(NamedTuple):
    """A function that steps an environment, and the number of steps in each call of it."""

    run: Callable[[], object]  # steps an environment
    steps: int  # number of steps in a call of `run`, summed over all plants


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Compare the steps a second of the environments with those of Gymnasium's CartPole.

    In each round, all environments are timed once. The printed ratio is the median, over all
    rounds, of the speed divided by the speed of CartPole in the same round. With --device, the
    ratio is that to the speed of the paper's plant in PyTorch.
    """

    rounds: Count = 15
    """The number of measurements of each case."""
    device: str | None = None
    """Measure only the PyTorch environment, on this device, such as cuda."""


def work(options: Options) -> None:
    """Measure speeds, and print a table for each number of plants."""
    from benchmarks.lib.report import on_screen

    numbers_of_plants = ON_DEVICE if options.device else BATCHES
    for n in numbers_of_plants:
        try:
            environments = make_environments(n, options.device)
        except ValueError as error:
            raise CommandError(f"--device: {error}") from error
        cases = {name: stepping(env) for name, env in environments.items()}
        table = on_screen(compare(cases, options.rounds))
        print(f"\nn = {n:,}\n{table}", flush=True)
    print(f"Medians of {options.rounds} rounds; in parentheses, 10th to 90th percentile.")


def make_environments(n: int, device: str | None) -> dict[str, Any]:
    """Return the environments to measure, each with n plants, by their names in the table.

    If `n` is 1, the environments are CartPole and the paper's plant. If `device` is None and n
    is above 1, the environments are CartPole, the plants in NumPy and, if PyTorch is installed,
    the plants in PyTorch on the CPU. If `device` is the name of a device, such as "cuda", and n
    is above 1, the environments are the plants in PyTorch on this device.
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


def stepping(env: Any) -> Case:
    """Return a `Case` that steps an environment with random actions.

    A vector environment, which resets itself, makes `EPISODE` + 1 steps. A single environment
    makes 10 times `EPISODE` steps, and is reset when an episode has ended.

    Parameters
    ----------
    env
        Environment to step: a Gymnasium environment, a Gymnasium vector environment, or a
        `MiddlePointTorchEnv`.
    """
    is_single = isinstance(env, gymnasium.Env)
    if is_single:
        plants = 1
        steps = 10 * EPISODE
        distinct_actions = EPISODE
    else:
        plants = env.num_envs
        steps = EPISODE + 1  # the episode, and the reset after it
        distinct_actions = 20
    env.reset(seed=0)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(distinct_actions)]
    device = getattr(env, "device", None)  # None if the environment uses NumPy
    if device is not None:
        import torch

        actions = [torch.as_tensor(action, device=device) for action in actions]

    def run() -> None:
        """Step the environment `steps` times."""
        for k in range(steps):
            _, _, terminated, truncated, _ = env.step(actions[k % distinct_actions])
            if is_single and (terminated or truncated):
                env.reset()
        if device is not None and device.type != "cpu":
            torch.accelerator.synchronize()  # A GPU may not have finished all steps yet.

    env.step(actions[0])  # The first step on a GPU is slow.
    return Case(run, steps * plants)


def compare(cases: Mapping[str, Case], rounds: int) -> Any:
    """Measure the speed of each case in `rounds` rounds, and return a DataFrame of text.

    Each case is timed once in each round. A row of the DataFrame has the name of a case, the
    median of the steps per second, and the ratio to the speed of the first case. The ratio is
    computed in each round, and the row has the median over the rounds, with the 10th and the
    90th percentile in parentheses.
    """
    import pandas as pd  # imported here, as pandas would slow `--help` down

    seconds = []  # for each round, an array with the duration of each case, s
    for _ in range(rounds):
        times = [time.perf_counter()]
        for case in cases.values():
            case.run()
            times.append(time.perf_counter())
        seconds.append(np.diff(times))
    steps = [case.steps for case in cases.values()]
    rates = pd.DataFrame(steps / np.array(seconds), columns=[*cases])
    reference = rates.columns[0]
    ratios = rates.div(rates[reference], axis="index")
    low, median, high = ratios.quantile([0.1, 0.5, 0.9]).to_numpy()
    table = pd.DataFrame({"case": [*cases]})
    table["steps a second"] = [f"{rate:,.0f}" for rate in rates.median()]
    table[f"ratio to {reference}"] = [
        f"{median[i]:.2f} ({low[i]:.2f} to {high[i]:.2f})" for i in range(len(cases))
    ]
    return table


main = command("speed", Options, work)

if __name__ == "__main__":
    raise SystemExit(main())
