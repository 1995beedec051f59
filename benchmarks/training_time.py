"""How soon PPO reaches a given quality, by how its plants are run.

`python -m benchmarks.training_time` trains until the mean absolute error on the noise-free
square wave is at most 1.2 degC: with one plant after the other, as Stable-Baselines3 does by
default, and with a batch of them at once, of several sizes.
"""

from __future__ import annotations

import math
import sys
import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pandas as pd
import torch
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv
from tqdm import tqdm

from benchmarks import command_line, ppo
from benchmarks.tables import on_screen

QUALITY = 1.2  # mean |e|, degC
SEEDS = 7
ONE_BY_ONE = (128,)
AT_ONCE = (32, 64, 96, 128)


class OneByOne(DummyVecEnv):
    """Plants that are stepped one after the other."""

    @property
    def infos(self) -> dict[str, Any]:
        """The last errors, as `GymnasiumVecEnv` gives them."""
        return {"error": np.array([info["error"] for info in self.buf_infos])}


class Until(ppo.Keeper):
    """Ends the training when the quality is reached."""

    def _on_step(self) -> bool:
        super()._on_step()
        return not self.reached

    @property
    def reached(self) -> bool:
        """Whether it has been, at the last point of the learning curve."""
        return bool(self.curve) and self.curve[-1]["square_mae"] <= QUALITY


def main(arguments: list[str] | None = None) -> int:
    """Train, and print the times.

    Parameters
    ----------
    arguments
        The command line without the program's name.

    Returns
    -------
    int
        0, or 130 if it was interrupted.
    """
    parser = command_line.parser("training_time", __doc__)
    parser.add_argument(
        "--seeds", type=command_line.number, default=SEEDS, help="trainings of each"
    )
    for option, default, how in (
        ("--one-by-one", ONE_BY_ONE, "one by one"),
        ("--at-once", AT_ONCE, "at once"),
    ):
        text = f"numbers of plants that are stepped {how}"
        parser.add_argument(
            option, type=command_line.number, nargs="*", default=default, help=text
        )
    options = parser.parse_args(arguments)

    cases = {f"one by one, {n}": (n, True) for n in options.one_by_one}
    cases |= {f"at once, {n}": (n, False) for n in options.at_once}
    seconds: dict[str, dict[str, float]] = {name: {} for name in cases}
    interrupted = False
    with tqdm(total=options.seeds * len(cases), desc="training") as bar:
        try:
            for seed in range(options.seeds):
                for name, (n, one_by_one) in cases.items():
                    case = replace(ppo.PPOArguments(), n_envs=n, seed=seed)
                    seconds[name][f"seed {seed}"] = train(case, one_by_one=one_by_one)
                    bar.update()
        except KeyboardInterrupt:
            interrupted = True

    table = pd.DataFrame(seconds)
    table.loc["median"] = table.median()
    shown = table.map("{:.1f}".format).replace({"inf": "never", "nan": ""})
    console = command_line.console(110)
    if interrupted:
        console.print("Interrupted: what has finished is shown.")
    console.print(f"Seconds until mean |e| on the square wave is at most {QUALITY} °C")
    console.print(on_screen(shown.reset_index(names="case")))
    return 130 if interrupted else 0


def train(arguments: ppo.PPOArguments, *, one_by_one: bool) -> float:
    """Train until the quality is reached.

    Parameters
    ----------
    arguments
        How to train.
    one_by_one
        Whether to step one plant after the other.

    Returns
    -------
    float
        The seconds that it took; infinity if the training ended before.
    """
    plants: VecEnv | None = None
    if one_by_one:
        plants = OneByOne(
            [
                partial(gymnasium.make, "MiddlePoint-v0", **given)
                for count, given in arguments.plants
                for _ in range(count)
            ]
        )
    torch.set_num_threads(1)  # as in any training
    model = ppo.begin(arguments, plants)
    with tempfile.TemporaryDirectory() as folder, tqdm(disable=True) as bar:
        keeper = Until(arguments, Path(folder) / "checkpoint.pkl", [], {}, bar)
        model.learn(arguments.steps, callback=keeper, reset_num_timesteps=False)
    return float(keeper.curve[-1]["seconds"]) if keeper.reached else math.inf


if __name__ == "__main__":
    sys.exit(main())
