"""Bound the mean absolute error from below by the effects that no flow can counteract in time.

The plant is equation (28) of the paper, A(z^-1) y(k) = B(z^-1) u_a(k - d) + C(z^-1) xi(k), with
the output y, the flow u_a, the delay d and the white noise xi. A load w(k) adds A(1) w(k) to
the right side. The load is the sum of a random walk and of a piecewise constant part, whose
changes are called *jumps*.

A flow at sample j affects the output y(j + d + 1) at the earliest. So no flow counteracts the
effects on y(k) of noise, walk and jumps after the sample k - d - 1. Let n(k) be the sum of the
effects that no flow counteracts, degC, and m(k) the error if n(k) were 0. The error is

    e(k) = m(k) - n(k).

The number m(k) is known at k - d - 1, and n(k) has the mean 0, so E[e] = E[m]. The linear
program in `linear_program.py` needs a lower bound of E|e| that is a convex, piecewise linear
function of E[e]. Let K be everything that is known at k - d - 1. For every slope s,

    E[|m - n| given K] >= s m + min over x of E[|x - n| - s x given K].

The mean of this inequality over K is a line in E[e],

    E|e| >= s E[e] + a(s),

where the intercept a(s) is the mean of the minima over x. Three steps lead to a number below
a(s) that can be computed:

1. K is taken to contain more than any controller knows: the walk and the piecewise constant
   part of the load up to k - d - 1. K does not contain the times of later jumps, so the minimum
   is over a single x for all times of jumps. If the transmitter is noisy, K does not contain
   the true output. For a known load, output and readings are jointly normal, so the noise in n
   has the variance of the best prediction of the output from the readings (Kalman filter).
2. Given K, the distribution of n depends only on the level l of the piecewise constant part at
   k - d - 1. The first jump replaces l by a new level. So n is the product of l and a random
   factor, plus a random number that does not depend on l. Therefore |x - n| - s x is convex in
   x and l together, and the minimum over x is a convex function of l. The mean of a convex
   function over a slice of levels is at least the value of the function at the mean level of
   the slice (Jensen's inequality).
3. Each normal or uniform distribution is replaced by atoms, the means of equally probable
   slices. In a sum of distributions, neighbouring atoms are replaced by their mean. Replacing
   random numbers by their mean never makes the mean of |x - n| larger (Jensen's inequality).

After step 3, n has finitely many values, and the minimum over x is at one of these values, a
quantile.
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

# Numbers of atoms that represent distributions. With more atoms, the bounds of the
# environment's presets would change by at most 0.0002 degC.
NOISE_ATOMS = 128  # of the sum of the effects of the noise xi and of the load's walk
WALK_ATOMS = 4  # of each step of the load's walk
JUMP_ATOMS = 32  # of the effect of a jump and of later jumps, and of noise in their sum
JUMP_LEVEL_ATOMS = 8  # of the new level of the load after a jump
KNOWN_LEVEL_ATOMS = 8  # of the load's level that is known at k - d - 1; an even number
# Slopes s of the lines that bound the mean error. The slopes are closer together near 1, as the
# mean error approaches the magnitude of the expected error slowly.
SLOPES = 1.0 - np.array([64, 53, 42, 31, 22, 14, 8, 4, 1, 0]) / 64.0


def error_bounds(model: LinearModel) -> ErrorBounds:
    """Return the lower bounds of the mean errors that noise and load cause, for each sample.

    No flow can counteract the effects of noise and load in the last d + 1 samples, where d is
    the plant's delay; see the description of the module. The load is taken to be known.

    Parameters
    ----------
    model
        One plant, for the samples k = 0, 1, ... of an episode.
    """
    numbers = model.numbers
    # The steps of the load's walk are uniformly distributed between -largest_step and
    # largest_step, degC.
    largest_step = np.sqrt(3.0 * LOAD_INTERVAL * numbers.disturbance_walk_variance)
    amplitude = numbers.disturbance_amplitude
    if not (largest_step or amplitude):
        return bounds_for_normal(noise_variance(model))

    changes = load_changes(model)
    noise = normal(noise_variance(model), NOISE_ATOMS)
    if largest_step:
        for effect in changes.effects.T:
            step = uniform(largest_step * effect, WALK_ATOMS)
            noise = sum_of(noise, step, NOISE_ATOMS)
    if not amplitude:
        return ErrorBounds(SLOPES, least_mean_distances(noise, SLOPES))
    jump_probability = min(1.0, LOAD_INTERVAL / numbers.disturbance_interval)
    intercepts = _intercepts_with_jumps(changes, noise, amplitude, jump_probability)
    return ErrorBounds(SLOPES, intercepts)


def bounds_for_normal(variance: Array) -> ErrorBounds:
    """Return the lower bounds of the mean errors if the inevitable errors are normal.

    `variance` holds the variance of the inevitable error, which no flow can counteract in time,
    degC^2, for each sample, shape (samples,). The inevitable error has the mean 0.
    """
    if not variance.any():
        return ErrorBounds(np.ones(1), np.zeros((len(variance), 1)))
    distribution = normal(variance, NOISE_ATOMS)
    return ErrorBounds(SLOPES, least_mean_distances(distribution, SLOPES))


class LoadChanges(NamedTuple):
    """For each sample k, the changes of the load that are not yet known at k - d - 1.

    Here d is the delay of the plant, samples. The load can change at every multiple of
    `LOAD_INTERVAL` above 0. The changes at the samples from k - d to k are unknown.
    """

    # Change of y(k), degC, for a change of the load by 1 degC, by the place of the change: the
    # latest unknown change comes first. The effect is 0 where there are fewer changes. Shape
    # (samples, largest number of unknown changes).
    effects: Array
    counts: NDArray[np.intp]  # the number of unknown changes, shape (samples,)
    known_counts: NDArray[np.intp]  # the number of changes up to k - d - 1, shape (samples,)


def load_changes(model: LinearModel) -> LoadChanges:
    """Return the changes of the load that no flow can counteract in time, for each sample.

    `model` is a plant, for the samples k = 0, 1, ... of an episode.
    """
    samples = len(model.load)
    k = np.arange(samples)
    times = np.arange(0, samples, LOAD_INTERVAL)
    ages = k[:, np.newaxis] - times  # samples from each time to k
    # Row k, column i: the effect on y(k), degC, of a change of the load by 1 degC at times[i].
    # The load does not change at the first time, k = 0.
    steps = model.load[:, np.newaxis] * (ages >= 0) * (times > 0)
    A, _ = equations(model, samples)
    responses = scipy.sparse.linalg.spsolve_triangular(A, steps)
    responses[ages >= model.lag] = 0.0  # A flow counteracts these changes in time.
    changes = k // LOAD_INTERVAL  # number of changes up to k
    known_changes = np.maximum(k - model.lag, 0) // LOAD_INTERVAL
    largest_count = math.ceil(min(model.lag, samples) / LOAD_INTERVAL)
    effects = np.empty((samples, largest_count))
    for place in range(largest_count):  # place 0 is the latest change
        effects[:, place] = responses[k, np.maximum(changes - place, 0)]
    return LoadChanges(effects, changes - known_changes, known_changes)


def _after_jumps(
    effects: Array, amplitude: float, jump_probability: float
) -> list[Distribution]:
    """Return the distributions of the effect on y(k) of a jump of the load and all later jumps.

    The load keeps a new level until the next jump replaces the level by another level. The
    effect of the level before the first jump is left out.

    Parameters
    ----------
    effects
        Change of y(k), degC, for a change of the load by 1 degC, shape (samples, changes), the
        latest change first.
    amplitude
        New levels of the load are uniformly distributed within +-`amplitude`, degC.
    jump_probability
        The probability that the load jumps at one of the samples at which it can change.

    Returns
    -------
    list of Distribution
        Item i is the distribution if the first jump is at the change in column i of `effects`.
    """
    samples, changes = effects.shape
    no_jump_probability = 1.0 - jump_probability
    distributions: list[Distribution] = []
    for place in range(changes):
        effect = effects[:, place]
        # There is no later jump, or the next jump is at one of the later changes.
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

    The distribution depends on l, the level of the load at k - d - 1, degC, where d is the
    plant's delay. `_intercepts_with_jumps` describes the parameters.

    Returns
    -------
    at_level_0 : Distribution
        The distribution of n(k) if l is 0.
    effect_of_level : Array
        The change of each value of `at_level_0` by each degC of l, shape (samples, atoms).
    """
    no_jump_probability = 1.0 - jump_probability
    # The load does not jump after k - d - 1, or one of the unknown changes is the first jump.
    parts = [noise]
    probabilities: list[Array] = [no_jump_probability ** changes.counts.astype(np.float64)]
    effects_of_level = [np.zeros_like(noise.values)]
    coarse_noise = reduced(noise, JUMP_ATOMS)
    after_jumps = _after_jumps(changes.effects, amplitude, jump_probability)
    for place, after_jump in enumerate(after_jumps):
        part = sum_of(coarse_noise, after_jump, JUMP_ATOMS)
        changes_before = changes.counts - 1 - place
        probability = jump_probability * no_jump_probability ** np.maximum(changes_before, 0)
        effect = -changes.effects[:, place, np.newaxis]  # The first jump ends the level l.
        parts.append(part)
        probabilities.append(np.where(changes_before >= 0, probability, 0.0))
        effects_of_level.append(np.broadcast_to(effect, part.values.shape))
    return mixture(parts, probabilities), np.hstack(effects_of_level)


