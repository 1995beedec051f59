"""Run batches of the paper's neural controller and of PI controllers, and log weights."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents import DirectNNController, PIController
from benchmarks.loop.rollout import Agent, Trajectory, make_plants, rollout

Array = NDArray[np.floating]

PAPER_NODES = 3  # number of hidden nodes of the paper's network
PAPER_LENGTH = 3  # number of set points, and of errors, among the inputs of the paper's network
# Weights have converged if their distance from their final values is at most this share of the
# distance at the start of the run, for at least this many samples at the end of the run.
CONVERGED_SHARE = 0.05
CONVERGED_SAMPLES = 100


@dataclass(frozen=True)
class Batch:
    """A batch of independent runs of controllers on plants."""

    runs: int  # number of runs
    seed: int = 0  # run i has the initial weights and the noise of the seed `seed + i`

    def networks(
        self,
        *,
        nodes: int = PAPER_NODES,
        length: int = PAPER_LENGTH,
        in_proportion: bool = False,
        direction: int = -1,
    ) -> DirectNNController:
        """Return learning networks, one for each run of the batch; by default, the paper's.

        Parameters
        ----------
        nodes
            Number of hidden nodes.
        length
            Number of set points, and of errors, among the inputs of a network.
        in_proportion
            Whether a network with n times the nodes or inputs of the paper's network has 1 / n
            of the paper's learning rates. With equal learning rates, a larger network learns
            faster, as more terms of a sum change at the same time.
        direction
            The sign of the plant's gain that a network assumes: -1, or 1 for the wrong sign.
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
        """Run a controller on a plant for each run of the batch, and return the trajectory.

        Parameters
        ----------
        agent
            The controller, for all runs of the batch.
        samples
            Length of a run, in samples.
        before
            Function that is called with k before the controller acts at sample k.
        **arguments
            Arguments of the environment.
        """
        plants = make_plants(self.runs, samples, **arguments)
        return rollout(plants, agent, samples, self.seed, before)

    def run_nn(self, samples: int, **arguments: Any) -> Trajectory:
        """Run the paper's network, and return the trajectory of all runs of the batch.

        `samples` is the length of a run, and `arguments` are arguments of the environment.
        """
        return self.run(self.networks(), samples, **arguments)

    def run_pi(self, gains: Mapping[str, float], samples: int, **arguments: Any) -> Trajectory:
        """Run a PI controller with the gains `kp` and `ki`, and return the trajectory.

        Without the argument `noise_variance`, all runs would be equal, so there is one run.
        `samples` is the length of a run, and `arguments` are arguments of the environment.
        """
        batch = self if "noise_variance" in arguments else Batch(1, self.seed)
        return batch.run(PIController(gains["kp"], gains["ki"]), samples, **arguments)


@dataclass
class WeightLog:
    """A log of the weights of learning networks, to be called before each sample of a run."""

    networks: DirectNNController  # a batch of networks, one for each run
    weights: list[Array] = field(default_factory=list)  # by sample, each (runs, weights)

    def __call__(self, k: int) -> None:
        """Append the weights of all networks before they act at sample k."""
        arrays = vars(self.networks.weights).values()
        columns = [array.reshape(len(array), -1) for array in arrays]
        self.weights.append(np.hstack(columns, dtype=np.float32))


def converged_at(weights: Array) -> Array:
    """Return the sample from which on the weights of each run have converged, shape (runs,).

    The weights have converged at a sample if, from this sample on, their Euclidean distance
    from their final values is at most `CONVERGED_SHARE` times the distance at the start. If
    they come this close to their final values only in the last `CONVERGED_SAMPLES` samples,
    they may still be moving when the run ends, and the result is infinite.

    Parameters
    ----------
    weights
        The weights of the networks before each sample, shape (samples, runs, weights).
    """
    samples = len(weights)
    distances = np.linalg.norm(weights - weights[-1], axis=2)
    is_outside = distances > CONVERGED_SHARE * distances[0]
    # Backwards in time, the first sample outside follows all samples that have converged.
    converged_samples = np.argmax(is_outside[::-1], axis=0)
    first_converged = np.where(is_outside.any(axis=0), samples - converged_samples, 0)
    is_long_enough = first_converged <= samples - CONVERGED_SAMPLES
    return np.where(is_long_enough, first_converged, np.inf)
