"""Bound the mean absolute error from below by the effects that no flow can counteract in time.

The plant is equation (28) of the paper, A(z^-1) y(k) = B(z^-1) u_a(k - d) + C(z^-1) xi(k), with
the output y, the flow u_a, the delay d and the white noise xi. A load w(k) adds A(1) w(k) to
the right side of equation (28) of the paper. The load is the sum of a random walk and of a
piecewise constant part, whose changes are called *jumps*. If the first coefficients of B are 0,
they count as a part of the delay d in this module, so d + 1 is always `LinearModel.lag`.

A flow at sample j affects the output y(j + d + 1) at the earliest. So no flow counteracts the
effects on y(k) of noise, random walk and jumps after the sample k - d - 1. Let n(k) be the sum
of the effects on y(k) that no flow counteracts, degC, and let m(k) be the error at sample k if
n(k) were 0. The error is

    e(k) = m(k) - n(k).

The number m(k) is known at sample k - d - 1, and the random number n(k) has the mean 0, so E[e]
= E[m]. The linear program in `linear_program.py` needs a lower bound of E|e| that is a convex,
piecewise linear function of the expected error E[e]. Let K be everything that a controller
knows at sample k - d - 1. For every slope s from -1 to 1, the mean of the error |e| = |m - n|,
given K, is at least s m plus the minimum of E[|x - n| - s x given K] over all numbers x. The
mean over K gives E|e| >= s E[e] + a(s), a lower bound of E|e| that is a line in E[e], where the
intercept a(s) is the mean over K of the minimum over x of E[|x - n| - s x given K]. Three steps
lead to a computable lower bound of the intercept a(s):

1. K is assumed to contain more than any controller knows: the random walk and the piecewise
   constant part of the load up to sample k - d - 1. K does not contain the times of jumps after
   sample k - d - 1, so a single x applies to all possible times of these jumps. If the
   transmitter is noisy, K contains the transmitter's readings, but not the true output. For a
   known load, the output and the readings are jointly normal, so the noise in n(k) has the
   variance of the error of the best prediction of the output from the readings (Kalman filter).
2. Given K, the distribution of n(k) depends only on the level l, which is the piecewise
   constant part of the load at sample k - d - 1. The first jump after sample k - d - 1 replaces
   the level l by a new level. So n(k) is the product of the level l and a random factor, plus a
   random number that does not depend on l. Therefore |x - n(k)| - s x is convex in x and l
   together, and the minimum over x of the mean of |x - n(k)| - s x is a convex function of l.
   The mean of a convex function over a slice of levels is at least the value of the function at
   the mean level of the slice (Jensen's inequality).
3. Each normal or uniform distribution is replaced by the means of equally probable slices of
   the distribution. In the distribution of a sum of random numbers, groups of neighbouring
   values are replaced by their means. Replacing values of n(k) by their mean never makes the
   mean of |x - n(k)| larger (Jensen's inequality).

After step 3, the random number n(k) has finitely many values, and the minimum over x of E[|x -
n| - s x given K] is at one of these values, a quantile of n(k).
"""

import math
from typing import NamedTuple

import numpy as np
import scipy  # loads its modules on first use
from numpy.typing import NDArray

from benchmarks.bounds.distributions import (
    Distribution,
    least_mean_distances,
    mixture,
    normal,
    reduced,
    sum_of,
    uniform,
)
from benchmarks.bounds.linear_program import ErrorBounds, equations
from benchmarks.bounds.prediction import noise_variance
from benchmarks.loop.linear import LinearModel
from mptc_gym.plant.signals import LOAD_INTERVAL

Array = NDArray[np.float64]

# Numbers of atoms, which are the values of discrete distributions. With more atoms, the bounds
# of the environment's presets would change by at most 0.0002 degC.
NOISE_ATOMS = 128  # for the effects of the noise xi and of the load's walk
WALK_ATOMS = 4  # for each step of the load's walk
JUMP_ATOMS = 32  # for the effect of a jump and all later jumps
JUMP_LEVEL_ATOMS = 8  # for the new level of the load after a jump
KNOWN_LEVEL_ATOMS = 8  # for the load's level at sample k - d - 1; an even number
# Slopes s of the lines that bound the mean error. The slopes are closer together near 1, since
# the mean error approaches the magnitude of the expected error slowly.
SLOPES = 1.0 - np.array([64, 53, 42, 31, 22, 14, 8, 4, 1, 0]) / 64.0