def _intercepts_with_jumps(
    changes: LoadChanges, noise: Distribution, amplitude: float, jump_probability: float
) -> Array:
    """Return the intercepts a(s) of the bounds of the mean errors for a load with jumps.

    The intercepts are means over the level of the load at k - d - 1, where d is the plant's
    delay. The level is 0 until the first jump of the episode, and then uniformly distributed.

    Parameters
    ----------
    changes
        The changes of the load that are unknown at k - d - 1.
    noise
        Distribution of the effect of the noise xi and of the load's walk on y(k), degC.
    amplitude
        Levels of the load are uniformly distributed within +-`amplitude`, degC.
    jump_probability
        The probability that the load jumps at one of the samples at which it can change.

    Returns
    -------
    ndarray
        The intercepts for `SLOPES`, degC, shape (samples, slopes).
    """
    at_level_0, effect_of_level = _effects_on_output(
        changes, noise, amplitude, jump_probability
    )
    # By symmetry, the intercept at the level -l and the slope s is the intercept at the level l
    # and the slope -s. So only levels above 0 are computed, with slopes of both signs.
    both_signs = np.append(SLOPES, -SLOPES)
    half = KNOWN_LEVEL_ATOMS // 2
    levels = [0.0, *(amplitude * (np.arange(half) + 0.5) / half)]
    never_jumped = (1.0 - jump_probability) ** changes.known_counts  # probability
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
