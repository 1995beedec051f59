"""Run the cases of the paper's figures and draw their counterparts."""

from __future__ import annotations

import numpy as np
import pandas as pd
from rich.console import Console
from tqdm import tqdm

from agents import PIController
from benchmarks.claims.runs import Batch
from benchmarks.figures import plots
from benchmarks.figures.cases import CASES, FIGURES, Case
from benchmarks.figures.options import Options
from benchmarks.lib.command_line import out_folder
from benchmarks.lib.tables import percentiles, write_csv
from benchmarks.loop.metrics import mean_error
from benchmarks.loop.rollout import Trajectory
from mptc_gym import Parameters

SEED = 0
SAMPLES = 1200


def execute(options: Options, console: Console) -> str:
    """Run the cases and draw the figures."""
    out_folder(options.out)
    curves: dict[str, pd.DataFrame] = {}
    for name in tqdm(CASES, unit="case"):
        trajectory = run(CASES[name], Batch(options.runs, SEED))
        curves[name] = summarise(trajectory)
        write_csv(options.out / f"{name}.csv", curves[name])
        for figure in FIGURES:
            if figure.case == name:
                plots.plot_figures([figure], curves, options.out / figure.file)
    plots.plot_figures(FIGURES, curves, options.out / "figures.png")
    return f"Figures 5 to 12, their sheet figures.png and their data: {options.out}/"


def run(case: Case, batch: Batch) -> Trajectory:
    """Run the whole batch."""
    agent = PIController() if case.nodes is None else batch.network(n_hidden=case.nodes)
    return batch.run(agent, SAMPLES, **case.arguments)


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
