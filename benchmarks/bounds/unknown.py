"""Bound the mean error from below by what no command can counteract in time.

The plant is equation (28) of the paper, A(z^-1) y(k) = B(z^-1) u_a(k - d) + C(z^-1) xi(k), with
the output y, the flow u_a, the delay d and the white noise xi. A load disturbance w(k) adds
A(1) w(k) to the right side. The load is the sum of a random walk and of a piecewise constant
part, whose changes are called *jumps*.

A flow applied at sample j affects y(j + d + 1) at the earliest, and is chosen without knowledge
of what happens after j. So no flow counteracts what the last d + 1 samples of the noise xi, of
the load's walk and of the load's jumps do to y(k). Let n(k) be the sum of these effects, degC.
The error is

    e(k) = m(k) - n(k),    m(k): the error that there would be with n(k) = 0.

The number m(k) is known at the sample k - d - 1. The linear program in `linear_program.py`
needs a lower bound of E|m - n| that is a convex, piecewise linear function of E[m]. As n has
the mean 0, E[m] is the mean of e. For every slope s, and whatever is known at k - d - 1,

    E[|m - n| given what is known] >= s m + min over x of E[|x - n| - s x given what is known].

The mean of the inequality over everything that can be known is a line in E[m]:
E|m - n| >= s E[m] + a(s), where the intercept a(s) is the mean of the minima over x. As the
slope s is the same in all minima, the line is valid whatever m depends on. Three steps lead to
a number below a(s) that can be computed:

1. More is assumed to be known than any controller knows: the load up to the sample k - d - 1,
   as its walk and its piecewise constant part. *When* the load jumps after k - d - 1 is not
   known, so the minimum is over a single x for all times of jumps. If the transmitter is noisy,
   the true output is not assumed to be known: for a known load, output and readings are jointly
   normal, and the noise in n has the variance of the best prediction of the output from the
   readings (Kalman filter), whatever the readings are.
2. The distribution of n then depends on a single known number, the level l of the piecewise
   constant load at k - d - 1, as the first jump replaces l by a new level. So n is the product
   of l and a random factor, plus a random number that does not depend on l, and |x - n| - s x
   is convex in x and l together. Therefore the minimum over x is a convex function of l, and
   the mean of the minimum over a slice of levels is at least the minimum at the mean level of
   the slice (Jensen's inequality).
3. Each normal or uniform distribution is replaced by atoms, the means of equally probable
   slices. A sum of distributions is reduced to fewer atoms, the means of neighbouring atoms.
   Both replacements make the mean of |x - n| smaller (Jensen's inequality).

After step 3, n has finitely many values, and the minimum over x is at one of them, a quantile.

The bound does not count that no controller can measure the load: see `hidden.py`.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy  # loads its modules on first use
from numpy.typing import NDArray

from benchmarks.bounds.linear_program import Unknown, equations
from benchmarks.loop.linear import LinearModel
from mptc_gym.plant.signals import LOAD_INTERVAL

Array = NDArray[np.float64]

# Numbers of atoms and slices that represent distributions. With more atoms and slices, the
# bounds of the environment's presets would change by at most 0.0002 degC.
NOISE_ATOMS = 128  # atoms of the sum of the effects of the noise xi and of the load's walk
WALK_SLICES = 4  # atoms of each step of the load's walk
JUMP_ATOMS = 32  # atoms of the effect of a jump and of later jumps, and of noise in their sum
JUMP_SLICES = 8  # atoms of the new level of the load after a jump
LEVELS = 8  # slices of the load's level that is known at k - d - 1; an even number
# Variance of the readings of a perfect transmitter, degC^2; 0 would divide by 0 in the filter.
SMALLEST_VARIANCE = 1e-8
# Slopes s of the lines that bound E|m - n|; each line touches E|m - n| at a quantile of n. The
# slopes are closer together near 1, as E|m - n| approaches |m| slowly.
SLOPES = 1.0 - np.array([64, 53, 42, 31, 22, 14, 8, 4, 1, 0]) / 64.0


class Distribution(NamedTuple):
    """A discrete distribution for each sample of an episode: finitely many values, or atoms."""

    values: Array  # degC, shape (samples, atoms)
    weights: Array  # probabilities of the values, shape (samples, atoms)


def unknown(model: LinearModel) -> Unknown:
    """Return the lower bounds of E|m(k) - n(k)| for each sample of an episode.

    Here n(k) is the effect on the output of noise and load that no flow can counteract in time,
    and m(k) the error without n(k); see the description of the module.

    Parameters
    ----------
    model
        One plant with the linear equation (28) of the paper, for the samples k = 0, 1, ... of
        an episode.
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
    """Return the lower bounds of E|m(k) - n(k)| for a normal n(k) with the mean 0.

    `variance` holds the variance of n(k), degC^2, for each sample, shape (samples,).
    """
    if not variance.any():
        return Unknown(np.ones(1), np.zeros((len(variance), 1)))
    return Unknown(SLOPES, _intercepts(_normal(variance), SLOPES))


