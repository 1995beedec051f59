"""Bound the mean error from below by what no command can counteract in time.

A flow applied at j affects y(j + d + 1) at the earliest, and is chosen without what happens
later. So no flow counteracts d + 1 samples of the noise xi, of the load's walk and of its
jumps. With n(k) the sum of their effects on y(k),

    e(k) = m(k) - n(k),    m(k): the error expected from what is known at k - d - 1.

The bounds need a lower bound of E|m - n| that is a convex, piecewise linear function of m.
Three steps lead to it; each can only lower the result.

1. More is assumed to be known than any controller knows: the load w up to k - d - 1, and, for
   each k by itself, when the load jumps within the d + 1 samples, and to which level, except
   for the level of the last of these jumps. What remains of the load is a sum of uniform
   numbers: the steps of the walk and one level. If the transmitter is noisy, the true output is
   not assumed to be known: given the load, output and readings are jointly normal, and n has
   the variance of the best prediction from the readings (Kalman), whatever they are.
2. Each distribution is replaced by equally probable atoms, the means of its slices. A convex
   function has a smaller mean over these atoms (Jensen within each slice).
3. m may depend on the pattern of the jumps. With the tangent of slope s to E|m - n| in each
   pattern, a_pattern + s m, the mean over them is at least sum p_pattern a_pattern + s E[m].

The bound is loose where the load jumps: by about 1 % on the preset "disturbed".
"""

import numpy as np
import scipy  # loads its modules on first use
from numpy.typing import NDArray

from benchmarks.bounds.linear_program import Unknown, equations
from benchmarks.loop.linear import LinearModel
from mptc_gym.signals import LOAD_INTERVAL

Array = NDArray[np.float64]

ATOMS = 128  # equally probable atoms that represent a distribution
SLICES = 4  # slices of each uniform distribution that is added to the atoms
# Numbers of atoms below the points where the tangents touch, for slopes from 0 to 1.
BELOW = np.array([64, 53, 42, 31, 22, 14, 8, 4, 1, 0])


def unknown(model: LinearModel) -> Unknown:
    """Return the bounds from what remains unknown at each sample of an episode."""
    numbers, samples = model.numbers, len(model.load)
    deviation = np.sqrt(noise_variance(model))
    walk = np.sqrt(3.0 * LOAD_INTERVAL * numbers.disturbance_walk_variance)
    amplitude = numbers.disturbance_amplitude
    weights = _load_weights(model) if walk or amplitude else np.zeros((samples, 0))
    if not deviation.any() and not weights.any():
        return Unknown(np.ones(1), np.zeros((samples, 1)))

    # Means of equally probable slices of the standard normal distribution.
    # Without scipy.stats, which takes long to import.
    ends = scipy.special.ndtri(np.linspace(0.0, 1.0, ATOMS + 1))
    edges = np.exp(-(ends**2) / 2.0) / np.sqrt(2.0 * np.pi)
    atoms = deviation[:, np.newaxis] * (-np.diff(edges) * ATOMS)
    for weight in weights.T if walk else ():
        atoms = _plus_uniform(atoms, walk * weight)
    jump = min(1.0, LOAD_INTERVAL / numbers.disturbance_interval) if amplitude else 0.0
    intercepts = np.zeros((samples, len(BELOW)))
    probability = 1.0  # that no later change was a jump
    for weight in weights.T if jump else ():
        jumped = _plus_uniform(atoms, amplitude * weight)
        intercepts += probability * jump * _intercepts(jumped)
        probability *= 1.0 - jump
    intercepts += probability * _intercepts(atoms)
    return Unknown(1.0 - 2.0 * BELOW / ATOMS, intercepts)


def noise_variance(model: LinearModel) -> Array:
    """Return the variance of the noise in y(k) that is unknown at k - d - 1, degC^2, for all k.

    With a noisy transmitter it is that of the best prediction.
    """
    samples, numbers = len(model.load), model.numbers
    R, V = numbers.noise_variance, numbers.measurement_noise_variance
    if R == 0.0:
        return np.zeros(samples)
    Phi, enters = model.state_space()
    Q = R * np.outer(enters, enters)
    known = np.zeros_like(Phi)  # covariance of the state, given all readings so far
    if V > 0.0:
        P = known[0]
        for k in range(1, samples):
            P = Phi[k] @ P @ Phi[k].T + Q
            P = P - np.outer(P[:, 0], P[0]) / (P[0, 0] + V)
            known[k] = P
    # Predict from k - lag on, sample by sample, for all k at once.
    lag = min(model.lag, samples)
    at = np.arange(samples) - lag
    P = known[np.maximum(at, 0)]
    for _ in range(lag):
        at = at + 1
        step = Phi[np.maximum(at, 0)]
        moved = step @ P @ step.transpose(0, 2, 1) + Q
        P = np.where((at >= 1)[:, np.newaxis, np.newaxis], moved, P)
    variance: Array = P[:, 0, 0]
    return variance


def _load_weights(model: LinearModel) -> Array:
    """Return what each change of the load that is unknown adds to y(k), per unit of the load.

    The shape is (samples, most changes in d + 1 samples), the latest change first; 0 for none.
    """
    samples = len(model.load)
    A, _ = equations(model, samples)
    k, changes = np.arange(samples), np.arange(0, samples, LOAD_INTERVAL)
    after = k[:, np.newaxis] - changes
    # Responses to a unit step at each change. There is none at k = 0.
    steps = model.load[:, np.newaxis] * (after >= 0) * (changes > 0)
    answers = scipy.sparse.linalg.spsolve_triangular(A, steps)
    answers[after >= model.lag] = 0.0
    latest = k // LOAD_INTERVAL
    places = range(-(-min(model.lag, samples) // LOAD_INTERVAL))
    return np.stack([answers[k, np.maximum(latest - place, 0)] for place in places], axis=1)


def _plus_uniform(atoms: Array, half_width: Array) -> Array:
    """Add a uniform number to ascending atoms, and reduce the sum to as many atoms."""
    slices = (np.arange(SLICES) + 0.5) / SLICES * 2.0 - 1.0
    parts = atoms[:, :, np.newaxis] + half_width[:, np.newaxis, np.newaxis] * slices
    parts = np.sort(parts.reshape(len(atoms), -1), axis=1)
    means: Array = parts.reshape(len(atoms), -1, SLICES).mean(axis=2)
    return means


def _intercepts(atoms: Array) -> Array:
    """Return min over m of E|m - n| - s m for each slope s of `BELOW`, degC."""
    # A tangent touches where `BELOW` atoms lie below m, and all others above it.
    sums = np.cumsum(atoms, axis=1)
    below = np.where(BELOW > 0, sums[:, BELOW - 1], 0.0)
    intercepts: Array = (sums[:, -1:] - 2.0 * below) / ATOMS
    return intercepts
