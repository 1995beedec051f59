"""Compute a penalty that makes the knowledge of future set points useless, for a lower bound.

With the environment's argument `setpoint="random"`, the set point is piecewise constant. The
*levels*, which are the values of the set point between changes, are independent and uniformly
distributed in [-A, A], degC. The number of samples for which the set point keeps a level is
uniformly distributed from S to L. The *age* of a level is the number of samples since the set
point changed to the level.

A controller without preview learns of a change of the set point when the change happens, so the
controller's flow u_a(j) at sample j depends only on the set points up to j. If the price pi(j)
of a flow, in degC per t/h, satisfies E[pi(j) | set points up to j] = 0, then the mean of sum_j
pi(j) u_a(j), the total cost of the flows of a controller without preview, is 0. So adding the
costs pi(k) u_a(k) to the errors |e(k)| does not change the expected sum of the errors of a
controller without preview. For given set points, the sum of |e(k)| + pi(k) u_a(k) over an
episode has a minimum over all flows, even flows that use future set points. The mean of this
minimum over random set points is a lower bound of the expected sum of |e(k)| for every
controller without preview (Brown, Smith and Sun, "Information relaxations and duality in
stochastic dynamic programs", Operations Research 58, 2010, 785-801). Every price whose mean is
0, given the set points up to the sample of the flow, gives a valid lower bound, but a poor
choice of the price gives a lower bound that is far below the error of real controllers. This
module chooses the price pi(j) = sum_k G[k, j] (g(k) - E[g(k) | set points up to j]), where
G[k, j] is the effect of a flow of 1 t/h at sample j on the output y(k), degC, and the *slope*
g(k), a number from -1 to 1, estimates roughly how fast the mean error E|e(k)| rises with the
expected error E[e(k)]. From a change of the set point until the output can have reached every
new level, the slope g(k) of the mean error is the sign of the change times the probability that
the error is larger than the noise. Later, the slope g(k) of the mean error is such that an
additional flow would change the sum of the mean errors from its first effect on as little as
possible.
"""

import numpy as np
import scipy  # loads its modules on first use
from numpy.typing import NDArray

from benchmarks.bounds.linear_program import ErrorBounds, equations, response
from benchmarks.loop.linear import LinearModel
from benchmarks.loop.measures import held
from mptc_gym.plant.signals import SetPointLevels

Array = NDArray[np.float64]

# Number of equally probable magnitudes of the noise from which the slope g is computed.
NOISE_MAGNITUDES = 8
# Farthest steady temperature, in amplitudes of the set point, in place of infinite ones of an
# integrating plant.
FARTHEST = 1e9
# Least divisor, in amplitudes of the set point. Without it, a divisor could be 0 or negative if
# the limits of the flow exclude 0 t/h.
SMALLEST_RANGE = 1e-9
# Share of the way to the farthest steady temperature that an output has made after four time
# constants. An output that cannot reach a level counts as having arrived after this share.
ARRIVED = 1.0 - np.exp(-4.0)
# Number of samples after which the slope g neglects the impulse response of the plant.
HORIZON = 200