def noise_variance(model: LinearModel) -> Array:
    """Return the variance of that part of the noise in y(k) that is unknown at k - d - 1.

    Here d is the delay of the plant, samples. If the transmitter is noisy, the variance is that
    of the best prediction of the output y(k) of a plant without a load, from the transmitter's
    readings up to k - d - 1. The unit is degC^2, and the shape (samples,), for the samples of
    `model`, a plant.
    """
    if model.numbers.noise_variance == 0.0:
        return np.zeros(len(model.load))
    F, Q = noise_system(model)
    filtered = np.zeros_like(F)  # with a perfect transmitter nothing is uncertain
    if model.numbers.measurement_noise_variance > 0.0:
        filtered = filtered_covariance(F, Q, model.numbers.measurement_noise_variance)
    return predicted_variance(filtered, F, Q, model.lag)


def noise_system(model: LinearModel) -> tuple[Array, Array]:
    """Return F(k) and Q(k) of a state-space form of equation (28) of the paper with u_a = 0.

    The state is x(k) = F(k) x(k-1) + v(k), where v(k) is white with the covariance Q(k), the
    effect of the noise xi(k). The output y(k), degC, is the first element of x(k). F and Q have
    the shape (samples, size, size), for the samples of `model`, a plant.
    """
    F, enters = model.state_space()
    covariance = model.numbers.noise_variance * np.outer(enters, enters)
    return F, np.broadcast_to(covariance, F.shape)


def filtered_covariance(F: Array, Q: Array, reading_variance: float) -> Array:
    """Return the covariances of the state x(k), given all readings up to k (Kalman filter).

    Parameters
    ----------
    F, Q
        x(k) = F(k) x(k-1) + v(k), where x(0) = 0 and v(k) is white with the covariance Q(k).
        Both have the shape (samples, size, size).
    reading_variance
        A reading is the first element of x(k) plus white noise with this variance, degC^2.

    Returns
    -------
    ndarray
        Covariances of x(k), shape (samples, size, size).
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
    """Return the variance of the output y(k), given the readings up to k - lag, degC^2.

    Parameters
    ----------
    filtered
        Covariances of the state x(k) given the readings up to k, as `filtered_covariance`
        returns them for F and Q, shape (samples, size, size).
    F, Q
        x(k) = F(k) x(k-1) + v(k), where v(k) is white with the covariance Q(k), and the first
        element of x(k) is y(k).
    lag
        Number of samples to predict ahead.

    Returns
    -------
    ndarray
        Shape (samples,). Before k = lag, the state at k = 0 is taken for known.
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
    """For each sample k, the changes of the load that are not yet known at k - d - 1.

    Here d is the delay of the plant, samples. The load can change at the samples
    `LOAD_INTERVAL`, 2 `LOAD_INTERVAL` and so on. The unknown changes are those at the samples
    from k - d to k.
    """

    # Change of y(k), degC, for a change of the load by 1 degC, by the place of the change: the
    # latest unknown change comes first. The effect is 0 where there are fewer changes. Shape
    # (samples, largest number of unknown changes).
    effects: Array
    counts: NDArray[np.intp]  # the number of unknown changes, shape (samples,)
    earlier: NDArray[np.intp]  # the number of changes up to k - d - 1, shape (samples,)


def load_changes(model: LinearModel) -> LoadChanges:
    """Return the changes of the load that come too late for a flow to counteract them.

    `model` is a plant, whose samples are those of an episode from k = 0 on.
    """
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
    """Return normal distributions with the mean 0, each as `NOISE_ATOMS` equal atoms.

    `variance` holds the variance of each sample's distribution, degC^2, shape (samples,).
    """
    # The atoms are means of equally probable slices of the standard normal distribution,
    # computed without scipy.stats, which takes long to import.
    ends = scipy.special.ndtri(np.linspace(0.0, 1.0, NOISE_ATOMS + 1))
    densities = np.exp(-(ends**2) / 2.0) / np.sqrt(2.0 * np.pi)
    values = np.sqrt(variance)[:, np.newaxis] * (-np.diff(densities) * NOISE_ATOMS)
    return Distribution(values, np.full(values.shape, 1.0 / NOISE_ATOMS))


