"""PPO and SAC of Stable-Baselines3, all settings at their defaults, on one plant.

`python -m benchmarks.examples.sb3 --algorithm ppo` trains on the environment as
`gymnasium.make` gives it, and shows how far the policy gets: its mean absolute error on the
noise-free square wave, without exploration, every so many steps. Nothing is kept, unless
`--out` names a folder.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import gymnasium
import matplotlib as mpl
import pandas as pd
import torch
from matplotlib.figure import Figure
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from agents import PIController
from benchmarks.lib.drawing import STYLE, colours, save
from benchmarks.lib.storage import replacing
from benchmarks.metrics import METRICS, mean_error
from benchmarks.rollout import Agent, make_plants, rollout
from benchmarks.train.ppo import PolicyController
from mptc_gym import Parameters

ALGORITHMS: dict[str, type[BaseAlgorithm]] = {"ppo": PPO, "sac": SAC}
OBSERVATION = {"action_window": Parameters().delay + 2}  # with them the problem is Markov
SAMPLES = 1200  # two periods of the square wave
DOING_NOTHING = Parameters().setpoint_amplitude  # y stays 0, so |e| is the set point's
POSSIBLE = 0.907  # degC, the least of any controller, by `python -m benchmarks.limits`
NAME = "default_sb3"


class Evaluation(BaseCallback):
    """Measures the policy now and then, and prints the mean |e|.

    Parameters
    ----------
    interval
        Steps from one time to the next.
    start
        What each row begins with.
    """

    def __init__(self, interval: int, start: dict[str, Any]) -> None:
        super().__init__()
        self.rows: list[dict[str, Any]] = []
        self._interval = interval
        self._start = start
        self._since = time.perf_counter()

    def _on_step(self) -> bool:
        if self.num_timesteps % self._interval == 0:
            row = {
                "steps": self.num_timesteps,
                "mae": square_error(PolicyController(self.model), **OBSERVATION),
                "seconds": round(time.perf_counter() - self._since, 1),
            }
            self.rows.append(self._start | row)
            print(*(f"{name} {value}" for name, value in self.rows[-1].items()), flush=True)
        return True


def square_error(agent: Agent, **arguments: Any) -> float:
    """Return the mean |e| of a controller on the noise-free square wave, degC."""
    plants = make_plants(1, SAMPLES, **arguments)
    return float(mean_error(rollout(plants, agent, SAMPLES, seed=0))[0])


def train(
    algorithm: str, steps: int, seed: int, interval: int, arguments: dict[str, Any]
) -> pd.DataFrame:
    """Train one policy.

    Parameters
    ----------
    algorithm
        A name of `ALGORITHMS`.
    steps
        Samples of experience.
    seed
        Of the policy, the exploration and the plant.
    interval
        Steps from one evaluation to the next.
    arguments
        Of the environment that it is trained on; the default square wave tests it all the same.

    Returns
    -------
    DataFrame
        The learning curve, a row an evaluation.
    """
    plant = gymnasium.make("MiddlePoint-v0", **OBSERVATION, **arguments)
    model = ALGORITHMS[algorithm]("MlpPolicy", plant, seed=seed, device="cpu")
    start = {"algorithm": algorithm, "arguments": json.dumps(arguments), "seed": seed}
    evaluation = Evaluation(interval, start)
    model.learn(steps, callback=evaluation)
    return pd.DataFrame(evaluation.rows)


def add(curves: pd.DataFrame, path: Path) -> None:
    """Put curves into a CSV file, in place of the same ones that it may hold."""
    key = ["algorithm", "arguments", "seed", "steps"]
    if path.exists():
        curves = pd.concat([pd.read_csv(path), curves]).drop_duplicates(key, keep="last")
    with replacing(path) as partial:
        curves.sort_values(key).to_csv(partial, index=False)


def plot(curves: pd.DataFrame, path: Path) -> None:
    """Draw the median and the range of the seeds over the steps, one line a case."""
    cases = {
        ", ".join([name.upper(), *(f"{k} {v}" for k, v in json.loads(given).items())]): rows
        for (name, given), rows in curves.groupby(["algorithm", "arguments"], sort=False)
    }
    limits = {
        "doing nothing": (DOING_NOTHING, ":"),
        "the paper's PI": (square_error(PIController()), "--"),
        "least possible": (POSSIBLE, "-"),
    }
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9, 4.5))
        axes = figure.subplots()
        palette = colours(list(cases))
        for name, rows in cases.items():
            each = rows.groupby("steps")["mae"].agg(["median", "min", "max", "count"])
            seeds = int(each["count"].max())
            each = each[each["count"] == seeds]  # while all of them go on
            thousands = each.index / 1000
            axes.fill_between(
                thousands, each["min"], each["max"], color=palette[name], alpha=0.2, linewidth=0
            )
            axes.plot(
                thousands, each["median"], color=palette[name],
                label=f"{name} ({seeds} seed{'s' * (seeds > 1)})",
            )  # fmt: skip
        for name, (error, line) in limits.items():
            axes.axhline(error, color="0.4", linewidth=1, linestyle=line, label=name)
        axes.set_ylim(bottom=0)
        axes.set_xlim(left=0)
        axes.set_xlabel("samples of experience (thousands)")
        axes.set_ylabel(METRICS["mae"])
        axes.set_title(
            "Stable-Baselines3 as it comes, square wave, median and range", loc="left"
        )
        axes.legend(loc="upper right", bbox_to_anchor=(1.0, 0.9), ncols=2)
        save(figure, path)


def argument(text: str) -> tuple[str, Any]:
    """Read NAME=VALUE; a value that is not JSON is taken as text."""
    name, equals, value = text.partition("=")
    if not equals:
        raise argparse.ArgumentTypeError(f"must be NAME=VALUE, got {text!r}")
    try:
        return name, json.loads(value)
    except json.JSONDecodeError:
        return name, value


def main(arguments: list[str] | None = None) -> int:
    """Train, and print how far it got.

    Parameters
    ----------
    arguments
        The command line without the program's name.

    Returns
    -------
    int
        0.
    """
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.examples.sb3",
        description=__doc__,
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--algorithm", choices=ALGORITHMS, default="ppo", help="what learns")
    parser.add_argument("--steps", type=int, default=300_000, help="a seed")
    parser.add_argument("--seed", type=int, default=0, help="the first seed")
    parser.add_argument("--seeds", type=int, default=1, help="how many")
    parser.add_argument(
        "--interval", type=int, default=20_000, help="steps between evaluations"
    )
    parser.add_argument(
        "--env", type=argument, nargs="*", default=[], metavar="NAME=VALUE",
        help="arguments of the environment that is trained on",
    )  # fmt: skip
    parser.add_argument("--out", type=Path, help=f"folder of {NAME}.csv and {NAME}.png")
    parser.add_argument("--plot", action="store_true", help="train nothing, only draw --out")
    options = parser.parse_args(arguments)
    if options.plot and not options.out:
        parser.error("--plot needs --out")

    torch.set_num_threads(1)  # the networks are too small for more
    if not options.plot:
        for seed in range(options.seed, options.seed + options.seeds):
            curve = train(
                options.algorithm, options.steps, seed, options.interval, dict(options.env)
            )
            if options.out:
                add(curve, options.out / f"{NAME}.csv")
    if options.out:
        plot(pd.read_csv(options.out / f"{NAME}.csv"), options.out / f"{NAME}.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
