"""Bound the mean error from below by what no command can counteract in time.

A flow applied at j affects y(j + d + 1) at the earliest, and is chosen without knowledge of
what happens later. So no flow counteracts what d + 1 samples of the noise xi, of the load's
walk and of its jumps do to y(k). With n(k) the sum of their effects,

    e(k) = m(k) - n(k),    m(k): the error if they had no effect, known at k - d - 1.

The linear program needs a lower bound of E|m - n| that is a convex, piecewise linear function
of E[m]. As n has the mean 0, E[m] is the mean error. For every slope s, and whatever is known
at k - d - 1,

    E[|m - n| given what is known] >= s m + min over x of E[|x - n| - s x given what is known].

The mean over everything that can be known is a line: E|m - n| >= s E[m] + a(s), where a(s) is
the mean of the minima. As the slope is the same in each of them, it does not matter what m
depends on. Four steps lead to a number below a(s) that can be computed:

1. More is assumed to be known than any controller knows: the load up to k - d - 1, its walk
   and its steps apart. *When* the load jumps later is not known, so the same x stands for all
   times of jumps. If the transmitter is noisy, the true output is not assumed to be known:
   given the load, output and readings are jointly normal, and n has the variance of the best
   prediction from the readings (Kalman), whatever they are.
2. What is then known of n is a single number, the level l that the steps of the load have at
   k - d - 1: the first jump takes it away, and puts a new level in its place. So n is l times
   something plus something that does not depend on l, and |x - n| - s x is convex in x and l
   together. Its minimum over x is a convex function of l. Thus the mean over a slice of levels
   is at least the value at the mean of the slice (Jensen).
3. The normal and uniform distributions that remain are replaced by atoms, the means of their
   slices, and sums of them by fewer atoms, the means of neighbours. The mean of |x - n| becomes
   smaller by this (Jensen).

Then n has finitely many values, and the minimum over x is at one of them, a quantile.

The bound does not count that no controller sees the load itself: see `hidden.py`.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy  # loads its modules on first use
from numpy.typing import NDArray

from benchmarks.bounds.linear_program import Unknown, equations
from benchmarks.loop.linear import LinearModel
from mptc_gym.signals import LOAD_INTERVAL

Array = NDArray[np.float64]

# With these numbers the bounds of the presets are within 0.0002 degC of what finer ones give.
ATOMS = 128  # that represent noise and walk together
WALK_SLICES = 4  # of each step of the walk
JUMP_ATOMS = 32  # that represent the effect of a jump and of those after it, with the noise
JUMP_SLICES = 8  # of the new level after a jump
LEVELS = 8  # slices of the level known at k - d - 1, an even number
NEGLIGIBLE = 1e-8  # degC^2: variance of exact readings, which keeps rounding harmless
# The slopes of the lines, which touch E|m - n| at quantiles of n. They are closer together
# towards 1, where E|m - n| bends most slowly towards |m|.
SLOPES = 1.0 - np.array([64, 53, 42, 31, 22, 14, 8, 4, 1, 0]) / 64.0


class Distribution(NamedTuple):
    """A distribution of finitely many values for each sample of an episode."""

    values: Array
    """degC, shape (samples, atoms)."""
    weights: Array
    """Their probabilities, shape (samples, atoms)."""


def unknown(model: LinearModel) -> Unknown:
    """Return the bounds from what remains unknown at each sample of an episode."""
    numbers = model.numbers
    walk = np.sqrt(3.0 * LOAD_INTERVAL * numbers.disturbance_walk_variance)
    amplitude = numbers.disturbance_amplitude
    if not (walk or amplitude):
        return unknown_of_normal(noise_variance(model))

    changes = load_changes(model)
    noise = _normal(noise_variance(model))
    if walk:
        for effect in changes.effects.T:
            noise = _sum(noise, _uniform(walk * effect, WALK_SLICES), ATOMS)
    if not amplitude:
        return Unknown(SLOPES, _intercepts(noise, SLOPES))
    jump = min(1.0, LOAD_INTERVAL / numbers.disturbance_interval)
    return Unknown(SLOPES, _intercepts_with_jumps(changes, noise, amplitude, jump))


def unknown_of_normal(variance: Array) -> Unknown:
    """Return the bounds if n(k) is normal with these variances, degC^2, shape (samples,)."""
    if not variance.any():
        return Unknown(np.ones(1), np.zeros((len(variance), 1)))
    return Unknown(SLOPES, _intercepts(_normal(variance), SLOPES))


def noise_variance(model: LinearModel) -> Array:
    """Return the variance of the noise in y(k) that is unknown at k - d - 1, degC^2, for all k.

    With a noisy transmitter it is that of the best prediction.
    """
    samples, numbers = len(model.load), model.numbers
    if numbers.noise_variance == 0.0:
        return np.zeros(samples)
    F, enters = model.state_space()
    Q = np.broadcast_to(numbers.noise_variance * np.outer(enters, enters), F.shape)
    known = np.zeros_like(F)  # with a perfect transmitter nothing is uncertain
    if numbers.measurement_noise_variance > 0.0:
        known = filtered_covariance(F, Q, numbers.measurement_noise_variance)
    return predicted_variance(known, F, Q, model.lag)


def filtered_covariance(F: Array, Q: Array, reading_variance: float) -> Array:
    """Return the covariances of the state x(k), given the readings of x_0 up to k (Kalman).

    x(k) = F(k) x(k-1) + a noise with the covariance Q(k), from x(0) = 0. All arrays have the
    shape (samples, size, size).
    """
    filtered = np.zeros_like(F)
    P = filtered[0]
    for k in range(1, len(F)):
        P = F[k] @ P @ F[k].T + Q[k]
        P = P - np.outer(P[:, 0], P[0]) / (P[0, 0] + max(reading_variance, NEGLIGIBLE))
        filtered[k] = P
    return filtered


def predicted_variance(filtered: Array, F: Array, Q: Array, lag: int) -> Array:
    """Return the variance of x_0(k) given the readings up to k - lag, shape (samples,).

    The arguments are those of `filtered_covariance`, and what it returns.
    """
    samples = len(F)
    steps = min(lag, samples)
    k = np.arange(samples) - steps
    P = filtered[np.maximum(k, 0)]
    for _ in range(steps):  # for all k at once
        k = k + 1
        i = np.maximum(k, 0)
        advanced = F[i] @ P @ F[i].transpose(0, 2, 1) + Q[i]
        P = np.where((k >= 1)[:, np.newaxis, np.newaxis], advanced, P)
    # Rounding can leave a variance of 0 a little below it.
    return np.maximum(P[:, 0, 0], 0.0)


class LoadChanges(NamedTuple):
    """The changes of the load within d + 1 samples before each k, unknown at k - d - 1."""

    effects: Array
    """What each of them adds to y(k) per unit of the load, the latest change first, 0 where
    there are fewer. Shape (samples, most changes)."""
    counts: NDArray[np.intp]
    """How many there are, shape (samples,)."""
    before: NDArray[np.intp]
    """How many changes have been up to k - d - 1, shape (samples,)."""


def load_changes(model: LinearModel) -> LoadChanges:
    """Return the changes of the load that are unknown at each sample."""
    samples = len(model.load)
    A, _ = equations(model, samples)
    k = np.arange(samples)
    times = np.arange(0, samples, LOAD_INTERVAL)
    age = k[:, np.newaxis] - times
    # Responses to a unit step at each time. There is no change at k = 0.
    steps = model.load[:, np.newaxis] * (age >= 0) * (times > 0)
    responses = scipy.sparse.linalg.spsolve_triangular(A, steps)
    responses[age >= model.lag] = 0.0
    latest = k // LOAD_INTERVAL
    before = np.maximum(k - model.lag, 0) // LOAD_INTERVAL
    most = -(-min(model.lag, samples) // LOAD_INTERVAL)
    effects = np.stack(
        [responses[k, np.maximum(latest - place, 0)] for place in range(most)], axis=1
    )
    return LoadChanges(effects, latest - before, before)


def _normal(variance: Array) -> Distribution:
    """Return equally probable atoms of normal distributions with these variances, degC^2."""
    # Means of equally probable slices of the standard normal distribution.
    # Without scipy.stats, which takes long to import.
    ends = scipy.special.ndtri(np.linspace(0.0, 1.0, ATOMS + 1))
    densities = np.exp(-(ends**2) / 2.0) / np.sqrt(2.0 * np.pi)
    values = np.sqrt(variance)[:, np.newaxis] * (-np.diff(densities) * ATOMS)
    return Distribution(values, np.full(values.shape, 1.0 / ATOMS))


def _uniform(half_width: Array, slices: int) -> Distribution:
    """Return equally probable atoms of uniform distributions around 0, degC."""
    means = (np.arange(slices) + 0.5) / slices * 2.0 - 1.0
    values = half_width[:, np.newaxis] * means
    return Distribution(values, np.full(values.shape, 1.0 / slices))


def _sum(first: Distribution, second: Distribution, atoms: int) -> Distribution:
    """Return the distribution of the sum of two independent numbers, reduced to `atoms`."""
    samples = len(first.values)
    values = first.values[:, :, np.newaxis] + second.values[:, np.newaxis]
    weights = first.weights[:, :, np.newaxis] * second.weights[:, np.newaxis]
    together = Distribution(values.reshape(samples, -1), weights.reshape(samples, -1))
    return _reduced(together, atoms)


def _mixture(parts: Sequence[Distribution], probabilities: Sequence[Array]) -> Distribution:
    """Return the distribution that is each of the parts with its probability, (samples,)."""
    weights = [
        probability[:, np.newaxis] * part.weights
        for part, probability in zip(parts, probabilities, strict=True)
    ]
    return Distribution(np.hstack([part.values for part in parts]), np.hstack(weights))


def _sorted(distribution: Distribution) -> Distribution:
    """Return a distribution with its values in ascending order."""
    # Stable, as that is fast where the values are a few ascending rows one after another.
    order = np.argsort(distribution.values, axis=1, kind="stable")
    return Distribution(*(np.take_along_axis(array, order, 1) for array in distribution))


def _reduced(distribution: Distribution, atoms: int) -> Distribution:
    """Replace neighbouring values by their means, so that `atoms` values remain."""
    samples = len(distribution.values)
    values, weights = (array.reshape(samples, atoms, -1) for array in _sorted(distribution))
    totals = weights.sum(axis=2)
    means = (values * weights).sum(axis=2) / np.maximum(totals, np.finfo(float).tiny)
    return Distribution(means, totals)


def _after_jumps(effects: Array, amplitude: float, jump: float) -> list[Distribution]:
    """Return what a jump at each change adds to n(k), with all that happens after it.

    The new level adds its effect until the next jump, which takes the level away and adds what
    follows it. None of this depends on the level before. The order is that of `effects`.
    """
    samples, most = effects.shape
    distributions: list[Distribution] = []
    for place in range(most):  # the latest change first
        effect = effects[:, place]
        last = _uniform(amplitude * effect, JUMP_ATOMS)  # if no later change is a jump
        parts, probabilities = [last], [np.full(samples, (1.0 - jump) ** place)]
        for following in range(place):
            until = effect - effects[:, following]
            level = _uniform(amplitude * until, JUMP_SLICES)
            parts.append(_sum(level, distributions[following], JUMP_ATOMS))
            no_earlier = (1.0 - jump) ** (place - 1 - following)
            probabilities.append(np.full(samples, no_earlier * jump))
        distributions.append(_reduced(_mixture(parts, probabilities), JUMP_ATOMS))
    return distributions


def _intercepts_with_jumps(
    changes: LoadChanges, noise: Distribution, amplitude: float, jump: float
) -> Array:
    """Return the mean of the intercepts over the level at k - d - 1, degC.

    `noise` is that of xi and the walk; `jump` is the probability of a jump at a change. The
    level is 0 until the first jump of the episode, and uniform within +-`amplitude` afterwards.
    """
    samples = len(changes.counts)
    # The load does not jump within the d + 1 samples, or one of the changes is the first jump.
    parts = [noise]
    probabilities = [((1.0 - jump) ** changes.counts).astype(np.float64)]
    level_effects = [np.zeros(samples)]  # of the level at k - d - 1 on n(k), degC per degC
    fewer = _reduced(noise, JUMP_ATOMS)
    for place, after in enumerate(_after_jumps(changes.effects, amplitude, jump)):
        parts.append(_sum(fewer, after, JUMP_ATOMS))
        earlier = changes.counts - 1 - place
        first = jump * (1.0 - jump) ** np.maximum(earlier, 0)
        probabilities.append(np.where(earlier >= 0, first, 0.0))
        level_effects.append(-changes.effects[:, place])
    at_level_0 = _mixture(parts, probabilities)
    of_level = np.hstack(
        [
            np.broadcast_to(effect[:, np.newaxis], part.values.shape)
            for effect, part in zip(level_effects, parts, strict=True)
        ]
    )

    # By symmetry, the intercept of -l at the slope s is that of l at -s.
    both_signs = np.append(SLOPES, -SLOPES)
    half = LEVELS // 2
    levels = amplitude * (np.arange(half) + 0.5) / half
    never_jumped = (1.0 - jump) ** changes.before
    intercepts = np.zeros((samples, len(SLOPES)))
    for level in (0.0, *levels):
        at_level = at_level_0._replace(values=at_level_0.values + level * of_level)
        of_signs = _intercepts(at_level, both_signs).reshape(samples, 2, -1)
        probability = never_jumped if level == 0.0 else (1.0 - never_jumped) / half
        intercepts += probability[:, np.newaxis] * of_signs.mean(axis=1)
    return intercepts


def _intercepts(distribution: Distribution, slopes: Array) -> Array:
    """Return min over x of E|x - n| - s x for each slope s, degC, shape (samples, slopes)."""
    values, weights = _sorted(distribution)
    probability = weights.cumsum(axis=1)  # of n not above a value
    partial_mean = (weights * values).cumsum(axis=1)  # what these add to the mean of n
    mean = partial_mean[:, -1]
    k = np.arange(len(values))
    intercepts = np.empty((len(values), len(slopes)))
    for i, slope in enumerate(slopes):
        # The minimum is at the quantile of probability (1 + s) / 2. As sums are rounded, the
        # quantile may be its neighbour, which is as good.
        below = probability < (1.0 + slope) / 2.0 - 1e-12
        quantile = np.minimum(below.sum(axis=1), values.shape[1] - 1)
        x = values[k, quantile]
        above = 1.0 + slope - 2.0 * probability[k, quantile]
        intercepts[:, i] = mean - 2.0 * partial_mean[k, quantile] - above * x
    return intercepts