def error_bounds(model: LinearModel) -> ErrorBounds:
    """Return the lower bounds of the mean errors that noise and load cause, for each sample.

    The docstring of the module derives the lower bounds of the mean errors, which assume that
    the controller knows the load up to sample k - d - 1, where d + 1 is `model.lag`. No flow
    can counteract the effects of noise and load in the last d + 1 samples.

    Parameters
    ----------
    model
        One plant at the samples k = 0, 1, ... of an episode.
    """
    numbers = model.numbers
    # The steps of the load's walk are uniformly distributed between -largest_step and
    # largest_step, degC, so their variance is largest_step^2 / 3. As a step happens once per
    # LOAD_INTERVAL samples, its variance is also LOAD_INTERVAL times the variance per sample.
    largest_step = np.sqrt(3.0 * LOAD_INTERVAL * numbers.disturbance_walk_variance)
    amplitude = numbers.disturbance_amplitude
    variance = noise_variance(model)
    if not (variance.any() or largest_step or amplitude):
        return ErrorBounds(np.ones(1), np.zeros((len(variance), 1)))
    changes = load_changes(model)
    noise = normal(variance, NOISE_ATOMS)
    if largest_step:
        for effect in changes.effects.T:  # of a step of the walk at one change of the load
            step = uniform(largest_step * effect, WALK_ATOMS)
            noise = sum_of(noise, step, NOISE_ATOMS)
    if not amplitude:
        return ErrorBounds(SLOPES, least_mean_distances(noise, SLOPES))
    jump_probability = min(1.0, LOAD_INTERVAL / numbers.disturbance_interval)
    intercepts = _intercepts_with_jumps(changes, noise, amplitude, jump_probability)
    return ErrorBounds(SLOPES, intercepts)


class LoadChanges(NamedTuple):
    """The changes of the load that happen too late for any flow to counteract them at y(k).

    The flow at sample k - d - 1 is the last flow that can affect the output y(k), where d + 1
    is `LinearModel.lag`. The changes of the load at the samples from k - d to k are unknown to
    a controller at sample k - d - 1. The load can change at every sample above 0 whose number
    is a multiple of `LOAD_INTERVAL`.
    """

    # Row k: effects on y(k), degC, of changes of the load by 1 degC that happen from sample k -
    # d to k, beginning with the latest change. The effect is 0 in columns that sample k does
    # not need. Shape (samples, largest number of changes).
    effects: Array
    # Number of times at which the load can change from sample k - d to k, shape (samples,).
    counts: NDArray[np.intp]
    # Number of times at which the load can change up to sample k - d - 1, shape (samples,).
    known_counts: NDArray[np.intp]


def load_changes(model: LinearModel) -> LoadChanges:
    """Return the changes of the load that no flow can counteract in time, for each sample.

    `model` is one plant at the samples k = 0, 1, ... of an episode.
    """
    samples = len(model.load_factor)
    k = np.arange(samples)
    times = np.arange(0, samples, LOAD_INTERVAL)
    ages = k[:, np.newaxis] - times  # number of samples from each of `times` to k
    # Row k, column i: the effect on y(k), degC, of a change of the load by 1 degC at times[i].
    # The load does not change at the first time, k = 0.
    steps = model.load_factor[:, np.newaxis] * (ages >= 0) * (times > 0)
    A, _ = equations(model, samples)
    responses = scipy.sparse.linalg.spsolve_triangular(A, steps)
    responses[ages >= model.lag] = 0.0  # A flow can counteract these changes in time.
    changes = k // LOAD_INTERVAL  # number of changes up to k
    known_changes = np.maximum(k - model.lag, 0) // LOAD_INTERVAL
    largest_count = math.ceil(min(model.lag, samples) / LOAD_INTERVAL)
    effects = np.empty((samples, largest_count))
    for place in range(largest_count):  # Column 0 is for the latest change.
        # Column 0 of `responses` is 0, so it stands for changes that do not exist.
        effects[:, place] = responses[k, np.maximum(changes - place, 0)]
    return LoadChanges(effects, changes - known_changes, known_changes)


def _after_jumps(
    effects: Array, amplitude: float, jump_probability: float
) -> list[Distribution]:
    """Return the distributions of the effect on y(k) of a jump of the load and all later jumps.

    Item i of the returned list is the distribution of the effect on y(k) if the first jump is
    at the change of the load to which column i of `effects` belongs. The load keeps a new level
    until the next jump. The returned distributions leave out the effect of the load's level
    before the first jump.

    Parameters
    ----------
    effects
        Effect on y(k), degC, of a change of the load by 1 degC, shape (samples, changes), with
        the latest change in column 0.
    amplitude
        Largest magnitude of a new level of the load, degC; levels are uniformly distributed.
    jump_probability
        Probability that the load jumps at a sample that is a multiple of `LOAD_INTERVAL`.
    """
    samples, changes = effects.shape
    no_jump_probability = 1.0 - jump_probability
    distributions: list[Distribution] = []
    for place in range(changes):
        effect = effects[:, place]
        # Either no jump follows, or the next jump is at one of the later changes.
        parts = [uniform(amplitude * effect, JUMP_ATOMS)]
        probabilities = [np.full(samples, no_jump_probability**place)]
        for next_jump in range(place):
            effect_until_then = effect - effects[:, next_jump]
            level = uniform(amplitude * effect_until_then, JUMP_LEVEL_ATOMS)
            parts.append(sum_of(level, distributions[next_jump], JUMP_ATOMS))
            no_jump_between = no_jump_probability ** (place - 1 - next_jump)
            probabilities.append(np.full(samples, no_jump_between * jump_probability))
        distributions.append(reduced(mixture(parts, probabilities), JUMP_ATOMS))
    return distributions