class SetPointLaw:
    """The penalty for flows that use future set points, for random set points on one plant.

    The docstring of the module derives the penalty from a slope g(k), which estimates how fast
    the mean error E|e(k)| rises with the expected error E[e(k)]. The slope g(k) of the mean
    error is computed for the plant's dynamics at the start of the episode, even if the plant
    drifts.

    Parameters
    ----------
    model
        Model of one plant at all samples of an episode.
    bounds
        Lower bounds of the mean errors for the plant `model`. The standard deviation of the
        noise is computed from the lower bound at the last sample for an expected error of 0.
    """

    def __init__(self, model: LinearModel, bounds: ErrorBounds) -> None:
        samples = len(model.load_factor)  # one factor for each sample
        parameters = model.parameters
        at_start = LinearModel(parameters, model.numbers, 0)
        self._flow_response = response(*equations(model, samples))
        self._lag = model.lag
        levels = SetPointLevels(parameters)
        self._amplitude = levels.amplitude
        self._shortest = levels.shortest
        self._longest = levels.longest
        # A constant flow can keep every temperature from -reachable to reachable, degC.
        # `_reachable` is negative if the limits exclude a flow of 0 t/h.
        low, high = model.limits
        gain = min(float(np.abs(at_start.gain)), FARTHEST * self._amplitude / (high - low))
        self._reachable = gain * min(-low, high)
        # Noise makes the sign of a small error uncertain. Equally probable magnitudes of the
        # noise, degC, are quantiles of the magnitude of a normal random number.
        # The mean magnitude of a normal number is sqrt(2 / pi) standard deviations.
        deviation = bounds.intercepts[-1, 0] / np.sqrt(2.0 / np.pi)
        shares = (np.arange(NOISE_MAGNITUDES) + 0.5) / NOISE_MAGNITUDES
        self._noise_magnitudes = np.zeros(1)
        if deviation > 0.0:
            self._noise_magnitudes = deviation * scipy.special.ndtri((1.0 + shares) / 2.0)
        # For `lag` samples after a change of the set point, the output does not react. Later,
        # the output approaches the farthest steady temperature within the limits of the flow.
        # `_progress` is the share of the way to this temperature, by the age of the level.
        age = np.arange(samples)
        self._progress = 1.0 - at_start.slowest_pole ** np.maximum(age - model.lag + 1, 0)
        # Age of a level at which the output counts as having arrived at the level, after every
        # change of the set point. The largest change is from -amplitude to amplitude, on the
        # way from -amplitude to `_reachable`.
        largest_way = self._reachable / self._amplitude + 1.0  # in amplitudes
        largest_share = 2.0 / max(largest_way, SMALLEST_RANGE)
        self._arrival_age = int(np.searchsorted(self._progress, min(largest_share, ARRIVED)))
        # Probability that a level of the set point lasts longer than an age, by age.
        length_count = self._longest - self._shortest + 1
        self._probability_held = np.clip((self._longest - age) / length_count, 0.0, 1.0)
        # The output's response to a flow of 1 t/h at one sample, degC. Element 0 is the first
        # output that the flow can affect.
        zeros = model.lag - int(model.numbers.delay) - 1  # leading zeros of B
        # `impulse_response` begins d + 1 samples after the flow, with the zeros of B.
        self._impulse = at_start.impulse_response(samples + zeros)[zeros:]

    def penalty(self, setpoint: Array) -> Array:
        """Return the price of the flow at each sample, degC per t/h, shape (samples,).

        The docstring of the module defines the price pi(j) of the flow at sample j. `setpoint`
        has the set points of the episode, degC, shape (samples,).
        """
        samples = len(setpoint)
        slope = np.zeros(samples)  # g(k)
        # Row k, column j: the conditional mean of g(k), given the set points up to j.
        expected = np.zeros((samples, samples))
        previous_level = 0.0  # before the episode
        for start, end in held(setpoint):  # the periods of a constant set point
            level = setpoint[start]
            change_sums = self._sums_after_next_change(level)
            slope_if_held = self._slope_after_change(previous_level, level)
            slope_if_held += self._slope_after_arrival(change_sums)
            slope[start:end] = slope_if_held[: end - start]
            for j in range(start, end):  # The level has the age j - start.
                later_ages = np.arange(j + 1 - start, samples - start)
                expected[j + 1 :, j] = self._expected_slope(
                    later_ages, j - start, slope_if_held, change_sums
                )
            previous_level = level
        # At sample j, only the slopes at later samples are unknown.
        unexpected = np.tril(slope[:, np.newaxis] - expected, k=-1)
        return np.asarray(np.einsum("kj,kj->j", self._flow_response, unexpected))

    def _expected_slope(
        self,
        ages: NDArray[np.intp],
        known_age: int,
        slope_if_held: Array,
        change_sums: Array,
    ) -> Array:
        """Return the mean slopes dE|e|/dE[e] at `ages`, samples after a set-point change.

        The means are conditional on no second change of the set point up to `known_age` samples
        after the change, where `known_age` is lower than all elements of `ages`. Element i of
        `slope_if_held` is the slope dE|e|/dE[e] i samples after the change if the set point
        never changes again. `change_sums` has the cumulative sums of mean slopes that
        `_sums_after_next_change` returns for the set point after the change.
        """
        # The set point changes to the next level at an age of the present level from `first` to
        # `longest`; all these ages are equally probable.
        first = max(self._shortest, known_age + 1)
        count = self._longest - first + 1
        change_probability = np.clip((ages - first + 1) / count, 0.0, 1.0)
        expected: Array = (1.0 - change_probability) * slope_if_held[ages]
        # The mean, over these ages c of the next change, of the slope `age - c` samples after
        # it, as a difference of cumulative sums.
        expected += (change_sums[ages + count] - change_sums[ages]) / count
        return expected

    def _slope_after_change(self, previous_level: float, level: float) -> Array:
        """Return the slopes dE|e|/dE[e] after a change of the set point, shape (samples,).

        The set point changes from `previous_level` to `level`, degC. The slope is the sign of
        the change times the probability that the error is larger than the noise, and 0 from the
        age on at which the output counts as having arrived after every change.
        """
        change = level - previous_level
        way = max(self._reachable - np.sign(change) * previous_level, 0.0)
        remaining = np.abs(change) - way * self._progress[:, np.newaxis]
        slope: Array = np.sign(change) * (remaining > self._noise_magnitudes).mean(axis=1)
        slope[self._arrival_age :] = 0.0
        return slope

    def _mean_slope_after_change(self, level: float) -> Array:
        """Return the mean slopes dE|e|/dE[e] after a random set-point change, shape (samples,).

        The set point changes from `level`, degC, to a new level that is uniformly distributed
        from -A to A, where A is the amplitude of the set points, degC.
        """
        A = self._amplitude
        progress = self._progress[:, np.newaxis]
        way_up = max(self._reachable - level, 0.0)
        way_down = max(self._reachable + level, 0.0)
        # New levels from which the output is still farther away than the noise form two
        # intervals: one ends at A, the other at -A. The lengths of the intervals, degC, are:
        above = np.maximum(A - level - way_up * progress - self._noise_magnitudes, 0.0)
        below = np.maximum(A + level - way_down * progress - self._noise_magnitudes, 0.0)
        # The slope is 1 in the upper and -1 in the lower interval. The mean is over the noise.
        mean: Array = (above - below).mean(axis=1) / (2.0 * A)
        mean[self._arrival_age :] = 0.0  # as in `_slope_after_change`
        return mean

    def _sums_after_next_change(self, level: float) -> Array:
        """Return cumulative sums of mean slopes after the set point leaves `level`, degC.

        Element `longest + 1 + i` of the result is the sum of the mean slopes dE|e|/dE[e] from
        the change to i samples after the change, where `longest` is the largest number of
        samples for which a level lasts. The first `longest + 1` elements of the result, for
        samples before the change, are 0.
        """
        # After a second change, the mean slope is 0, since the distribution of levels is
        # symmetric around 0.
        mean_slope = self._mean_slope_after_change(level) * self._probability_held
        return np.append(np.zeros(self._longest + 1), np.cumsum(mean_slope))

    def _slope_after_arrival(self, change_sums: Array) -> Array:
        """Return the slopes dE|e|/dE[e] once the output can have reached a new set point.

        Element i of the result is the slope i samples after the change of the set point, or 0
        while the output cannot have reached the new set point. An additional flow whose first
        effect is i samples after the change must not change the sum of the mean errors E|e| at
        this and all later samples. So the slope i samples after the change is the number from
        -1 to 1 for which, summed over this and all later samples, the plant's impulse response
        times the mean slopes is as close to 0 as possible. The slopes are computed from the
        latest to the earliest sample, since each slope depends on all later slopes.
        `change_sums` has the cumulative sums of mean slopes that `_sums_after_next_change`
        returns for the new set point.
        """
        samples = len(self._probability_held)
        slope = np.zeros(samples)
        if not self._impulse[0]:  # No flow has an effect.
            return slope
        for age in range(min(self._longest, samples) - 1, self._arrival_age - 1, -1):
            known_age = age - self._lag  # the age when the flow is chosen
            ages = np.arange(age, min(samples, age + HORIZON))
            # The sum without the slope at this age, which is still 0 in `slope`.
            expected = self._expected_slope(ages, known_age, slope, change_sums)
            known_sum = self._impulse[: len(ages)] @ expected
            # The probability that the level is held at this age, as in `_expected_slope`.
            count = self._longest - max(self._shortest, known_age + 1) + 1
            held_probability = min(1.0, (self._longest - age) / count)
            # With this slope, times its own factor, the sum is 0.
            solution = -known_sum / (self._impulse[0] * held_probability)
            slope[age] = np.clip(solution, -1.0, 1.0)
        return slope
