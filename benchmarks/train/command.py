"""Train as the options say, and keep what validation chooses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import matplotlib.pyplot as plt
import pandas as pd
from rich.console import Console

from agents import PolicyNetwork
from agents.policy_network import PRETRAINED
from benchmarks.lib import drawing
from benchmarks.lib.command_line import UsageError, out_folder
from benchmarks.lib.fan_out import FanOut
from benchmarks.lib.storage import commit
from benchmarks.lib.tables import on_screen, write_csv
from benchmarks.train import kept, ppo
from benchmarks.train.options import Options
from benchmarks.train.through_plant import TRAININGS, Training, train, training_key


def execute(options: Options, console: Console) -> str:
    """Train, say how the networks do in validation, and choose one."""
    if options.network == "ppo":
        return _train_ppo(options, console)
    if options.prices and options.keep:
        raise UsageError("--prices: goes without --keep, as none is chosen")
    training = TRAININGS[options.network]
    if options.steps:
        training = replace(training, steps=options.steps)
    seeds = range(training.seed, training.seed + options.networks)
    trainings = [
        replace(training, seed=seed, move_price=price)
        for price in dict.fromkeys(options.prices) or [training.move_price]
        for seed in seeds
    ]
    fan_out = options.fan_out.open()
    out = out_folder(options.out)
    networks = run(trainings, out, fan_out, retrain=options.retrain)
    table = summary(networks)
    console.print(on_screen(table.map("{:.6g}".format)))
    if options.prices:
        files = [out / f"{options.network}-prices.{suffix}" for suffix in ("csv", "png")]
        write_csv(files[0], table)
        draw_prices(table, files[1])
        return f"Error against valve travel is in {files[0]} and {files[1]}"
    best = networks[int(table["score"].argmin())]
    target = (PRETRAINED if options.keep else out) / f"{options.network}.npz"
    target.parent.mkdir(parents=True, exist_ok=True)
    best.save(target)
    return f"Validation chooses seed {best.provenance['training']['seed']}: it is in {target}"


def _train_ppo(options: Options, console: Console) -> str:
    """Train PPO's policies, say how they do, and put them where they are kept."""
    if options.prices:
        raise UsageError("--prices: PPO's training has no price of valve travel")
    out = out_folder(options.out)
    asked = ppo.PolicyRequest(
        options.fan_out.open(),
        out,
        options.steps,
        options.networks,
        options.retrain,
    )
    policies = ppo.members(asked, shipped=False)
    rows = []
    for policy in policies:
        best = min(policy.curve, key=lambda point: point["validation_mae"])
        rows.append(
            {
                "seed": policy.arguments.seed,
                "best after": best["steps"],
                "mean |e| in validation (°C)": best["validation_mae"],
                "on the square wave (°C)": best["square_mae"],
                "CPU (s)": policy.curve[-1]["seconds"],
            }
        )
    shown = pd.DataFrame(rows).map(lambda x: f"{x:.4g}" if isinstance(x, float) else str(x))
    console.print(on_screen(shown))
    target = PRETRAINED if options.keep else out
    ppo.publish(policies, target)
    return f"The policies are in {target}"


def run(
    trainings: Sequence[Training], out: Path, fan_out: FanOut, *, retrain: bool = False
) -> list[PolicyNetwork]:
    """Train side by side, each in a folder of its own below `out`, and return the networks."""
    files = {out / training_key(each) / "network.npz": each for each in trainings}
    kept.train(
        {file: partial(train, each, commit()) for file, each in files.items()},
        fan_out,
        retrain=retrain,
    )
    return [PolicyNetwork.load(file) for file in files]


def summary(networks: Sequence[PolicyNetwork]) -> pd.DataFrame:
    """Return how each network does in validation."""
    return pd.DataFrame(
        {
            "price": network.provenance["training"]["move_price"],
            "seed": network.provenance["training"]["seed"],
            "best step": network.provenance["validation"]["step"],
            "mean |e| (°C)": network.provenance["validation"]["validation_mae"],
            "travel (t/h a sample)": network.provenance["validation"]["validation_travel"],
            "score": network.provenance["validation"]["score"],
            "CPU (s)": network.provenance["cpu_seconds"],
        }
        for network in networks
    )


def draw_prices(table: pd.DataFrame, path: Path) -> None:
    """Draw the error against the valve travel: networks as points, medians as a line."""
    error, travel = "mean |e| (°C)", "travel (t/h a sample)"
    medians = table.groupby("price")[[travel, error]].median()
    with plt.rc_context(drawing.STYLE):
        figure, axes = plt.subplots(figsize=(6.0, 4.0))
        axes.plot(table[travel], table[error], ".", color="0.6")
        axes.plot(medians[travel], medians[error], "o-", color=drawing.COLOURS[0])
        for price, (x, y) in zip(medians.index, medians.to_numpy(), strict=True):
            axes.annotate(f"{price:g}", (x, y), (4, 4), textcoords="offset points")
        axes.locator_params(nbins=5)
        axes.set(xlabel=travel, ylabel=error)
        axes.set_title("beside each point: price of valve travel (°C for each t/h a sample)",
                       fontsize="medium")  # fmt: skip
        drawing.save(figure, path)
        plt.close(figure)
