"""Bound the mean error from below by what no command can counteract in time.

A flow applied at j affects y(j + d + 1) at the earliest, and is chosen without knowledge of
what happens later. So no flow counteracts what d + 1 samples of the noise xi, of the load's
walk and of its jumps do to y(k). With n(k) the sum of their effects,

    e(k) = m(k) - n(k),    m(k): the error if they had no effect, known at k - d - 1.

The linear program needs a lower bound of E|m - n| that is a convex, piecewise linear function
of E[m]. As n has the mean 0, E[m] is the mean of e. For every slope s, and whatever is known
at k - d - 1,

    E[|m - n| given what is known] >= s m + min over x of E[|x - n| - s x given what is known].

The mean over everything that can be known is a line: E|m - n| >= s E[m] + a(s), where a(s) is
the mean of the minima. As the slope is the same in each of them, it does not matter what m
depends on. Three steps lead to a number below a(s) that can be computed:

1. More is assumed to be known than any controller knows: the load up to k - d - 1, its walk
   and its steps apart. *When* the load jumps later is not known, so the same x stands for all
   times of jumps. If the transmitter is noisy, the true output is not assumed to be known:
   given the load, output and readings are jointly normal, and n has the variance of the best
   prediction from the readings (Kalman), whatever they are.
2. What is then known of n is a single number, the level l that the steps of the load have at
   k - d - 1: the first jump takes the level away, and puts a new level in its place. So n is
   the product of l and a random factor, plus a random number that does not depend on l, and
   |x - n| - s x is convex in x and l together. The minimum over x is a convex function of l.
   Thus the mean of the minimum over a slice of levels is at least the minimum at the mean
   level of the slice (Jensen).
3. Each normal or uniform distribution is replaced by atoms, the means of equally probable
   slices. A sum of distributions is reduced to fewer atoms, the means of neighbouring atoms.
   Both make the mean of |x - n| smaller (Jensen).

Then n has finitely many values, and the minimum over x is at one of these values, a quantile.

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

# With these numbers the bounds of the presets are within 0.0002 degC of the bounds that finer
# atoms and slices give.
NOISE_ATOMS = 128  # atoms of the sum of noise and walk
WALK_SLICES = 4  # atoms of each step of the walk
JUMP_ATOMS = 32  # atoms of the effect of a jump and of the jumps after it, with the noise
JUMP_SLICES = 8  # atoms of the new level after a jump
LEVELS = 8  # slices of the level known at k - d - 1, an even number
SMALLEST_VARIANCE = 1e-8  # degC^2: variance of exact readings, so that rounding does no harm
# The slopes of the lines, which touch E|m - n| at quantiles of n. They are closer together
# towards 1, where E|m - n| bends most slowly towards |m|.
SLOPES = 1.0 - np.array([64, 53, 42, 31, 22, 14, 8, 4, 1, 0]) / 64.0


class Distribution(NamedTuple):
    """A distribution of finitely many values for each sample of an episode."""

    values: Array  # degC, shape (samples, atoms)
    weights: Array  # probabilities of the values, shape (samples, atoms)


def unknown(model: LinearModel) -> Unknown:
    """Return the bounds from what remains unknown at each sample of an episode.

    The samples are those of the model, from k = 0 on.
    """
    numbers = model.numbers
    largest_step = np.sqrt(3.0 * LOAD_INTERVAL * numbers.disturbance_walk_variance)
    amplitude = numbers.disturbance_amplitude
    if not (largest_step or amplitude):
        return unknown_of_normal(noise_variance(model))

    changes = load_changes(model)
    noise = _normal(noise_variance(model))
    if largest_step:
        for effect in changes.effects.T:
            step = _uniform(largest_step * effect, WALK_SLICES)
            noise = _sum(noise, step, NOISE_ATOMS)
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
    """Return the variance of the noise in y(k) that is unknown at k - d - 1, degC^2.

    The shape is (samples,). With a noisy transmitter it is the variance of the best prediction
    of y(k) from the readings, without a load.
    """
    if model.numbers.noise_variance == 0.0:
        return np.zeros(len(model.load))
    F, Q = noise_system(model)
    filtered = np.zeros_like(F)  # with a perfect transmitter nothing is uncertain
    if model.numbers.measurement_noise_variance > 0.0:
        filtered = filtered_covariance(F, Q, model.numbers.measurement_noise_variance)
    return predicted_variance(filtered, F, Q, model.lag)


def noise_system(model: LinearModel) -> tuple[Array, Array]:
    """Return F(k) and Q(k) of the state of (28), each of shape (samples, size, size).

    x(k) = F(k) x(k-1) + a noise with the covariance Q(k), which is the effect of xi(k).
    """
    F, enters = model.state_space()
    covariance = model.numbers.noise_variance * np.outer(enters, enters)
    return F, np.broadcast_to(covariance, F.shape)


def filtered_covariance(F: Array, Q: Array, reading_variance: float) -> Array:
    """Return the covariances of the state x(k), given the readings of x_0 up to k (Kalman).

    x(k) = F(k) x(k-1) + a noise with the covariance Q(k), from x(0) = 0. A reading has the
    variance `reading_variance`, degC^2. All arrays have the shape (samples, size, size).
    """
    filtered = np.zeros_like(F)
    P = filtered[0]
    for k in range(1, len(F)):
        P = F[k] @ P @ F[k].T + Q[k]
        innovation_variance = P[0, 0] + max(reading_variance, SMALLEST_VARIANCE)
        P = P - np.outer(P[:, 0], P[0]) / innovation_variance
        filtered[k] = P
    return filtered


def predicted_variance(filtered: Array, F: Array, Q: Array, lag: int) -> Array:
    """Return the variance of x_0(k) given the readings up to k - lag, shape (samples,).

    `filtered` is what `filtered_covariance` returns for F and Q.
    """
    samples = len(F)
    steps = min(lag, samples)
    k = np.arange(samples) - steps
    P = filtered[np.maximum(k, 0)]
    for _ in range(steps):  # for all k together
        k = k + 1
        from_start = np.maximum(k, 0)
        advanced = F[from_start] @ P @ F[from_start].transpose(0, 2, 1) + Q[from_start]
        P = np.where((k >= 1)[:, np.newaxis, np.newaxis], advanced, P)
    # Rounding can leave a variance of 0 a little below it.
    return np.maximum(P[:, 0, 0], 0.0)


class LoadChanges(NamedTuple):
    """The changes of the load within d + 1 samples before k, for each k: unknown at k - d - 1.

    The load can change at k = `LOAD_INTERVAL`, 2 `LOAD_INTERVAL` and so on.
    """

    # What each change adds to y(k), degC for each degC of the load, the latest change first;
    # 0 where there are fewer changes. Shape (samples, largest number of changes).
    effects: Array
    counts: NDArray[np.intp]  # the number of these changes, shape (samples,)
    earlier: NDArray[np.intp]  # the number of changes up to k - d - 1, shape (samples,)


def load_changes(model: LinearModel) -> LoadChanges:
    """Return the changes of the load that are unknown at each sample of an episode."""
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
    earlier = np.maximum(k - model.lag, 0) // LOAD_INTERVAL
    largest_count = -(-min(model.lag, samples) // LOAD_INTERVAL)  # rounded up
    effects = np.stack(
        [responses[k, np.maximum(latest - place, 0)] for place in range(largest_count)], axis=1
    )
    return LoadChanges(effects, latest - earlier, earlier)


def _normal(variance: Array) -> Distribution:
    """Return equally probable atoms of normal distributions with these variances, degC^2."""
    # The atoms are means of slices of the standard normal distribution. They do without
    # scipy.stats, which takes long to import.
    ends = scipy.special.ndtri(np.linspace(0.0, 1.0, NOISE_ATOMS + 1))
    densities = np.exp(-(ends**2) / 2.0) / np.sqrt(2.0 * np.pi)
    values = np.sqrt(variance)[:, np.newaxis] * (-np.diff(densities) * NOISE_ATOMS)
    return Distribution(values, np.full(values.shape, 1.0 / NOISE_ATOMS))


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
    exact = Distribution(values.reshape(samples, -1), weights.reshape(samples, -1))
    return _reduced(exact, atoms)


def _mixture(parts: Sequence[Distribution], probabilities: Sequence[Array]) -> Distribution:
    """Return the mixture of distributions, each with its probabilities, shape (samples,)."""
    weights = [
        probability[:, np.newaxis] * part.weights
        for part, probability in zip(parts, probabilities, strict=True)
    ]
    return Distribution(np.hstack([part.values for part in parts]), np.hstack(weights))


def _sorted(distribution: Distribution) -> Distribution:
    """Return a distribution with the values of each sample in ascending order."""
    # A stable sort is fast where the values are a few ascending rows one after another.
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
    """Return what a jump at each change adds to n(k), with the effects of later jumps.

    The new level adds its effect until the next jump, which takes the level away and adds the
    effect of the next level. The level before the jump does not matter.

    Parameters
    ----------
    effects
        Of `LoadChanges`, degC for each degC, shape (samples, changes), the latest change first.
    amplitude
        New levels are uniform within +-`amplitude`, degC.
    jump
        The probability that the load jumps at a change.

    Returns
    -------
    list of Distribution
        A distribution for each change, in the order of `effects`.
    """
    samples, changes = effects.shape
    distributions: list[Distribution] = []
    for place in range(changes):
        effect = effects[:, place]
        parts = [_uniform(amplitude * effect, JUMP_ATOMS)]  # if no later change is a jump
        probabilities = [np.full(samples, (1.0 - jump) ** place)]
        for next_jump in range(place):
            effect_until_then = effect - effects[:, next_jump]
            level = _uniform(amplitude * effect_until_then, JUMP_SLICES)
            parts.append(_sum(level, distributions[next_jump], JUMP_ATOMS))
            none_between = (1.0 - jump) ** (place - 1 - next_jump)
            probabilities.append(np.full(samples, none_between * jump))
        distributions.append(_reduced(_mixture(parts, probabilities), JUMP_ATOMS))
    return distributions


def _intercepts_with_jumps(
    changes: LoadChanges, noise: Distribution, amplitude: float, jump: float
) -> Array:
    """Return the intercepts if the load jumps, degC, shape (samples, slopes).

    They are means over the level at k - d - 1, which is 0 until the first jump of the episode,
    and uniform within +-`amplitude`, degC, afterwards. `noise` is the distribution of the
    effects of xi and of the walk; `jump` is the probability that the load jumps at a change.
    """
    samples = len(changes.counts)
    # The load does not jump within the d + 1 samples, or one of the changes is the first jump.
    parts = [noise]
    probabilities = [((1.0 - jump) ** changes.counts).astype(np.float64)]
    # What the level at k - d - 1 adds to n(k) in each part, degC for each degC.
    level_effects = [np.zeros(samples)]
    coarse_noise = _reduced(noise, JUMP_ATOMS)
    for place, after_jump in enumerate(_after_jumps(changes.effects, amplitude, jump)):
        parts.append(_sum(coarse_noise, after_jump, JUMP_ATOMS))
        changes_before = changes.counts - 1 - place
        first_jump = jump * (1.0 - jump) ** np.maximum(changes_before, 0)
        probabilities.append(np.where(changes_before >= 0, first_jump, 0.0))
        level_effects.append(-changes.effects[:, place])
    at_level_0 = _mixture(parts, probabilities)
    effect_of_level = np.hstack(
        [
            np.broadcast_to(effect[:, np.newaxis], part.values.shape)
            for effect, part in zip(level_effects, parts, strict=True)
        ]
    )

    # By symmetry, the intercept at the level -l and the slope s is that at l and -s. So only
    # the upper half of the slices is computed, with slopes of both signs.
    both_signs = np.append(SLOPES, -SLOPES)
    half = LEVELS // 2
    levels = amplitude * (np.arange(half) + 0.5) / half
    never_jumped = (1.0 - jump) ** changes.earlier
    intercepts = np.zeros((samples, len(SLOPES)))
    probabilities_of_levels = [never_jumped] + [(1.0 - never_jumped) / half] * half
    for level, probability in zip((0.0, *levels), probabilities_of_levels, strict=True):
        at_level = at_level_0._replace(values=at_level_0.values + level * effect_of_level)
        by_sign = _intercepts(at_level, both_signs).reshape(samples, 2, -1)
        intercepts += probability[:, np.newaxis] * by_sign.mean(axis=1)
    return intercepts


def _intercepts(distribution: Distribution, slopes: Array) -> Array:
    """Return min over x of E|x - n| - s x for each slope s, degC, shape (samples, slopes).

    `distribution` is that of n.
    """
    values, weights = _sorted(distribution)
    probability = weights.cumsum(axis=1)  # that n is not above a value
    partial_mean = (weights * values).cumsum(axis=1)  # what these values add to the mean of n
    mean = partial_mean[:, -1]
    k = np.arange(len(values))
    intercepts = np.empty((len(values), len(slopes)))
    for i, slope in enumerate(slopes):
        # The minimum is at the quantile of probability (1 + s) / 2. As sums are rounded, the
        # quantile may be its neighbour, which is as good.
        below = probability < (1.0 + slope) / 2.0 - 1e-12
        quantile = np.minimum(below.sum(axis=1), values.shape[1] - 1)
        x = values[k, quantile]
        excess = 1.0 + slope - 2.0 * probability[k, quantile]
        intercepts[:, i] = mean - 2.0 * partial_mean[k, quantile] - excess * x
    return intercepts
