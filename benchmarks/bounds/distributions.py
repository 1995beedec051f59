"""Add, mix and simplify discrete distributions, for all samples of an episode at once."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy  # loads its modules on first use
from numpy.typing import NDArray

Array = NDArray[np.float64]

ROUNDING = 1e-12  # bound of the rounding error of a sum of probabilities


class Distribution(NamedTuple):
    """A discrete distribution for each sample of an episode: finitely many values, or atoms."""

    values: Array  # degC, shape (samples, atoms)
    weights: Array  # probabilities of the values, shape (samples, atoms)


def normal(variance: Array, atoms: int) -> Distribution:
    """Return normal distributions with the mean 0, each as equally probable atoms.

    Parameters
    ----------
    variance
        The variance of each sample's distribution, degC^2, shape (samples,).
    atoms
        Number of atoms of each distribution.
    """
    # The atoms are means of equally probable slices of the standard normal distribution,
    # computed without scipy.stats, which takes long to import.
    ends = scipy.special.ndtri(np.linspace(0.0, 1.0, atoms + 1))
    densities = np.exp(-(ends**2) / 2.0) / np.sqrt(2.0 * np.pi)
    means = -np.diff(densities) * atoms
    values = np.sqrt(variance)[:, np.newaxis] * means
    return Distribution(values, np.full(values.shape, 1.0 / atoms))


def uniform(half_width: Array, atoms: int) -> Distribution:
    """Return uniform distributions with the mean 0, each as equally probable atoms.

    Parameters
    ----------
    half_width
        Half the width of each sample's distribution, degC, shape (samples,). The sign of a half
        width has no meaning.
    atoms
        Number of atoms of each distribution.
    """
    # The means of equal slices of the interval from -1 to 1.
    means = (np.arange(atoms) + 0.5) / atoms * 2.0 - 1.0
    values = half_width[:, np.newaxis] * means
    return Distribution(values, np.full(values.shape, 1.0 / atoms))


def sum_of(first: Distribution, second: Distribution, atoms: int) -> Distribution:
    """Return the distribution of the sum of two independent random numbers, for each sample.

    `atoms` is the number of atoms of the result. The number must divide the product of the
    numbers of atoms of `first` and `second`.
    """
    samples = len(first.values)
    values = first.values[:, :, np.newaxis] + second.values[:, np.newaxis]
    weights = first.weights[:, :, np.newaxis] * second.weights[:, np.newaxis]
    exact = Distribution(values.reshape(samples, -1), weights.reshape(samples, -1))
    return reduced(exact, atoms)


def mixture(parts: Sequence[Distribution], probabilities: Sequence[Array]) -> Distribution:
    """Return the distribution of a random number that comes from one of `parts`, by chance.

    `probabilities` holds the probability of each part, by sample, shape (samples,). The atoms
    of the mixture are the atoms of all parts, in the order of the parts.
    """
    weights = [
        probability[:, np.newaxis] * part.weights
        for part, probability in zip(parts, probabilities, strict=True)
    ]
    return Distribution(np.hstack([part.values for part in parts]), np.hstack(weights))


def in_ascending_order(distribution: Distribution) -> Distribution:
    """Return a distribution with the values of each sample in ascending order."""
    # A stable sort is fast where the values are a few ascending rows one after another.
    order = np.argsort(distribution.values, axis=1, kind="stable")
    values = np.take_along_axis(distribution.values, order, axis=1)
    weights = np.take_along_axis(distribution.weights, order, axis=1)
    return Distribution(values, weights)


def reduced(distribution: Distribution, atoms: int) -> Distribution:
    """Return a distribution with fewer atoms, the means of groups of neighbouring atoms.

    `atoms` is the number of atoms that remain for each sample, a divisor of the number of atoms
    of `distribution`.
    """
    ascending = in_ascending_order(distribution)
    groups = len(distribution.values), atoms, -1  # shape (samples, atoms, atoms of a group)
    values = ascending.values.reshape(groups)
    weights = ascending.weights.reshape(groups)
    totals = weights.sum(axis=2)
    # A group with the probability 0 gets the value 0.
    means = (values * weights).sum(axis=2) / np.maximum(totals, np.finfo(float).tiny)
    return Distribution(means, totals)


def least_mean_distances(distribution: Distribution, slopes: Array) -> Array:
    """Return the minimum over all x of E|x - n| - s x for each slope s and each sample, degC.

    Parameters
    ----------
    distribution
        Distribution of the random number n at each sample, degC.
    slopes
        The slopes s, from -1 to 1, shape (slopes,).

    Returns
    -------
    ndarray
        Shape (samples, slopes).
    """
    values, weights = in_ascending_order(distribution)
    # For each value: the probability that n is at most this value, and the part of the mean of
    # n that comes from such numbers.
    probability = weights.cumsum(axis=1)
    partial_mean = (weights * values).cumsum(axis=1)
    mean = partial_mean[:, -1]
    samples, atoms = values.shape
    k = np.arange(samples)
    minima = np.empty((samples, len(slopes)))
    for i, slope in enumerate(slopes):
        # The minimum is at the quantile of probability (1 + s) / 2. As sums are rounded, the
        # quantile may be its neighbour, where E|x - n| - s x is as small. If x is a value of n,
        # then E|x - n| = mean - 2 partial_mean + (2 probability - 1) x.
        is_below = probability < (1.0 + slope) / 2.0 - ROUNDING
        quantile = np.minimum(is_below.sum(axis=1), atoms - 1)
        x = values[k, quantile]
        excess = 1.0 + slope - 2.0 * probability[k, quantile]
        minima[:, i] = mean - 2.0 * partial_mean[k, quantile] - excess * x
    return minima
