"""Run batches of the NN and the PI controller for claims and figures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents import DirectNNController, PIController
from agents.direct_nn import Weights
from benchmarks.loop.rollout import Agent, Trajectory, make_plants, rollout

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