def _uniform(half_width: Array, slices: int) -> Distribution:
    """Return uniform distributions around 0, each as `slices` equally probable atoms.

    `half_width` holds half the width of each sample's distribution, degC, shape (samples,). A
    negative half width stands for its magnitude.
    """
    means = (np.arange(slices) + 0.5) / slices * 2.0 - 1.0
    values = half_width[:, np.newaxis] * means
    return Distribution(values, np.full(values.shape, 1.0 / slices))


def _sum(first: Distribution, second: Distribution, atoms: int) -> Distribution:
    """Return the distribution of the sum of two independent random numbers, for each sample.

    The sum is reduced to `atoms` atoms, a divisor of the number of all sums.
    """
    samples = len(first.values)
    values = first.values[:, :, np.newaxis] + second.values[:, np.newaxis]
    weights = first.weights[:, :, np.newaxis] * second.weights[:, np.newaxis]
    exact = Distribution(values.reshape(samples, -1), weights.reshape(samples, -1))
    return _reduced(exact, atoms)


def _mixture(parts: Sequence[Distribution], probabilities: Sequence[Array]) -> Distribution:
    """Return the mixture of `parts` for each sample of an episode.

    `probabilities` holds the weight of each part in the mixture, by sample, shape (samples,).
    """
    weights = [
        probability[:, np.newaxis] * part.weights
        for part, probability in zip(parts, probabilities, strict=True)
    ]
    return Distribution(np.hstack([part.values for part in parts]), np.hstack(weights))


def _sorted(distribution: Distribution) -> Distribution:
    """Return the same distribution with the values of each sample in ascending order."""
    # A stable sort is fast where the values are a few ascending rows one after another.
    order = np.argsort(distribution.values, axis=1, kind="stable")
    return Distribution(*(np.take_along_axis(array, order, 1) for array in distribution))


def _reduced(distribution: Distribution, atoms: int) -> Distribution:
    """Return a distribution in which groups of neighbouring values are replaced by their means.

    For each sample, `atoms` values remain, which must divide the number of values before.
    """
    samples = len(distribution.values)
    values, weights = (array.reshape(samples, atoms, -1) for array in _sorted(distribution))
    totals = weights.sum(axis=2)
    means = (values * weights).sum(axis=2) / np.maximum(totals, np.finfo(float).tiny)
    return Distribution(means, totals)


def _after_jumps(effects: Array, amplitude: float, jump: float) -> list[Distribution]:
    """Return the distribution of what a jump of the load and all later jumps add to n(k).

    Here n(k) is the effect on y(k) of what cannot be counteracted in time. After a jump, the
    load has a new level until the next jump, which replaces this level by another one. The
    effect of the level before the first jump is not included.

    Parameters
    ----------
    effects
        The field of `LoadChanges`: change of y(k), degC for each degC of the load, shape
        (samples, changes), the latest change first.
    amplitude
        New levels of the load are uniformly distributed within +-`amplitude`, degC.
    jump
        The probability that the load jumps at one of the samples at which it can change.

    Returns
    -------
    list of Distribution
        A distribution for the first jump at each of the changes, in the order of `effects`.
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
    """Return the intercepts a(s) of the bounds of E|m - n| for a load with jumps.

    The intercepts are means over the load's level at k - d - 1, for the plant's delay d. The
    level is 0 until the first jump of the episode, and uniformly distributed after it.

    Parameters
    ----------
    changes
        The changes of the load that are unknown at k - d - 1.
    noise
        Distribution of the effect of the noise xi and of the load's walk on y(k), degC.
    amplitude
        Levels of the load are uniformly distributed within +-`amplitude`, degC.
    jump
        The probability that the load jumps at one of the samples at which it can change.

    Returns
    -------
    ndarray
        The intercepts for `SLOPES`, degC, shape (samples, slopes).
    """
    samples = len(changes.counts)
    # The load does not jump within the d + 1 samples, or one of the changes is the first jump.
    parts = [noise]
    probabilities = [((1.0 - jump) ** changes.counts).astype(np.float64)]
    # What the level at k - d - 1 adds to n(k) in each part, degC for each degC of the level.
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
    """Return the minimum over x of E|x - n| - s x for each slope s and each sample, degC.

    Parameters
    ----------
    distribution
        Distribution of the random number n at each sample.
    slopes
        The slopes s, from -1 to 1, shape (slopes,).

    Returns
    -------
    ndarray
        Shape (samples, slopes).
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
