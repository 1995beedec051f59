"""Run the cases of the paper's figures and draw their counterparts."""

from __future__ import annotations

import numpy as np
import pandas as pd
from rich.console import Console
from tqdm import tqdm

from agents import PIController
from benchmarks.claims.runs import Batch
from benchmarks.figures.cases import CASES, FIGURES
from benchmarks.figures.options import Options
from benchmarks.figures.plots import plot_figures
from benchmarks.lib.command_line import out_folder
from benchmarks.lib.tables import percentiles, write_csv
from benchmarks.loop.metrics import mean_error
from benchmarks.loop.rollout import Trajectory
from mptc_gym import Parameters

SEED = 0
SAMPLES = 1200


def execute(options: Options, console: Console) -> str:
    """Run the cases and draw the figures."""
    out, batch = out_folder(options.out), Batch(options.runs, SEED)
    curves: dict[str, pd.DataFrame] = {}
    for name, case in tqdm(CASES.items(), unit="case"):
        agent = PIController() if case.nodes is None else batch.network(n_hidden=case.nodes)
        curves[name] = summarise(batch.run(agent, SAMPLES, **case.arguments))
        write_csv(out / f"{name}.csv", curves[name])
        for figure in FIGURES:
            if figure.case == name:
                plot_figures([figure], curves, out / f"figure_{figure.number:02d}.png")
    plot_figures(FIGURES, curves, out / "figures.png")
    return f"Figures 5 to 12, their sheet figures.png and their data: {out}/"


def summarise(trajectory: Trajectory) -> pd.DataFrame:
    """Return the set point, and each signal in a typical run and over all, row by sample.

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
        "setpoint": trajectory.setpoint[:, 0],  # that of all runs
    }
    for signal in ("output", "command", "noise"):
        values = getattr(trajectory, signal)
        columns[f"{signal}_typical"] = values[:, typical]
        spread = percentiles(values)
        columns |= {f"{signal}_{name}": spread[name] for name in ("p10", "p90")}
    return pd.DataFrame(columns)
