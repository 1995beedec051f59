"""How fast the environment steps and imports, beside others: `python -m benchmarks.speed`.

What is compared is measured alternately in one run and reported as a ratio, with its spread.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pandas as pd
from rich.console import Console
from tqdm import tqdm

import mptc_gym  # noqa: F401 (registers the environment)
from benchmarks.tables import on_screen

ROUNDS = 15
STEPS = 20_000

REFERENCE = "CartPole-v1"
ENVIRONMENTS: dict[str, tuple[str, dict[str, Any]]] = {
    REFERENCE: ("CartPole-v1", {}),
    "Pendulum-v1": ("Pendulum-v1", {}),
    "MiddlePoint-v0": ("MiddlePoint-v0", {}),
    "MiddlePoint-v0, R = 0.5": ("MiddlePoint-v0", {"noise_variance": 0.5}),
    "MiddlePoint-v0, 20 past actions": ("MiddlePoint-v0", {"action_window": 20}),
}


def main(arguments: list[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.speed", description=__doc__)
    parser.add_argument("--rounds", type=int, default=ROUNDS, help="measurements of each")
    rounds = parser.parse_args(arguments).rounds

    steppers = {name: _stepper(*made) for name, made in ENVIRONMENTS.items()}
    seconds = _alternately(steppers, rounds, "stepping")
    table = pd.DataFrame(
        {
            "environment": list(steppers),
            "steps a second": [f"{STEPS / np.median(seconds[name]):,.0f}" for name in steppers],
            f"ratio to {REFERENCE}": [
                _ratio(seconds[REFERENCE] / seconds[name]) for name in steppers
            ],
        }
    )
    imports = {
        module: (lambda module=module: _import(module)) for module in ("gymnasium", "mptc_gym")
    }
    taken = 1000 * pd.DataFrame(_alternately(imports, rounds, "importing"))
    more = taken["mptc_gym"] - taken["gymnasium"]

    console = Console()
    title = f"gymnasium.make, random actions, resets included: median of {rounds} rounds"
    console.print(title)
    console.print(on_screen(table))
    console.print(
        f"import gymnasium: {taken['gymnasium'].median():.0f} ms; import mptc_gym: "
        f"{more.median():+.0f} ms ({more.quantile(0.1):+.0f} to {more.quantile(0.9):+.0f})"
    )


def _alternately(
    measured: dict[str, Callable[[], None]], rounds: int, title: str
) -> dict[str, np.ndarray[Any, np.dtype[np.float64]]]:
    """Time each in turn, round after round, in seconds."""
    seconds: dict[str, list[float]] = {name: [] for name in measured}
    for _ in tqdm(range(rounds), desc=title):
        for name, function in measured.items():
            began = time.perf_counter()
            function()
            seconds[name].append(time.perf_counter() - began)
    return {name: np.array(values) for name, values in seconds.items()}


def _ratio(values: np.ndarray[Any, np.dtype[np.float64]]) -> str:
    low, median, high = np.percentile(values, [10, 50, 90])
    return f"{median:.2f} ({low:.2f} to {high:.2f})"


def _stepper(name: str, arguments: dict[str, Any]) -> Callable[[], None]:
    env = gymnasium.make(name, **arguments)
    env.reset(seed=0)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(STEPS)]

    def step() -> None:
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()

    return step


def _import(module: str) -> None:
    subprocess.run([sys.executable, "-c", f"import {module}"], check=True)


if __name__ == "__main__":
    main()
