"""Measure what single claims are about: converging weights, and the poles of a PI loop."""

from dataclasses import dataclass, field

import numpy as np
from numpy.polynomial.polynomial import polyadd

from agents import DirectNNController, PIController
from benchmarks.claims.runs import Array, Gains
from benchmarks.loop import linear
from mptc_gym import Parameters


@dataclass
class WeightLog:
    """The weights of a batch of networks, logged whenever it is called in a rollout."""

    networks: DirectNNController
    rows: list[Array] = field(default_factory=list)

    def __call__(self, k: int) -> None:
        """Log the weights before sample k, shape (runs, n)."""
        arrays = vars(self.networks.weights).values()
        flat = [array.reshape(len(array), -1) for array in arrays]
        self.rows.append(np.hstack(flat, dtype=np.float32))


def converged_at(weights: Array) -> Array:
    """Return the sample at which weights have converged, shape (runs,).

    This is the first sample from which on their Euclidean distance to their final values is at
    most 5 % of that at the start. It is infinite for weights that come so close only in the
    last 100 samples: they have not converged, as the run might end anywhere on their way.
    `weights` are those before each sample, shape (samples, runs, n).
    """
    distances = np.linalg.norm(weights - weights[-1], axis=2)
    is_outside = distances > 0.05 * distances[0]
    samples = len(weights)
    # One sample after the last one outside; 0 if there is none.
    samples_inside = np.argmax(is_outside[::-1], axis=0)
    first_inside = np.where(is_outside.any(axis=0), samples - samples_inside, 0)
    return np.where(first_inside <= samples - 100, first_inside, np.inf)


def largest_pole(gains: Gains) -> float:
    """Return the modulus of the largest pole of the loop of a PI controller and the plant (28).

    The actuator is left out. The loop is stable if the modulus is below 1.
    """
    numerator, denominator = PIController(*gains).transfer()
    plant = linear.nominal(Parameters())
    a = [1.0, *-plant.alpha]
    b = [*np.zeros(18 + 1), *plant.beta]  # B begins with z^-1, and the delay is 18 samples
    closed_loop: Array = polyadd(np.convolve(denominator, a), np.convolve(numerator, b))
    return float(np.abs(np.roots(closed_loop)).max())
