"""Run the cases of the paper's figures and draw their counterparts."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd
from rich.console import Console
from tqdm import tqdm

from agents import PIController
from benchmarks.claims.runs import Batch
from benchmarks.figures.__main__ import Options
from benchmarks.figures.plots import Panel, plot
from benchmarks.lib.command import out_folder
from benchmarks.lib.tables import percentiles, write_csv
from benchmarks.loop.metrics import mean_error
from benchmarks.loop.rollout import Trajectory
from mptc_gym import PRESETS, Parameters

SAMPLES = 1200


@dataclass(frozen=True)
class Case:
    """The runs behind one or more figures."""

    name: str
    """Name of the data file."""
    title: str
    figures: dict[int, tuple[str, ...]]
    """Signals in each figure, from top to bottom: "output" is set point and temperature."""
    arguments: dict[str, Any] = field(default_factory=dict)
    """Arguments of the environment."""
    nodes: int | None = 3
    """Hidden nodes of the network; None for the paper's PI controller."""


OUTPUT = ("output",)
CASES = (
    Case("nn", "NN, dead zone 5 t/h, R = 0", {5: OUTPUT}),
    Case(
        "nn_dead_zone", "NN, dead zone 7 t/h, R = 0", {6: OUTPUT, 7: ("command",)},
        PRESETS["dead-zone-7"],
    ),
    Case(
        "nn_noise", "NN, dead zone 5 t/h, R = 0.5 °C²", {8: OUTPUT, 9: ("command", "noise")},
        PRESETS["noisy"],
    ),
    Case("pi", "PI, dead zone 5 t/h, R = 0", {10: OUTPUT}, nodes=None),
    Case("pi_noise", "PI, dead zone 5 t/h, R = 0.5 °C²", {11: OUTPUT}, PRESETS["noisy"], None),
    Case("nn_six_nodes", "NN, six hidden nodes, dead zone 5 t/h, R = 0", {12: OUTPUT}, nodes=6),
)  # fmt: skip


def execute(options: Options, console: Console) -> str:
    """Run the cases and draw the figures."""
    out, batch = out_folder(options.out), Batch(options.runs)
    sheet: list[Panel] = []
    for case in tqdm(CASES, unit="case"):
        agent = PIController() if case.nodes is None else batch.networks(nodes=case.nodes)
        curves = summarise(batch.run(agent, SAMPLES, **case.arguments))
        write_csv(out / f"{case.name}.csv", curves)
        for number, signals in case.figures.items():
            title, plant = f"Fig. {number}: {case.title}", Parameters(**case.arguments)
            panels = [Panel(title, signal, curves, plant) for signal in signals]
            plot(panels, out / f"figure_{number:02d}.png")
            sheet += panels
    plot(sheet, out / "figures.png", columns=2)
    return f"Figures 5 to 12, their sheet figures.png and their data: {out}/"


def summarise(trajectory: Trajectory) -> pd.DataFrame:
    """Return the set point, and each signal's typical run and percentiles, a row per sample.

    Returns
    -------
    DataFrame
        `time_s`, `setpoint`, and for `output`, `command` and `noise`: `_typical`, the run with
        the median mean error (the better of two middle runs), `_p10` and `_p90`.
    """
    error = mean_error(trajectory)
    typical = np.argsort(error, kind="stable")[(len(error) - 1) // 2]
    columns = {
        "time_s": np.arange(len(trajectory.setpoint)) * Parameters().sampling_interval,
        "setpoint": trajectory.setpoint[:, 0],  # the same in all runs
    }
    for signal in ("output", "command", "noise"):
        values = getattr(trajectory, signal)
        columns[f"{signal}_typical"] = values[:, typical]
        spread = percentiles(values)
        columns |= {f"{signal}_{name}": spread[name] for name in ("p10", "p90")}
    return pd.DataFrame(columns)
