"""Run batches of the paper's neural controller and of PI controllers, and log weights."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents import DirectNNController, PIController
from benchmarks.loop.runs import Agent, Trajectory, make_plants, simulate
from mptc_gym.rollout import Act

Array = NDArray[np.floating]

PAPER_NODES = 3  # number of hidden nodes of the paper's network
PAPER_LENGTH = 3  # number of latest set points, and of latest errors, as the network's inputs
# The weights of a network have converged if, for at least `CONVERGED_SAMPLES` samples at the
# end of a run, their distance from their final values is at most `CONVERGED_SHARE` times the
# distance at the start of the run.
CONVERGED_SHARE = 0.05
CONVERGED_SAMPLES = 100


@dataclass(frozen=True)
class Batch:
    """A batch of independent runs of controllers on plants."""

    runs: int  # number of runs
    seed: int = 0  # seed of the first run; run i has the seed `seed + i`

    def networks(
        self,
        *,
        nodes: int = PAPER_NODES,
        length: int = PAPER_LENGTH,
        in_proportion: bool = False,
        direction: int = -1,
    ) -> DirectNNController:
        """Return a learning network for each run of the batch, by default the paper's network.

        Parameters
        ----------
        nodes
            Number of hidden nodes.
        length
            Number of latest set points, and number of latest errors, that each network
            observes.
        in_proportion
            Whether to reduce the paper's learning rates for larger networks. With n times the
            nodes of the paper's network, all learning rates except that of the output's
            threshold are divided by n. With n times the inputs, only the learning rate of the
            weights of the inputs is divided by n. With equal learning rates, a larger network
            learns faster, as the sums from which its output is computed have more terms that
            change.
        direction
            Sign of the plant's gain that each network assumes: -1 (right) or 1 (wrong).
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

    def run(self, agent: Agent | Act, samples: int, **arguments: Any) -> Trajectory:
        """Run a controller on one plant for each run of the batch, and return all signals.

        `agent` is a controller, or a function from observations to actions. `samples` is the
        length of a run, and `arguments` are arguments of the environment.
        """
        plants = make_plants(self.runs, samples, **arguments)
        return simulate(plants, agent, samples, self.seed)

    def run_nn(self, samples: int, **arguments: Any) -> Trajectory:
        """Run the paper's network, and return the signals of all runs of the batch."""
        return self.run(self.networks(), samples, **arguments)

    def run_pi(self, gains: Mapping[str, float], samples: int, **arguments: Any) -> Trajectory:
        """Run a PI controller with the gains `kp` and `ki`, and return the signals of all runs.

        If `arguments` does not contain `noise_variance`, all runs of the batch would be equal,
        so that the PI controller runs only once.
        """
        batch = self if "noise_variance" in arguments else Batch(1, self.seed)
        return batch.run(PIController(gains["kp"], gains["ki"]), samples, **arguments)

    def log_weights(self, samples: int, **arguments: Any) -> Array:
        """Run the paper's network, and return its weights before each sample of each run.

        The returned array has the shape (samples, runs, weights).
        """
        networks = self.networks()
        log = []

        def act(observations: Any) -> Array:
            """Log all weights, and return the actions of the networks."""
            arrays = vars(networks.weights).values()
            columns = [array.reshape(self.runs, -1) for array in arrays]
            log.append(np.hstack(columns, dtype=np.float32))
            return networks.act(observations)

        self.run(act, samples, **arguments)
        return np.array(log)


def converged_at(weights: Array) -> Array:
    """Return the sample at which the weights of each run have converged, shape (runs,).

    The weights have converged at the first sample from which on their Euclidean distance from
    their final values is at most `CONVERGED_SHARE` times the distance at the start of the run.
    The result is infinite for a run whose weights converge less than `CONVERGED_SAMPLES`
    samples before the end of the run, since these weights may still be changing when the run
    ends.

    `weights` has the weights of the networks before each sample, shape (samples, runs,
    weights).
    """
    samples = len(weights)
    distances = np.linalg.norm(weights - weights[-1], axis=2)
    is_outside = distances > CONVERGED_SHARE * distances[0]
    # In reversed time, the index of the first sample outside is the number of converged
    # samples.
    converged_samples = np.argmax(is_outside[::-1], axis=0)
    # 0 for weights that never changed.
    first_converged = np.where(is_outside.any(axis=0), samples - converged_samples, 0)
    is_long_enough = first_converged <= samples - CONVERGED_SAMPLES
    return np.where(is_long_enough, first_converged, np.inf)
