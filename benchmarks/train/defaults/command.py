"""Stable-Baselines3 with all its settings at their defaults, on one plant.

`python -m benchmarks.train.defaults` trains PPO on the plant of `benchmarks/examples/sb3.py`,
and shows how far it gets: its mean absolute error on the noise-free square wave, without
exploration, every so many samples. Without `--out` nothing is kept. With it, seeds that the
folder holds are not trained again.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium
import matplotlib as mpl
import numpy as np
import pandas as pd
import torch
from gymnasium.vector import VectorEnv
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.console import Console
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from agents import PIController
from benchmarks.lib.command_line import UsageError, out_folder
from benchmarks.lib.drawing import STYLE, colours, save
from benchmarks.lib.tables import write_csv
from benchmarks.loop.metrics import METRICS, mean_error
from benchmarks.loop.rollout import Agent, make_plants, rollout
from benchmarks.train.defaults.options import Options
from mptc_gym import Parameters
from mptc_gym.wrappers import IncrementalAction
from mptc_gym.wrappers.vector import IncrementalAction as VectorIncrementalAction

OBSERVATION: dict[str, Any] = {"action_window": 20}  # delay + 2: the problem is Markov
SAMPLES = 1200  # two periods of the square wave
DOING_NOTHING = Parameters().setpoint_amplitude  # y stays 0, so |e| is the set point's
POSSIBLE = 0.911  # degC, the least of any controller, by `python -m benchmarks.limits`
NAME = "sb3_defaults"


@dataclass(frozen=True)
class Case:
    """Something to learn with, and the plant that it learns on.

    Attributes
    ----------
    title
        For the legend.
    algorithm
        Of Stable-Baselines3.
    arguments
        Of the environment trained on, other than `OBSERVATION`; the square wave tests it all
        the same.
    wrapper
        Arguments of `IncrementalAction`; without them it is left out.
    """

    title: str
    algorithm: type[PPO | SAC]
    arguments: dict[str, Any] = field(default_factory=dict)
    wrapper: dict[str, Any] = field(default_factory=dict)

    def train_on(self) -> gymnasium.Env[Any, Any]:
        """Return the plant to train on."""
        plant = gymnasium.make("MiddlePoint-v0", **OBSERVATION, **self.arguments)
        return IncrementalAction(plant, **self.wrapper) if self.wrapper else plant

    def test_on(self) -> VectorEnv[Any, Any, Any]:
        """Return the noise-free square wave, a batch of one."""
        plant = make_plants(1, SAMPLES, **OBSERVATION)
        return VectorIncrementalAction(plant, **self.wrapper) if self.wrapper else plant


CASES = {
    "ppo-velocity": Case(
        "PPO, velocity form",
        PPO,
        {"setpoint": "random", "setpoint_amplitude": 6.0, "reward": "absolute"},
        {"max_move": 0.4, "undo_dead_zone": True},
    ),
    "ppo": Case("PPO, the environment as it comes", PPO),
    "sac": Case("SAC, the environment as it comes", SAC),
}


class PolicyController:
    """A policy as a controller; it takes the mean of the policy's distribution."""

    def __init__(self, model: BaseAlgorithm) -> None:
        self._model = model

    def reset(self) -> None:
        """Do nothing: the observation holds all that the policy remembers."""

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return actions, shape (runs, 1), for observations, shape (runs, n_obs)."""
        actions, _ = self._model.predict(observation, deterministic=True)
        return actions


class Evaluation(BaseCallback):
    """Measures the policy now and then, and prints the mean |e|.

    Parameters
    ----------
    name
        Of the case.
    seed
        Of the training.
    interval
        Samples from one time to the next.
    out
        The file that each row is added to, if any.
    """

    def __init__(self, name: str, seed: int, interval: int, out: Path | None) -> None:
        super().__init__()
        self._name, self._seed = name, seed
        self._interval = interval
        self._out = out
        self._since = time.process_time()

    def _on_step(self) -> bool:
        if self.num_timesteps % self._interval == 0:
            plant = CASES[self._name].test_on()
            row = {
                "case": self._name,
                "seed": self._seed,
                "steps": self.num_timesteps,
                "mae": square_error(PolicyController(self.model), plant),
                "seconds": round(time.process_time() - self._since, 1),
            }
            print(*(f"{name} {value}" for name, value in row.items()), flush=True)
            if self._out:
                add(pd.DataFrame([row]), self._out)
        return True


def square_error(agent: Agent, plant: VectorEnv[Any, Any, Any]) -> float:
    """Return the mean |e| of a controller in one run, degC."""
    return float(mean_error(rollout(plant, agent, SAMPLES, seed=0))[0])


def train(name: str, steps: int, seed: int, interval: int, out: Path | None) -> PPO | SAC:
    """Train one policy, and measure it on the way.

    Parameters
    ----------
    name
        Of the case.
    steps
        Samples of experience.
    seed
        Of the policy, the exploration and the plant.
    interval
        Samples from one evaluation to the next.
    out
        The file that the learning curve is added to, if any.
    """
    case = CASES[name]
    model = case.algorithm("MlpPolicy", case.train_on(), seed=seed, device="cpu")
    return model.learn(steps, callback=Evaluation(name, seed, interval, out))


def add(rows: pd.DataFrame, path: Path) -> None:
    """Put rows into a CSV file, in place of the same ones that it may hold."""
    key = ["case", "seed", "steps"]
    if path.exists():
        rows = pd.concat([pd.read_csv(path), rows]).drop_duplicates(key, keep="last")
    write_csv(path, rows.sort_values(key))


def is_done(name: str, steps: int, seed: int, path: Path) -> bool:
    """Say whether a CSV file holds a learning curve to its end."""
    if not path.exists():
        return False
    rows = pd.read_csv(path)
    rows = rows[(rows["case"] == name) & (rows["seed"] == seed)]
    return not rows.empty and bool(rows["steps"].max() >= steps)


def plot(curves: pd.DataFrame, path: Path) -> None:
    """Draw the median and the range of the seeds over the samples, one line a case."""
    limits = {
        "doing nothing": (DOING_NOTHING, ":"),
        "the paper's PI": (square_error(PIController(), make_plants(1, SAMPLES)), "--"),
        "least possible": (POSSIBLE, "-"),
    }
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9, 4.5))
        axes = figure.subplots()
        names = [name for name in CASES if name in set(curves["case"])]
        palette = colours(names)
        for name in names:
            rows = curves[curves["case"] == name]
            each = rows.groupby("steps")["mae"].agg(["median", "min", "max", "count"])
            seeds = int(each["count"].max())
            each = each[each["count"] == seeds]  # while all of them go on
            thousands = each.index / 1000
            axes.fill_between(
                thousands, each["min"], each["max"], color=palette[name], alpha=0.2, linewidth=0
            )
            axes.plot(
                thousands, each["median"], color=palette[name],
                label=f"{CASES[name].title} ({seeds} seed{'s' * (seeds > 1)})",
            )  # fmt: skip
        for name, (error, line) in limits.items():
            axes.axhline(error, color="0.4", linewidth=1, linestyle=line, label=name)
        axes.set_ylim(bottom=0)
        axes.set_xlim(left=0)
        axes.set_xlabel("samples of experience (thousands)")
        axes.set_ylabel(METRICS["mae"])
        axes.set_title("Default settings, square wave: median and range of seeds", loc="left")
        axes.legend(loc="upper right", bbox_to_anchor=(1.0, 0.9), ncols=2)
        save(figure, path)


def execute(options: Options, _console: Console) -> str:
    """Train, and print how far it got."""
    if options.plot and not options.out:
        raise UsageError("--plot needs --out")
    torch.set_num_threads(1)  # the networks are too small for more
    table = out_folder(options.out) / f"{NAME}.csv" if options.out else None
    if options.plot and table and not table.exists():
        raise UsageError(f"--out: {table} is missing, so that --plot has nothing to draw")
    if not options.plot:
        for seed in range(options.seed, options.seed + options.seeds):
            if not (table and is_done(options.case, options.steps, seed, table)):
                train(options.case, options.steps, seed, options.interval, table)
    if not table:
        return "Nothing was kept: --out names a folder."
    if not table.exists():
        return "Nothing was kept: no test came before the end, see --interval and --steps."
    plot(pd.read_csv(table), table.with_suffix(".png"))
    return f"Written to {options.out}"
