"""Run batches of the NN and the PI controller for claims and figures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from agents import DirectNNController, PIController
from agents.direct_nn import Weights
from benchmarks.lib.tables import percentiles
from benchmarks.loop.metrics import mean_error
from benchmarks.loop.rollout import Agent, Trajectory, make_plants, rollout
from mptc_gym import PRESETS, Parameters

Array = NDArray[np.floating]

BAND = 0.05  # fraction of the distance from the first weights to the last
STILL = 100  # last samples of a run, in which converged weights stay within the band


@dataclass(frozen=True)
class Batch:
    """A batch of runs; run i has the initial weights and noise of seed `seed + i`."""

    runs: int
    seed: int = 0

    def networks(
        self, *, nodes: int = 3, length: int = 3, slower: bool = False, direction: int = -1
    ) -> DirectNNController:
        """Return a network for each run, by default the paper's.

        A network has `nodes` hidden nodes, and sees `length` set points and errors. A sum moves
        faster the more terms it has, if the weights of all terms learn with the same gain;
        `slower` scales the gains down to compensate.
        """
        of_nodes, of_inputs = (3 / nodes, 3 / length) if slower else (1.0, 1.0)
        paper = DirectNNController()
        return DirectNNController(
            n_inputs=2 * length,
            n_hidden=nodes,
            eta=of_nodes * of_inputs * paper.eta,
            eta_1=of_nodes * paper.eta_1,
            eta_theta=of_nodes * paper.eta_theta,
            direction=direction,
            error_index=length,
            seed=self.seed,
            num_envs=self.runs,
        )

    def run(
        self,
        agent: Agent,
        samples: int,
        before: Callable[[int], object] | None = None,
        **arguments: Any,
    ) -> Trajectory:
        """Run a controller on plants with these arguments; for `before` see `rollout`."""
        plants = make_plants(self.runs, samples, **arguments)
        return rollout(plants, agent, samples, self.seed, before)

    def run_nn(self, samples: int, **arguments: Any) -> Trajectory:
        """Run the paper's networks."""
        return self.run(self.networks(), samples, **arguments)

    def run_pi(self, kp: float, ki: float, samples: int, **arguments: Any) -> Trajectory:
        """Run a PI controller, only once if there is no noise."""
        noisy = arguments.get("noise_variance", 0.0) > 0.0
        batch = self if noisy else Batch(1, self.seed)
        return batch.run(PIController(kp, ki), samples, **arguments)


def flat(weights: Weights) -> Array:
    """Return the weights of each network in one row, shape (runs, n)."""
    runs = len(weights.theta_2)
    arrays = [array.reshape(runs, -1) for array in vars(weights).values()]
    return np.hstack(arrays, dtype=np.float32)


def converged_at(weights: Array) -> Array:
    """Return the sample at which weights have converged, shape (runs,).

    This is the first sample from which on their Euclidean distance to their final values is at
    most `BAND` times that at the start. It is infinite for weights that come so close only in
    the last `STILL` samples: they have not converged, as the run might end anywhere on their
    way. `weights` are those before each sample, shape (samples, runs, n).
    """
    distance = np.linalg.norm(weights - weights[-1], axis=2)
    outside = distance > BAND * distance[0]
    samples = len(weights)
    # The first sample of the final stretch inside the band, found from the end.
    first = np.where(outside.any(axis=0), samples - np.argmax(outside[::-1], axis=0), 0)
    return np.where(first <= samples - STILL, first, np.inf)


def fail_node(controller: DirectNNController, stuck_at: int) -> None:
    """Break a hidden node of every network: its output stays at 0 or 1 for any input."""
    weights = controller.weights
    weights.W[..., 0, :] = 0.0
    # So far out on the sigmoid the slope vanishes, and the node cannot learn.
    weights.theta_1[..., 0] = 1e6 if stuck_at else -1e6
    controller.weights = weights


@dataclass(frozen=True)
class Case:
    """The runs behind one or more figures of the paper."""

    title: str
    figures: dict[int, tuple[str, ...]]
    """Signals in each figure, from top to bottom: "output" is set point and temperature."""
    arguments: dict[str, Any] = field(default_factory=dict)
    """Arguments of the environment."""
    nodes: int | None = 3
    """Hidden nodes of the network; None for the paper's PI controller."""
    samples: int = 1200


OUTPUT = ("output",)
FIGURES = (
    Case("NN, dead zone 5 t/h, R = 0", {5: OUTPUT}),
    Case("NN, dead zone 7 t/h, R = 0", {6: OUTPUT, 7: ("command",)}, PRESETS["dead-zone-7"]),
    Case(
        "NN, dead zone 5 t/h, R = 0.5 °C²", {8: OUTPUT, 9: ("command", "noise")},
        PRESETS["noisy"],
    ),
    Case("PI, dead zone 5 t/h, R = 0", {10: OUTPUT}, nodes=None),
    Case("PI, dead zone 5 t/h, R = 0.5 °C²", {11: OUTPUT}, PRESETS["noisy"], None),
    Case("NN, six hidden nodes, dead zone 5 t/h, R = 0", {12: OUTPUT}, nodes=6),
)  # fmt: skip


def typical(trajectory: Trajectory) -> pd.DataFrame:
    """Return the set point, and each signal's typical run and percentiles, a row per sample.

    Returns
    -------
    DataFrame
        `time_s`, `setpoint`, and for `output`, `command` and `noise`: `_typical`, the run with
        the median mean error (the better of two middle runs), `_p10` and `_p90`.
    """
    error = mean_error(trajectory)
    middle = np.argsort(error, kind="stable")[(len(error) - 1) // 2]
    columns = {
        "time_s": np.arange(len(trajectory.setpoint)) * Parameters().sampling_interval,
        "setpoint": trajectory.setpoint[:, 0],  # the same in all runs
    }
    for signal in ("output", "command", "noise"):
        values = getattr(trajectory, signal)
        columns[f"{signal}_typical"] = values[:, middle]
        spread = percentiles(values)
        columns |= {f"{signal}_{name}": spread[name] for name in ("p10", "p90")}
    return pd.DataFrame(columns)
