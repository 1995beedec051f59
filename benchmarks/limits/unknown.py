"""Bound the mean error from below by what no command can answer in time.

A flow applied at j shows in y(j + d + 1) at the earliest. So the flows that shape y(k) are
chosen at k - d - 1 or before, and cannot answer what happens after that: d + 1 samples of the
noise xi, of the load's walk and of its jumps. With n(k) the sum of what these do to y(k),

    e(k) = m(k) - n(k),    m(k): the error to be expected from what is known at k - d - 1.

The bounds need E|m - n| from below, as a function of m that is convex and piecewise linear.
Three steps lead there; each can only lower the result.

1. More is taken as known than any controller knows: the load w up to k - d - 1, and, for each k
   by itself, when the load jumps within the d + 1 samples, and to which level unless it is the
   last of these jumps. What remains of the load is a sum of uniform numbers: the steps of the
   walk and one level. The true output is not taken as known if the transmitter is noisy: given
   the load, output and readings are jointly normal, and n has the variance of the best
   prediction from the readings (Kalman), whatever is read.
2. Each distribution is replaced by equally probable atoms, the means of its slices. A convex
   function has a smaller mean over these (Jensen within each slice).
3. m may depend on the pattern of the jumps. With the tangent of slope s to E|m - n| in each
   pattern, a_pattern + s m, the mean over the patterns is at least
   sum p_pattern a_pattern + s E[m].

It is loose where the load jumps: about 1 % on the preset "disturbed".
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from benchmarks.loop.linear import Course
from mptc_gym.signals import LOAD_INTERVAL

Array = NDArray[np.float64]

ATOMS = 128  # that stand for a distribution, equally probable
SLICES = 4  # of each uniform one that is added to them
# How many atoms lie below the point where a tangent touches: slopes from 0 to 1.
BELOW = (64, 53, 42, 31, 22, 14, 8, 4, 1, 0)


@dataclass(frozen=True)
class Unknown:
    """Lower bounds of E|m - n|: intercept + slope * |m|, the highest of all slopes."""

    slopes: Array
    """Ascending, from 0 to 1; or 1 alone if nothing is unknown. Shape (slopes,)."""
    intercepts: Array
    """degC, shape (samples, slopes)."""

    def mean_error(self, m: Array) -> Array:
        """Return the bound of E|m - n| for the last len(m) samples, degC."""
        lines = self.intercepts[-len(m) :] + self.slopes * np.abs(m)[:, np.newaxis]
        highest: Array = lines.max(axis=1)
        return highest

    @property
    def lengths(self) -> Array:
        """Of the pieces of |m|, each with its slope, that add up to the bound, like intercepts.

        They end at the corners between the lines.
        """
        ends = np.full(self.intercepts.shape, np.inf)
        corners = -np.diff(self.intercepts, axis=1) / np.diff(self.slopes)
        ends[:, :-1] = np.maximum.accumulate(corners, axis=1)
        return np.diff(ends, axis=1, prepend=0.0)

    def of(self, start: int, stop: int) -> Unknown:
        """Return the same for some samples."""
        return Unknown(self.slopes, self.intercepts[start:stop])


def unknown(course: Course) -> Unknown:
    """Return what remains unknown at each sample of an episode."""
    numbers, samples = course.numbers, len(course.load)
    deviation = np.sqrt(noise_variance(course))
    walk = np.sqrt(3.0 * LOAD_INTERVAL * numbers.disturbance_walk_variance)
    amplitude = numbers.disturbance_amplitude
    # Of the changes of the load in a window, the latest first.
    inside, weights = np.zeros((samples, 0), np.bool_), np.zeros((samples, 0))
    if walk or amplitude:
        inside, weights = _load_weights(course)
    if not deviation.any() and not inside.any():
        return Unknown(np.ones(1), np.zeros((samples, 1)))

    # Means of slices of the standard normal distribution that are equally probable.
    edges = stats.norm.pdf(stats.norm.ppf(np.linspace(0.0, 1.0, ATOMS + 1)))
    atoms = deviation[:, np.newaxis] * (-np.diff(edges) * ATOMS)
    jump = min(1.0, LOAD_INTERVAL / numbers.disturbance_interval) if amplitude else 0.0
    for place in range(weights.shape[1] if walk else 0):
        atoms = _plus_uniform(atoms, walk * weights[:, place])
    probability = np.ones(samples)  # that no later change was a jump
    intercepts = np.zeros((samples, len(BELOW)))
    for place in range(weights.shape[1] if jump else 0):
        jumped = _plus_uniform(atoms, amplitude * weights[:, place])
        here = probability * jump * inside[:, place]
        intercepts += here[:, np.newaxis] * _intercepts(jumped)
        probability = probability - here
    intercepts += probability[:, np.newaxis] * _intercepts(atoms)
    return Unknown(1.0 - 2.0 * np.array(BELOW) / ATOMS, intercepts)


def noise_variance(course: Course) -> Array:
    """Return the variance of the noise in y(k) that is unknown at k - d - 1, degC^2, for all k.

    With a noisy transmitter it is that of the best prediction. At the beginning of an episode
    less noise has come.
    """
    samples = len(course.load)
    R = course.numbers.noise_variance
    V = course.numbers.measurement_noise_variance
    if R == 0.0:
        return np.zeros(samples)
    Phi, enters = course.state_space(course.c)
    Q = R * np.outer(enters, enters)
    known = np.zeros_like(Phi)  # covariance of the state, given all readings
    if V > 0.0:
        P = known[0]
        for k in range(1, samples):
            P = Phi[k] @ P @ Phi[k].T + Q
            P = P - np.outer(P[:, 0], P[0]) / (P[0, 0] + V)
            known[k] = P
    # From k - lag on, one sample after the other, for all k at once.
    lag = min(course.lag, samples)
    at = np.arange(samples) - lag
    P = known[np.maximum(at, 0)]
    for _ in range(lag):
        at = at + 1
        step = Phi[np.maximum(at, 0)]
        moved = step @ P @ step.transpose(0, 2, 1) + Q
        P = np.where((at >= 1)[:, np.newaxis, np.newaxis], moved, P)
    variance: Array = P[:, 0, 0]
    return variance


def _load_weights(course: Course) -> tuple[NDArray[np.bool_], Array]:
    """Return which changes of the load fall into the window of y(k), and what they do to it.

    Both have the shape (samples, most changes in a window), the latest change first: whether
    there is one, and what it adds to y(k) for a unit of the load.
    """
    samples, order = course.alpha.shape
    lag = min(course.lag, samples)
    changes = np.arange(LOAD_INTERVAL, samples, LOAD_INTERVAL)
    # To a unit step at each change, after 0, 1, ... samples.
    answers = np.empty((lag, len(changes)))
    for t in range(lag):
        at = np.minimum(changes + t, samples - 1)
        answers[t] = course.load[at]
        for i in range(min(order, t)):
            answers[t] += course.alpha[at, i] * answers[t - 1 - i]
    k = np.arange(samples)
    weights = np.zeros((samples, -(-lag // LOAD_INTERVAL)))
    inside = np.zeros(weights.shape, np.bool_)
    for place in range(weights.shape[1]):
        change = k // LOAD_INTERVAL - place  # 1 is the first
        after = k - change * LOAD_INTERVAL
        there = (change >= 1) & (after < lag)
        weights[there, place] = answers[after[there], change[there] - 1]
        inside[:, place] = there
    return inside, weights


def _plus_uniform(atoms: Array, half_width: Array) -> Array:
    """Add a uniform number to atoms in ascending order, and make as many atoms of the sum."""
    slices = (np.arange(SLICES) + 0.5) / SLICES * 2.0 - 1.0
    parts = atoms[:, :, np.newaxis] + half_width[:, np.newaxis, np.newaxis] * slices
    parts = np.sort(parts.reshape(len(atoms), -1), axis=1)
    means: Array = parts.reshape(len(atoms), -1, SLICES).mean(axis=2)
    return means


def _intercepts(atoms: Array) -> Array:
    """Return min over m of E|m - n| - s m for each slope s of `BELOW`, degC."""
    # The tangent touches where so many atoms lie below m; above it stand all others.
    sums = np.cumsum(atoms, axis=1)
    sums = np.hstack([np.zeros((len(atoms), 1)), sums])
    below = sums[:, np.array(BELOW)]
    intercepts: Array = (sums[:, -1:] - 2.0 * below) / ATOMS
    return intercepts
