"""Run batches of the NN and the PI controller, and record findings about a claim."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from agents import DirectNNController, PIController
from agents.direct_nn import Weights
from benchmarks.lib.statistics import Estimate, percentiles, quantile, share
from benchmarks.loop.rollout import Agent, Trajectory, make_plants, mean_error, rollout
from mptc_gym import PRESETS, Parameters

Array = NDArray[np.floating]

OFTEN = 0.9  # "works", "converges": in at least this share of the draws


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
    most 5 % of that at the start. It is infinite for weights that come so close only in the
    last 100 samples: they have not converged, as the run might end anywhere on their way.
    `weights` are those before each sample, shape (samples, runs, n).
    """
    distance = np.linalg.norm(weights - weights[-1], axis=2)
    outside = distance > 0.05 * distance[0]
    samples = len(weights)
    # The first sample of the final stretch inside the band, found from the end.
    first = np.where(outside.any(axis=0), samples - np.argmax(outside[::-1], axis=0), 0)
    return np.where(first <= samples - 100, first, np.inf)


def fail_node(controller: DirectNNController, stuck_at: int) -> None:
    """Break a hidden node of every network: its output stays at 0 or 1 for any input."""
    weights = controller.weights
    weights.W[..., 0, :] = 0.0
    # So far out on the sigmoid the slope vanishes, and the node cannot learn.
    weights.theta_1[..., 0] = 1e6 if stuck_at else -1e6
    controller.weights = weights


@dataclass(frozen=True)
class Claim:
    """A claim of the paper, its examination and the findings."""

    name: str
    """Short name, for options."""
    section: str
    """Place in the paper."""
    statement: str
    method: str
    """Description of the test."""
    examine: Callable[[Batch, Claim], pd.DataFrame | None]
    """Performs the runs, records the findings with `ask`, and returns `curves`, if any."""
    findings: list[dict[str, Any]] = field(default_factory=list)
    """Rows of the table of numbers."""
    curves: pd.DataFrame | None = None
    """What is drawn: signals, a row for each sample."""

    def examined(self, batch: Batch) -> Claim:
        """Return the claim with its findings."""
        claim = replace(self, findings=[])
        return replace(claim, curves=self.examine(batch, claim))

    @property
    def verdict(self) -> str:
        """The verdict in words; an undecided finding counts as not shown."""
        shown = [row["shown"] == "yes" for row in self.findings if row["shown"]]
        if not shown:
            return "cannot be tested from the text"
        if all(shown):
            return "holds"
        return "holds in part" if any(shown) else "does not hold"

    def ask(
        self,
        quantity: str,
        found: Estimate | ArrayLike,
        unit: str = "",
        *,
        at_least: float = -math.inf,
        at_most: float = math.inf,
    ) -> None:
        """Record a number: an estimate, the median of one value per run, or an exact value.

        A bound makes the number part of the verdict. It is shown if the whole interval keeps
        the bound, and not shown if no part of the interval does.
        """
        if not isinstance(found, Estimate):
            values = np.asarray(found, dtype=np.float64)
            one = float(values.flat[0])
            found = quantile(values, 0.5) if values.ndim else Estimate(one, one, one, 1)
        bounds = {"at least": at_least, "at most": at_most}
        asked = [f"{name} {bound:g}" for name, bound in bounds.items() if math.isfinite(bound)]
        shown = "undecided" if asked else ""
        if asked and at_least <= found.low and found.high <= at_most:
            shown = "yes"
        elif found.high < at_least or found.low > at_most:
            shown = "no"
        criterion = {"criterion": " and ".join(asked), "shown": shown}
        self.findings.append({"quantity": quantity, "unit": unit, **vars(found), **criterion})

    def ask_share(
        self, quantity: str, found: NDArray[np.bool_], *, often: bool = False
    ) -> None:
        """Record the share of runs in which `found` is true; `often` requires `OFTEN`."""
        at_least = 100 * OFTEN if often else -math.inf
        self.ask(quantity, share(found).scaled(100), "% of runs", at_least=at_least)

    def ask_time(self, quantity: str, samples: ArrayLike) -> None:
        """Record the 10th, 50th and 90th percentiles of a time; infinite means never."""
        for p in (0.1, 0.5, 0.9):
            self.ask(f"{quantity}, {p:.0%} of runs", quantile(samples, p), "samples")


_ZONE, _NOISE = PRESETS["dead-zone-7"], PRESETS["noisy"]
# The cases behind the paper's figures: title, arguments, hidden nodes (none for the paper's PI
# controller), and the figure of each signal; the output's shows the set point, too.
FIGURES: tuple[tuple[str, dict[str, Any], int, dict[str, int]], ...] = (
    ("NN, dead zone 5 t/h, R = 0", {}, 3, {"output": 5}),
    ("NN, dead zone 7 t/h, R = 0", _ZONE, 3, {"output": 6, "command": 7}),
    ("NN, dead zone 5 t/h, R = 0.5 °C²", _NOISE, 3, {"output": 8, "command": 9, "noise": 9}),
    ("PI, dead zone 5 t/h, R = 0", {}, 0, {"output": 10}),
    ("PI, dead zone 5 t/h, R = 0.5 °C²", _NOISE, 0, {"output": 11}),
    ("NN, six hidden nodes, dead zone 5 t/h, R = 0", {}, 6, {"output": 12}),
)


def typical(trajectory: Trajectory) -> pd.DataFrame:
    """Return the set point, and each signal's typical run and percentiles, a row per sample.

    The typical run is that with the median mean error, the better of two middle runs.
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
