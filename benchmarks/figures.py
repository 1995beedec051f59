"""Counterparts of the paper's Figs 5 to 12: `python -m benchmarks.figures`.

Each case is run with a thousand draws of initial weights and noise. A strong line shows a
typical run, the one with the median of the mean errors, before the 10th to 90th percentile of
all runs. Each figure becomes a picture, all together one sheet; what is drawn is in CSV files.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from tqdm import tqdm

from agents import PIController
from benchmarks import command_line, plots
from benchmarks.experiments import Draws, mean_error
from benchmarks.rollout import Trajectory
from benchmarks.storage import replacing
from benchmarks.tables import percentiles
from mptc_gym import Parameters

DRAWS = 1000
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

    def run(self, draws: Draws) -> Trajectory:
        """Run all draws."""
        agent = PIController() if self.nodes is None else draws.network(n_hidden=self.nodes)
        return draws.run(agent, SAMPLES, **self.arguments)


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


_NOISE = {"noise_variance": 0.5}
CASES = {
    "nn": Case("NN, dead zone 5 t/h, R = 0"),
    "nn_dead_zone": Case("NN, dead zone 7 t/h, R = 0", {"dead_zone": 7.0}),
    "nn_noise": Case("NN, dead zone 5 t/h, R = 0.5 °C²", _NOISE),
    "pi": Case("PI, dead zone 5 t/h, R = 0", nodes=None),
    "pi_noise": Case("PI, dead zone 5 t/h, R = 0.5 °C²", _NOISE, nodes=None),
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


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the cases and draw the figures.

    Parameters
    ----------
    arguments
        The command line without the program's name.

    Returns
    -------
    int
        0, or 130 if it was interrupted.
    """
    parser = command_line.parser("figures", __doc__)
    add = parser.add_argument
    add("--draws", type=command_line.number, default=DRAWS, help="runs of each case")
    add("--out", type=Path, default=Path("results/figures"), help="folder to write to")
    options = parser.parse_args(arguments)

    console = command_line.console(120)
    curves: dict[str, pd.DataFrame] = {}
    try:
        for name in tqdm(CASES, unit="case"):
            trajectory = CASES[name].run(Draws(options.draws, SEED))
            curves[name] = summarise(trajectory)
            with replacing(options.out / f"{name}.csv") as file:
                curves[name].to_csv(file, index=False)
            for figure in FIGURES:
                if figure.case == name:
                    _draw([figure], curves, options.out / figure.file)
        _draw(FIGURES, curves, options.out / "figures.png")
    except KeyboardInterrupt:
        console.print("\nInterrupted: the figures that are done are kept.")
        return 130
    console.print(f"Figures 5 to 12, their sheet figures.png and their data: {options.out}/")
    return 0


def _draw(figures: Sequence[Figure], curves: dict[str, pd.DataFrame], path: Path) -> None:
    panels = [
        plots.Panel(
            title=f"Fig. {figure.number}: {CASES[figure.case].title}",
            curves=curves[figure.case],
            signals=figure.signals,
            parameters=Parameters(**CASES[figure.case].arguments),
        )
        for figure in figures
    ]
    plots.plot_figures(panels, path)


def summarise(trajectory: Trajectory) -> pd.DataFrame:
    """Return one row a sample: the set point, and each signal in a typical run and over all.

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


if __name__ == "__main__":
    sys.exit(main())
