"""Add, mix and simplify discrete probability distributions, one for each sample."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy  # loads its modules on first use
from numpy.typing import NDArray

Array = NDArray[np.float64]

ROUNDING = 1e-12  # largest rounding error of a sum of probabilities


class Distribution(NamedTuple):
    """A discrete probability distribution for each sample of an episode.

    An *atom* is one of the finitely many values of a distribution.
    """

    values: Array  # the atoms, degC, shape (samples, atoms)
    weights: Array  # probabilities of the values, shape (samples, atoms)


def normal(variance: Array, atoms: int) -> Distribution:
    """Return normal distributions with mean 0, approximated by equally probable values.

    Parameters
    ----------
    variance
        Variance of the distribution at each sample, degC^2, shape (samples,).
    atoms
        Number of values that approximate the distribution at each sample.
    """
    # The values are the means of equally probable slices of the standard normal distribution,
    # computed without scipy.stats, which takes long to import.
    ends = scipy.special.ndtri(np.linspace(0.0, 1.0, atoms + 1))
    densities = np.exp(-(ends**2) / 2.0) / np.sqrt(2.0 * np.pi)
    # With the density p(z), the integral of z p(z) is -p(z), and each slice has the probability
    # 1 / atoms.
    means = -np.diff(densities) * atoms
    values = np.sqrt(variance)[:, np.newaxis] * means
    return Distribution(values, np.full(values.shape, 1.0 / atoms))


def uniform(half_width: Array, atoms: int) -> Distribution:
    """Return uniform distributions with mean 0, approximated by equally probable values.

    Parameters
    ----------
    half_width
        Half the width of the distribution at each sample, degC, shape (samples,). The sign of a
        half width has no effect on the distribution.
    atoms
        Number of values that approximate the distribution at each sample.
    """
    # Means of equally long parts of the interval from -1 to 1.
    means = (np.arange(atoms) + 0.5) / atoms * 2.0 - 1.0
    values = half_width[:, np.newaxis] * means
    return Distribution(values, np.full(values.shape, 1.0 / atoms))


def sum_of(first: Distribution, second: Distribution, atoms: int) -> Distribution:
    """Return the distribution of the sum of two independent random numbers, for each sample.

    `atoms`, the number of values of the returned distribution, must divide the number of values
    of `first` times the number of values of `second`.
    """
    samples = len(first.values)
    values = first.values[:, :, np.newaxis] + second.values[:, np.newaxis]
    weights = first.weights[:, :, np.newaxis] * second.weights[:, np.newaxis]
    exact = Distribution(values.reshape(samples, -1), weights.reshape(samples, -1))
    return reduced(exact, atoms)


def mixture(parts: Sequence[Distribution], probabilities: Sequence[Array]) -> Distribution:
    """Return the distribution of a random number that follows one of `parts`, chosen at random.

    For each distribution in `parts`, `probabilities` has an array of shape (samples,): the
    probability, at each sample, that the random number follows this distribution. The values of
    the returned distribution are the values of all distributions in `parts`, in the order of
    `parts`.
    """
    weights = [
        probability[:, np.newaxis] * part.weights
        for part, probability in zip(parts, probabilities, strict=True)
    ]
    return Distribution(np.hstack([part.values for part in parts]), np.hstack(weights))


def in_ascending_order(distribution: Distribution) -> Distribution:
    """Return a distribution with the values of each sample sorted in ascending order."""
    # A stable sort is fast, since the values of a mixture consist of a few ascending sequences.
    order = np.argsort(distribution.values, axis=1, kind="stable")
    values = np.take_along_axis(distribution.values, order, axis=1)
    weights = np.take_along_axis(distribution.weights, order, axis=1)
    return Distribution(values, weights)


def reduced(distribution: Distribution, atoms: int) -> Distribution:
    """Return a distribution in which groups of neighbouring values are replaced by their means.

    `atoms` is the number of values that remain at each sample, a divisor of the number of
    values of `distribution`.
    """
    ascending = in_ascending_order(distribution)
    groups = len(distribution.values), atoms, -1  # shape (samples, groups, values in a group)
    values = ascending.values.reshape(groups)
    weights = ascending.weights.reshape(groups)
    totals = weights.sum(axis=2)
    # A group with the probability 0 gets the value 0.
    means = (values * weights).sum(axis=2) / np.maximum(totals, np.finfo(float).tiny)
    return Distribution(means, totals)


def least_mean_distances(distribution: Distribution, slopes: Array) -> Array:
    """Return the minimum over x of E|x - n| - s x for each random number n and each slope s.

    Parameters
    ----------
    distribution
        Distribution of the random number n at each sample, degC.
    slopes
        Slopes s, numbers from -1 to 1, shape (slopes,).

    Returns
    -------
    ndarray
        Minima, degC, shape (samples, slopes).
    """
    values, weights = in_ascending_order(distribution)
    # For each value: the probability that n is at most this value, and the sum of probability
    # times value over all values up to this value.
    probability = weights.cumsum(axis=1)
    partial_mean = (weights * values).cumsum(axis=1)
    mean = partial_mean[:, -1]  # with all values
    samples, atoms = values.shape
    k = np.arange(samples)
    minima = np.empty((samples, len(slopes)))
    for i, slope in enumerate(slopes):
        # The minimum is at the quantile of n for the probability (1 + s) / 2. Rounding of sums
        # may select a neighbour of the quantile, at which E|x - n| - s x is as small. If x is a
        # value of n, then E|x - n| = mean - 2 partial_mean + (2 probability - 1) x.
        is_below = probability < (1.0 + slope) / 2.0 - ROUNDING
        quantile = np.minimum(is_below.sum(axis=1), atoms - 1)
        x = values[k, quantile]
        excess = 1.0 + slope - 2.0 * probability[k, quantile]
        minima[:, i] = mean - 2.0 * partial_mean[k, quantile] - excess * x
    return minima
