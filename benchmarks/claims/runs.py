"""Run the NN and the PI controller on a thousand plants, for claims and figures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents import DirectNNController, PIController
from agents.direct_nn import Weights
from benchmarks.loop.rollout import Agent, Trajectory, make_plants, rollout

Array = NDArray[np.float64]

BAND = 0.05  # of the distance that the weights have travelled
STILL = 100  # the last samples of a run, in which weights that have converged do not move


@dataclass(frozen=True)
class Batch:
    """Runs side by side, each with initial weights and noise of its own."""

    runs: int
    seed: int = 0
    """Run i has the seed `seed + i`."""

    def network(self, **gains: Any) -> DirectNNController:
        """Return a network for each run, with gains that are not the defaults."""
        return DirectNNController(num_envs=self.runs, seed=self.seed, **gains)

    def run(
        self,
        agent: Agent,
        samples: int,
        before: Callable[[int], object] | None = None,
        **arguments: Any,
    ) -> Trajectory:
        """Run a controller on plants with these arguments; `before` is that of `rollout`."""
        plants = make_plants(self.runs, samples, **arguments)
        return rollout(plants, agent, samples, self.seed, before)

    def run_nn(self, samples: int, **arguments: Any) -> Trajectory:
        """Run networks with the default gains."""
        return self.run(self.network(), samples, **arguments)

    def run_pi(self, kp: float, ki: float, samples: int, **arguments: Any) -> Trajectory:
        """Run a PI controller: one run stands for all where there is no noise."""
        noisy = arguments.get("noise_variance", 0.0) > 0.0
        batch = self if noisy else Batch(1, self.seed)
        return batch.run(PIController(kp, ki), samples, **arguments)


@dataclass(frozen=True)
class Network:
    """A network that is not the paper's."""

    name: str
    """What sets it apart."""
    controller: dict[str, Any]
    """Arguments of the controller."""
    windows: dict[str, Any]
    """Arguments of the environment that feeds it."""
    slower: dict[str, float]
    """Gains that are in proportion: each with a factor to the default. The more terms a sum
    has, the faster it moves when the weights of all of them learn with the same gain."""


def hidden_nodes(count: int) -> Network:
    """Return the paper's network with another number of hidden nodes."""
    slower = dict.fromkeys(("eta", "eta_1", "eta_theta"), 3 / count)
    return Network(f"{count} hidden nodes", {"n_hidden": count}, {}, slower)


def longer_windows(length: int) -> Network:
    """Return a network that sees `length` set points and errors."""
    return Network(
        f"{length} set points and errors",
        {"n_inputs": 2 * length, "error_index": length},
        {"setpoint_window": length, "error_window": length},
        {"eta": 3 / length},
    )


def with_gains(batch: Batch, network: Network, *, slower: bool) -> DirectNNController:
    """Return a batch of these networks, with the default gains or with slower ones."""
    default = DirectNNController()
    factors = network.slower if slower else {}
    gains = {name: factor * getattr(default, name) for name, factor in factors.items()}
    return batch.network(**network.controller, **gains)


def flat(weights: Weights) -> NDArray[np.float32]:
    """Return the weights of each network in one row, shape (runs, n)."""
    arrays = (weights.W, weights.theta_1, weights.W_1, weights.theta_2)
    runs = len(weights.theta_2)
    return np.hstack([array.reshape(runs, -1) for array in arrays]).astype(np.float32)


def converged_at(weights: NDArray[np.floating]) -> Array:
    """Return when weights have converged, in samples, shape (runs,).

    That is the first sample from which on their distance to where they end, by the Euclidean
    norm, is at most `BAND` times the distance they had to travel from their start. Weights that
    get there only in the last `STILL` samples have not converged, which is infinite: the run's
    end might be anywhere on their way. `weights` are those before each sample, shape
    (samples, runs, n).
    """
    distance = np.linalg.norm(weights - weights[-1], axis=2)
    outside = distance > BAND * distance[0]
    samples = len(weights)
    # The first sample of the part at the end that is all inside: counted from behind.
    first = np.where(outside.any(axis=0), samples - np.argmax(outside[::-1], axis=0), 0)
    return np.where(first <= samples - STILL, first, np.inf)


def fail_node(controller: DirectNNController, stuck_at: int, node: int = 0) -> None:
    """Break a hidden node of every network: its output stays at 0 or 1, whatever it is fed."""
    weights = controller.weights
    weights.W[..., node, :] = 0.0
    # So far out on the sigmoid that its slope vanishes, and with it all learning of the node.
    weights.theta_1[..., node] = 1e6 if stuck_at else -1e6
    controller.weights = weights
