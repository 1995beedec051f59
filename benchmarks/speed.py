"""Compare the speed of the environments with that of CartPole: `python -m benchmarks.speed`."""

import time
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from benchmarks.lib.command import Count, command, options
from mptc_gym import PRESETS

STEPS = 1201  # steps of a vector environment in a measurement: an episode, and a reset after it
SINGLE_STEPS = 12_000  # steps of a single environment in a measurement
BATCHES = (1, 8, 64, 1024, 16384)  # numbers of plants that are stepped together
# Numbers of plants with the option --device: 1,024 to 4,194,304.
ON_DEVICE = tuple(4**power for power in range(5, 12))
REFERENCE, PLANT = "CartPole-v1", "MiddlePoint-v0"
# Arguments of the environment for the measured plants. Each key is the ending of a plant's name
# in the table, such as ", hard" in "MiddlePoint-v0, hard".
PLANTS: dict[str, Any] = {"": {}, ", R = 0.5": PRESETS["noisy"], ", hard": PRESETS["hard"]}


@options
@dataclass(frozen=True, kw_only=True)
class Options:
    """Compare the steps per second of the environments with those of Gymnasium's CartPole.

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
    for n in ON_DEVICE if options.device else BATCHES:
        environments = make_environments(n, options.device)
        rates = [
            [steps_per_second(env) for env in environments.values()]
            for _ in range(options.rounds)
        ]
        print(f"\nn = {n:,}\n{table(list(environments), np.array(rates))}", flush=True)
    print(f"Medians of {options.rounds} rounds; in parentheses, 10th to 90th percentile.")


def make_environments(n: int, device: str | None) -> dict[str, Any]:
    """Return the environments to measure, each with n plants, by their names in the table.

    If `n` is 1, the environments are CartPole and the paper's plant. If `device` is None and n
    is above 1, the environments are CartPole, and the plants in NumPy and in PyTorch on the
    CPU. If `device` is the name of a device, such as "cuda", the environments are the plants in
    PyTorch on this device.
    """
    if n == 1:
        return {name: gymnasium.make(name) for name in (REFERENCE, PLANT)}
    import torch  # imported here, as it would slow `--help` down

    from mptc_gym.torch_env import MiddlePointTorchEnv

    torch.set_num_threads(1)  # one core, as for the NumPy environments
    environments: dict[str, Any] = {}
    if device is None:
        # CartPole's own NumPy implementation of many environments, not n single environments.
        mode = "vector_entry_point"
        environments[REFERENCE] = gymnasium.make_vec(REFERENCE, n, vectorization_mode=mode)
        for ending, arguments in PLANTS.items():
            environments[PLANT + ending] = gymnasium.make_vec(PLANT, n, **arguments)
    for ending, arguments in PLANTS.items():
        plants = MiddlePointTorchEnv(n, device=device or "cpu", **arguments)
        environments[f"in PyTorch{ending}"] = plants
    return environments


def steps_per_second(env: Any) -> float:
    """Step an environment with random actions, and return the steps of all plants per second.

    `env` is a Gymnasium environment, a vector environment, or a `MiddlePointTorchEnv`.
    """
    is_single = isinstance(env, gymnasium.Env)
    steps = SINGLE_STEPS if is_single else STEPS
    env.reset(seed=0)
    env.action_space.seed(0)
    # Few actions, used again and again, so that sampling takes no time of the measurement.
    actions = [env.action_space.sample() for _ in range(20)]
    device = getattr(env, "device", None)  # None if the environment uses NumPy
    if device is not None:
        import torch

        actions = [torch.as_tensor(action, device=device) for action in actions]
    env.step(actions[0])  # The first step on a GPU is slow.
    start = time.perf_counter()
    for k in range(steps):
        _, _, terminated, truncated, _ = env.step(actions[k % 20])
        if is_single and (terminated or truncated):
            env.reset()
    if device is not None and device.type != "cpu":
        torch.accelerator.synchronize()  # A GPU may not have finished all steps yet.
    return float(steps * getattr(env, "num_envs", 1) / (time.perf_counter() - start))


def table(names: list[str], rates: NDArray[np.float64]) -> str:
    """Return a table of the steps per second of environments, as text.

    `rates` has the steps per second in each round, shape (rounds, environments). The ratio to
    the speed of the first environment is computed in each round. The table has the median over
    the rounds, with the 10th and the 90th percentile in parentheses.
    """
    ratios = rates / rates[:, :1]  # to the first environment
    lines = [f"{'case':<22}{'steps per second':>16}  ratio to {names[0]}"]
    for i, name in enumerate(names):
        low, median, high = np.quantile(ratios[:, i], [0.1, 0.5, 0.9])
        speed = f"{name:<22}{np.median(rates[:, i]):>16,.0f}"
        lines.append(f"{speed}  {median:.2f} ({low:.2f} to {high:.2f})")
    return "\n".join(lines)


main = command("speed", Options, work)

if __name__ == "__main__":
    raise SystemExit(main())