def _effects_on_output(
    changes: LoadChanges, noise: Distribution, amplitude: float, jump_probability: float
) -> tuple[Distribution, Array]:
    """Return the distribution of n(k), the effect on y(k) that no flow can counteract in time.

    The distribution of n(k), degC, depends on the level l, degC, of the load's piecewise
    constant part at sample k - d - 1, where d + 1 is `LinearModel.lag`. The parameters are
    those of `_intercepts_with_jumps`.

    Returns
    -------
    at_level_0 : Distribution
        Distribution of the effect n(k) on y(k) if the load has the level 0 degC at sample
        k - d - 1.
    effect_of_level : Array
        Increase of each value of `at_level_0`, degC, if the load has the level 1 degC in place
        of 0 degC at sample k - d - 1, shape (samples, atoms).
    """
    no_jump_probability = 1.0 - jump_probability
    # Either the load does not jump after sample k - d - 1, or the first jump is at one of the
    # times to which the columns of `changes.effects` belong.
    parts = [noise]
    probabilities: list[Array] = [no_jump_probability ** changes.counts.astype(np.float64)]
    effects_of_level = [np.zeros_like(noise.values)]
    coarse_noise = reduced(noise, JUMP_ATOMS)  # `sum_of` would take long with all atoms
    after_jumps = _after_jumps(changes.effects, amplitude, jump_probability)
    for place, after_jump in enumerate(after_jumps):
        part = sum_of(coarse_noise, after_jump, JUMP_ATOMS)
        # Column 0 belongs to the latest change, so the columns after `place` are earlier ones.
        earlier_changes = changes.counts - 1 - place
        probability = jump_probability * no_jump_probability ** np.maximum(earlier_changes, 0)
        effect = -changes.effects[:, place, np.newaxis]  # The first jump ends the level l.
        parts.append(part)
        probabilities.append(np.where(earlier_changes >= 0, probability, 0.0))
        effects_of_level.append(np.broadcast_to(effect, part.values.shape))
    return mixture(parts, probabilities), np.hstack(effects_of_level)


def _intercepts_with_jumps(
    changes: LoadChanges, noise: Distribution, amplitude: float, jump_probability: float
) -> Array:
    """Return intercepts of lines below the mean errors if the load jumps, degC.

    The result has the shape (samples, slopes): for each sample k and each slope s in `SLOPES`,
    it has the intercept a(s) of the line s E[e] + a(s), which is a lower bound of the mean
    error E|e| at sample k. Each intercept a(s) is a mean over the level of the load at sample
    k - d - 1, where d + 1 is `LinearModel.lag`. The level of the load is 0 until the first jump
    of the episode, and then uniformly distributed from -`amplitude` to `amplitude`, degC. The
    load jumps with the probability `jump_probability` at each sample at which it can change.

    `changes` has the changes of the load that are unknown at sample k - d - 1, and `noise` is
    the distribution of the effect on y(k) of the noise xi and of the load's random walk, degC.
    """
    at_level_0, effect_of_level = _effects_on_output(
        changes, noise, amplitude, jump_probability
    )
    # By symmetry, the intercept at the level -l and the slope s is the intercept at the level l
    # and the slope -s. So no level below 0 is computed, and slopes have both signs.
    both_signs = np.append(SLOPES, -SLOPES)
    half = KNOWN_LEVEL_ATOMS // 2
    levels = [0.0, *(amplitude * (np.arange(half) + 0.5) / half)]
    never_jumped = (1.0 - jump_probability) ** changes.known_counts  # a probability
    probabilities = [never_jumped] + [(1.0 - never_jumped) / half] * half
    intercepts = np.zeros((len(changes.counts), len(SLOPES)))
    for level, probability in zip(levels, probabilities, strict=True):
        values = at_level_0.values + level * effect_of_level
        distribution = Distribution(values, at_level_0.weights)
        minima = least_mean_distances(distribution, both_signs)
        # Row 0 of each sample is for the level l, and row 1 for the level -l.
        at_both_levels = minima.reshape(len(values), 2, -1)
        intercepts += probability[:, np.newaxis] * at_both_levels.mean(axis=1)
    return intercepts
