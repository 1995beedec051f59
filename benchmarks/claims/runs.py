"""Run batches of the paper's network and of PI controllers, and log how weights converge."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents import DirectNNController, PIController
from benchmarks.loop.rollout import Agent, Trajectory, make_plants, rollout

Array = NDArray[np.floating]

PAPER_NODES = 3  # hidden nodes of the paper's network
PAPER_LENGTH = 3  # set points, and errors, that the paper's network sees
CONVERGED = 0.05  # share of the distance at the start within which weights have converged
STAY = 100  # samples for which weights must stay converged at the end of a run


class Gains(NamedTuple):
    """The gains of a PI controller, t/h per degC; `ki` acts on the sum of the errors."""

    kp: float
    ki: float


@dataclass(frozen=True)
class Batch:
    """A batch of runs; run i has the initial weights and noise of seed `seed + i`."""

    runs: int
    seed: int = 0

    def networks(
        self,
        *,
        nodes: int = PAPER_NODES,
        length: int = PAPER_LENGTH,
        in_proportion: bool = False,
        direction: int = -1,
    ) -> DirectNNController:
        """Return a network for each run, by default the paper's.

        Parameters
        ----------
        nodes
            Number of hidden nodes.
        length
            Number of set points, and of errors, that a network sees.
        in_proportion
            A sum moves faster the more terms it has, if the weights of all terms learn with the
            same gain. True scales the gains down in proportion, to compensate.
        direction
            The sign of the plant's gain that a network assumes.
        """
        node_scale = 1.0
        input_scale = 1.0
        if in_proportion:
            node_scale = PAPER_NODES / nodes
            input_scale = PAPER_LENGTH / length
        paper = DirectNNController()
        return DirectNNController(
            n_inputs=2 * length,
            n_hidden=nodes,
            eta=node_scale * input_scale * paper.eta,
            eta_1=node_scale * paper.eta_1,
            eta_theta=node_scale * paper.eta_theta,
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
        """Run the paper's networks on plants with these arguments of the environment."""
        return self.run(self.networks(), samples, **arguments)

    def run_pi(self, gains: Gains, samples: int, **arguments: Any) -> Trajectory:
        """Run a PI controller on plants with these arguments; only one run if without noise."""
        batch = self if "noise_variance" in arguments else Batch(1, self.seed)
        return batch.run(PIController(*gains), samples, **arguments)


@dataclass
class WeightLog:
    """The weights of a batch of networks, logged before each sample of a rollout."""

    networks: DirectNNController
    rows: list[Array] = field(default_factory=list)  # one per sample, shape (runs, weights)

    def __call__(self, k: int) -> None:
        """Log the weights before sample k."""
        arrays = vars(self.networks.weights).values()
        columns = [array.reshape(len(array), -1) for array in arrays]
        self.rows.append(np.hstack(columns, dtype=np.float32))


def converged_at(weights: Array) -> Array:
    """Return the sample from which on the weights of each run have converged, shape (runs,).

    From this sample on, their Euclidean distance to their final values is at most `CONVERGED`
    times the distance at the start. It is infinite for weights that come so close only in the
    last `STAY` samples: they have not converged, as the run might end anywhere on their way.
    `weights` are the weights before each sample, shape (samples, runs, weights).
    """
    samples = len(weights)
    distances = np.linalg.norm(weights - weights[-1], axis=2)
    is_outside = distances > CONVERGED * distances[0]
    # One sample after the last sample outside; 0 if no sample is outside.
    samples_inside = np.argmax(is_outside[::-1], axis=0)
    first_inside = np.where(is_outside.any(axis=0), samples - samples_inside, 0)
    return np.where(first_inside <= samples - STAY, first_inside, np.inf)
