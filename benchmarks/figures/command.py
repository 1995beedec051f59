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
from benchmarks.figures import plots
from benchmarks.figures.options import Options
from benchmarks.lib.command_line import out_folder
from benchmarks.lib.tables import percentiles, write_csv
from benchmarks.loop.metrics import mean_error
from benchmarks.loop.rollout import Trajectory
from mptc_gym import PRESETS, Parameters

SEED = 0
SAMPLES = 1200


@dataclass(frozen=True)
class Case:
    """What is run for one or more figures.

    Attributes
    ----------
    title
        For headings.
    arguments
        Arguments of the environment.
    nodes
        Hidden nodes of the network; None for the paper's PI controller.
    """

    title: str
    arguments: dict[str, Any] = field(default_factory=dict)
    nodes: int | None = 3

    def run(self, batch: Batch) -> Trajectory:
        """Run the whole batch."""
        agent = PIController() if self.nodes is None else batch.network(n_hidden=self.nodes)
        return batch.run(agent, SAMPLES, **self.arguments)


@dataclass(frozen=True)
class Figure:
    """One figure of the paper.

    Attributes
    ----------
    number
        The paper's.
    case
        What is run: a name in `CASES`.
    signals
        What it shows, from top to bottom: "output" stands for set point and temperature.
    """

    number: int
    case: str
    signals: tuple[str, ...] = ("output",)

    @property
    def file(self) -> str:
        """Name of its picture."""
        return f"figure_{self.number:02d}.png"

    @property
    def title(self) -> str:
        """Its heading."""
        return f"Fig. {self.number}: {CASES[self.case].title}"

    @property
    def parameters(self) -> Parameters:
        """The plant's: dead zone and limits are drawn behind the command."""
        return Parameters(**CASES[self.case].arguments)


CASES = {
    "nn": Case("NN, dead zone 5 t/h, R = 0"),
    "nn_dead_zone": Case("NN, dead zone 7 t/h, R = 0", PRESETS["dead-zone-7"]),
    "nn_noise": Case("NN, dead zone 5 t/h, R = 0.5 °C²", PRESETS["noisy"]),
    "pi": Case("PI, dead zone 5 t/h, R = 0", nodes=None),
    "pi_noise": Case("PI, dead zone 5 t/h, R = 0.5 °C²", PRESETS["noisy"], nodes=None),
    "nn_six_nodes": Case("NN, six hidden nodes, dead zone 5 t/h, R = 0", nodes=6),
}
FIGURES = (
    Figure(5, "nn"),
    Figure(6, "nn_dead_zone"),
    Figure(7, "nn_dead_zone", ("command",)),
    Figure(8, "nn_noise"),
    Figure(9, "nn_noise", ("command", "noise")),
    Figure(10, "pi"),
    Figure(11, "pi_noise"),
    Figure(12, "nn_six_nodes"),
)


def execute(options: Options, console: Console) -> str:
    """Run the cases and draw the figures."""
    out_folder(options.out)
    curves: dict[str, pd.DataFrame] = {}
    for name in tqdm(CASES, unit="case"):
        trajectory = CASES[name].run(Batch(options.runs, SEED))
        curves[name] = summarise(trajectory)
        write_csv(options.out / f"{name}.csv", curves[name])
        for figure in FIGURES:
            if figure.case == name:
                plots.plot_figures([figure], curves, options.out / figure.file)
    plots.plot_figures(FIGURES, curves, options.out / "figures.png")
    return f"Figures 5 to 12, their sheet figures.png and their data: {options.out}/"


def summarise(trajectory: Trajectory) -> pd.DataFrame:
    """Return the set point, and each signal in a typical run and over all, row by sample.

    Parameters
    ----------
    trajectory
        The runs, all with the same set point.

    Returns
    -------
    DataFrame
        `time_s`, `setpoint`, and for `output`, `command` and `noise`: `_typical`, the run whose
        mean error is the median (of an even number the better of the two), `_p10` and `_p90`.
    """
    error = mean_error(trajectory)
    typical = np.argsort(error, kind="stable")[(len(error) - 1) // 2]
    columns = {
        "time_s": np.arange(len(trajectory.setpoint)) * Parameters().sampling_interval,
        "setpoint": trajectory.setpoint[:, 0],
    }
    for signal in ("output", "command", "noise"):
        values = getattr(trajectory, signal)
        columns[f"{signal}_typical"] = values[:, typical]
        spread = percentiles(values)
        columns |= {f"{signal}_{name}": spread[name] for name in ("p10", "p90")}
    return pd.DataFrame(columns)
