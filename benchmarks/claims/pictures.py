"""Draw the paper's figures 5 to 12, and the life of the network."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from agents import PIController
from benchmarks.claims.conditions import PAPER_PI, PLANTS
from benchmarks.claims.life import PI_LABELS, VARIANTS
from benchmarks.claims.settings import AS_REPORTED, LEAST_ERROR, PAPER_LEVEL, Batch
from benchmarks.controllers.roster import GROUPS
from benchmarks.lib.pictures import DEAD_ZONE, LIMIT, SETPOINT, open_picture
from benchmarks.loop.runs import make_plants
from benchmarks.loop.scenarios import Arguments
from mptc_gym import Parameters
from mptc_gym.plant.parameters import EPISODE_STEPS
from mptc_gym.rollout import rollout, start

NN_COLOUR = GROUPS["simulator"].colour  # as in the pictures of a comparison
PI_COLOUR = GROUPS["paper's PI gains"].colour
# How the error of a controller is drawn: networks in shades of green, the slower the lighter.
LOOKS: dict[str, Any] = {
    "NN, rates x 1": {"color": "#00402F"},
    "NN, rates x 0.3": {"color": "#007A5A"},
    "NN, rates x 0.1": {"color": "#4DB896"},
    "NN, rates x 0.03": {"color": "#A5DCC8"},
    "not the paper's: weights within ±3": {"color": "#D55E00", "linestyle": ":"},
    "not the paper's: rates fall": {"color": "#D55E00", "linestyle": "--"},
    "PI (1992)": {"color": PI_COLOUR},
    "PI (1992), Ki per minute": {"color": PI_COLOUR, "linestyle": "--"},
    "PI (SIMC)": {"color": GROUPS["step test"].colour},
    "PI (searched)": {"color": "black"},
}
PLANT_TITLES = {
    "plain": "dead zone 5 t/h, no noise",
    "noise": "dead zone 5 t/h, R = 0.5 °C²",
    "dead zone 7": "dead zone 7 t/h, no noise",
}


def draw_figures(folder: Path) -> None:
    """Draw the paper's figures at a constant set point, and on the square wave."""
    _draw_figures(
        folder / "figures-constant.png",
        f"Figures 5 to 12 at a constant {PAPER_LEVEL:g} °C, numbers 'as reported'",
        AS_REPORTED,
        400,
        {"setpoint": PAPER_LEVEL},
    )
    _draw_figures(
        folder / "figures-square.png",
        f"Figures 5 to 12 on a square wave of {PAPER_LEVEL:g} °C, numbers of least error",
        LEAST_ERROR,
        EPISODE_STEPS,
        {"setpoint_amplitude": PAPER_LEVEL},
    )


def _draw_figures(
    path: Path, title: str, numbers: Mapping[str, float], samples: int, setpoint: Arguments
) -> None:
    """Draw the paper's figures 5 to 12 with one choice of the network's numbers."""
    batch = Batch(pd.DataFrame([numbers]), PAPER_LEVEL, runs=1, seed=0)

    def signals(agent: Any, condition: str) -> pd.DataFrame:
        """Run a controller, and return its signals, a row for each sample."""
        plants = make_plants(1, samples, **setpoint, **PLANTS[condition])
        steps = rollout(plants, start(agent, 1), samples, [batch.seed])
        names = ["setpoint", "output", "command", "noise"]
        return pd.DataFrame([{n: step.infos[n][0] for n in names} for step in steps])

    pi = PIController(PAPER_PI["PI"]["kp"], PAPER_PI["PI"]["ki"])
    runs = {
        "5: NN": signals(batch.networks(), "plain"),
        "6: NN, dead zone 7 t/h": signals(batch.networks(), "dead zone 7"),
        "8: NN, R = 0.5": signals(batch.networks(), "noise"),
        "10: PI": signals(pi, "plain"),
        "11: PI, R = 0.5": signals(pi, "noise"),
        "12: NN, six nodes": signals(batch.networks(nodes=6), "plain"),
    }
    commands = {
        "7: command of the run of 6": (runs["6: NN, dead zone 7 t/h"], 7.0),
        "9: command of the run of 8, n(k) grey": (runs["8: NN, R = 0.5"], 5.0),
    }
    outputs = pd.concat([run["output"] for run in runs.values()])
    panels = sorted([*runs, *commands], key=lambda name: int(name.split(":")[0]))
    with open_picture(path, 9.5, title) as figure:
        grid = figure.subplots(4, 2, sharex=True)
        for axes, name in zip(grid.flat, panels, strict=True):
            axes.set_title(f"Fig. {name}")
            if name in runs:
                run = runs[name]
                colour = PI_COLOUR if "PI" in name else NN_COLOUR
                axes.plot(run["setpoint"], **SETPOINT)
                axes.plot(run["output"], color=colour, linewidth=1.0)
                axes.set_ylim(outputs.min() - 0.5, outputs.max() + 0.5)
                axes.set_ylabel("temperature (°C)")
            else:
                run, edge = commands[name]
                axes.axhspan(-edge, edge, **DEAD_ZONE)
                for limit in (Parameters().u_min, Parameters().u_max):
                    axes.axhline(limit, **LIMIT)
                if run["noise"].any():
                    axes.plot(run["noise"], color="0.5", linewidth=0.5)
                # The infos of sample k + 1 have the command of sample k.
                axes.plot(run["command"].iloc[1:].to_numpy(), color=NN_COLOUR, linewidth=1.0)
                axes.set_ylabel("flow (t/h)")
        for axes in grid[-1]:
            axes.set_xlabel("sample k (8 s)")


def draw_life(operation: pd.DataFrame, path: Path) -> None:
    """Draw the errors of continuous operation over time, in a panel for each plant.

    `operation` are the rows of all plants in the tables that `life.operate` returns.
    """
    title = "The network of 1992 learns, and is ruined later; slower rates postpone both"
    with open_picture(path, 4.2, title) as figure:
        grid = figure.subplots(1, len(PLANTS), sharey=True)
        for axes, (plant, rows) in zip(
            grid, operation.groupby("plant", sort=False), strict=True
        ):
            for controller in (*VARIANTS, *PI_LABELS):
                of_controller = rows[rows["controller"] == controller]
                look = {"linewidth": 1.2, "label": controller, **LOOKS[controller]}
                axes.plot(of_controller["days"], of_controller["error"], **look)
            axes.set_title(PLANT_TITLES[str(plant)])
            axes.set_xscale("log")
            axes.set_xticks([0.2, 0.5, 1, 2, 5, 10], ["0.2", "0.5", "1", "2", "5", "10"])
            axes.minorticks_off()
            axes.set_xlabel("time (days)")
        grid[0].set_ylabel("mean |e| over 160 min (°C)")
        handles, labels = grid[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3)
