"""Penalise flows that use the future, to bound the cost of not knowing the next set point.

With the environment's argument `setpoint="random"`, the set point is piecewise constant with a
known distribution. The *levels*, the values between changes, are independent and uniformly
distributed in [-A, A]. The number of samples for which a level lasts is uniformly distributed
from S to L. The *age* of a level is the number of samples since the level began.

A controller without preview learns of a change of the set point when the change happens, so the
flow u_a(j) of the controller depends only on the set points up to j. For every price pi(j) of
the flow with E[pi(j) | set points up to j] = 0, it follows that

    E[sum_j pi(j) u_a(j)] = 0.

Hence the expected sum of errors |e(k)| of a controller without preview equals the expected sum
of |e(k)| + pi(k) u_a(k). For fixed set points, the sum of |e(k)| + pi(k) u_a(k) has a minimum
over all flows, even flows that use the future. The mean of these minima over random set points
is a lower bound for every controller without preview (D. B. Brown, J. E. Smith and P. Sun,
"Information relaxations and duality in stochastic dynamic programs", Operations Research 58,
2010, 785-801). Every pi gives a valid bound, but a poor choice of pi makes the bound loose. The
choice of pi in this module is

    pi(j) = sum_k G[k, j] (g(k) - E[g(k) | set points up to j]).

G[k, j] is the effect of the flow u_a(j) on the output y(k). The *slope* g(k) is a rough
estimate of how fast E|e(k)| rises with the expected error at k, in degC per degC. After a
change of the set point, g is the sign of the change until the output can have reached the new
level. Then g is a number between -1 and 1, which weighs staying at the present level against
moving towards 0, the mean of the next level.
"""

import numpy as np
import scipy  # loads its modules on first use
from numpy.typing import NDArray

from benchmarks.bounds.linear_program import ErrorBounds, equations, response
from benchmarks.loop.linear import LinearModel
from benchmarks.loop.rollout import held
from mptc_gym.plant.signals import SetPointLevels

Array = NDArray[np.float64]

# Number of thresholds of the error, equally probable, that represent the noise in the slope g.
THRESHOLDS = 8
# Largest steady-state gain, degC per t/h. It stands for the infinite gain of an integrating
# plant, which can reach every temperature.
LARGEST_GAIN = 1e9
SMALLEST_RANGE = 1e-9  # degC; least divisor, for set points and flows that are always 0
# If the flow's limits keep the output from reaching a level, the output counts as having
# arrived after four time constants. This is the share of the way after four time constants.
ARRIVED = 1.0 - np.exp(-4.0)
# Samples after which the impulse response of the plant is neglected in the slope g.
HORIZON = 200


class SetPointLaw:
    """The distribution of random set points on one plant, and the penalty for using the future.

    The slope g in the penalty is computed for the plant's dynamics at the start of the episode.

    Parameters
    ----------
    model
        The plant, for all samples of an episode.
    bounds
        The lower bounds of the mean errors for this plant, from which the size of the noise
        follows.
    """

    def __init__(self, model: LinearModel, bounds: ErrorBounds) -> None:
        samples = len(model.load)
        parameters = model.parameters
        at_start = LinearModel(parameters, model.numbers, 0)
        self._flow_response = response(*equations(model, samples))
        self._lag = model.lag
        levels = SetPointLevels(parameters)
        self._amplitude = levels.amplitude
        self._shortest = levels.shortest
        self._longest = levels.longest
        # A constant flow can keep every temperature from -reachable to reachable, degC.
        low, high = model.limits
        gain = min(float(np.abs(at_start.gain)), LARGEST_GAIN)
        self._reachable = gain * min(-low, high)
        # Noise makes the sign of a small error uncertain. Equally probable thresholds of the
        # error, degC, represent the noise: quantiles of the magnitude of a normal number.
        deviation = bounds.intercepts[-1, 0] / np.sqrt(2.0 / np.pi)
        shares = (np.arange(THRESHOLDS) + 0.5) / THRESHOLDS
        self._thresholds = np.zeros(1)
        if deviation > 0.0:
            self._thresholds = deviation * scipy.special.ndtri((1.0 + shares) / 2.0)
        # After a change of the set point, the output does not move for `lag` samples. Then the
        # output approaches the farthest temperature that the limits allow. `_progress` is the
        # share of this way that the output has made, by the age of the level.
        age = np.arange(samples)
        self._progress = 1.0 - at_start.slowest_pole ** np.maximum(age - model.lag + 1, 0)
        # From this age on, the output has arrived at the new level after any change. The
        # largest change within reach is from -amplitude to amplitude.
        largest_way = max(self._reachable + self._amplitude, SMALLEST_RANGE)
        largest_share = 2.0 * self._amplitude / largest_way
        self._arrival_age = int(np.searchsorted(self._progress, min(largest_share, ARRIVED)))
        # The probability that a level lasts beyond an age, by age.
        lengths = self._longest - self._shortest + 1
        self._probability_held = np.clip((self._longest - age) / lengths, 0.0, 1.0)
        # The response to an impulse of 1 t/h of flow, degC, by the number of samples since the
        # first sample at which the output reacts.
        zeros = model.lag - int(model.numbers.delay) - 1  # leading zeros of B
        self._impulse = at_start.impulse_response(samples + zeros)[zeros:]

    def penalty(self, setpoint: Array) -> Array:
        """Return the prices of the flows in one episode, degC per t/h, shape (samples,).

        The price of the flow at sample j is pi(j) in the description of the module. `setpoint`
        holds the set points of the episode, degC, shape (samples,).
        """
        samples = len(setpoint)
        slope = np.zeros(samples)  # g(k)
        # Row k, column j: the conditional mean of g(k), given the set points up to j.
        expected = np.zeros((samples, samples))
        previous_level = 0.0  # before the episode
        for start, end in held(setpoint):
            level = setpoint[start]
            change_sums = self._sums_after_next_change(level)
            slope_if_held = self._slope_after_change(previous_level, level)
            slope_if_held += self._slope_after_arrival(change_sums)
            slope[start:end] = slope_if_held[: end - start]
            for j in range(start, end):  # The age of the level is j - start.
                later_ages = np.arange(j + 1 - start, samples - start)
                expected[j + 1 :, j] = self._expected_slope(
                    later_ages, j - start, slope_if_held, change_sums
                )
            previous_level = level
        # Only slopes after j are unexpected at j.
        surprise = np.tril(slope[:, np.newaxis] - expected, k=-1)
        return np.asarray(np.einsum("kj,kj->j", self._flow_response, surprise))

    def _expected_slope(
        self,
        ages: NDArray[np.intp],
        known_age: int,
        slope_if_held: Array,
        change_sums: Array,
    ) -> Array:
        """Return the mean slopes of the error, given that a level has reached an age.

        Parameters
        ----------
        ages
            Ages of the level at which the means are wanted, samples, all above `known_age`.
        known_age
            Age up to which the level is known not to change, samples.
        slope_if_held
            The slope by age if the level never changes, shape (samples,).
        change_sums
            What `_sums_after_next_change` returns for the level.

        Returns
        -------
        ndarray
            The conditional means of the slope, in the shape of `ages`.
        """
        # The next level begins at an age from `first` to `longest`, all equally probable.
        first = max(self._shortest, known_age + 1)
        count = self._longest - first + 1
        change_probability = np.clip((ages - first + 1) / count, 0.0, 1.0)
        expected: Array = (1.0 - change_probability) * slope_if_held[ages]
        expected += (change_sums[ages + count] - change_sums[ages]) / count
        return expected

    def _slope_after_change(self, previous_level: float, level: float) -> Array:
        """Return the slopes of the error after a change of the set point, shape (samples,).

        Element i is the slope at the age i of the new level: an estimate of how fast the mean
        absolute error rises with the expected error, from -1 to 1.

        The set point changes from `previous_level` to `level`, degC. The slope is the sign of
        the change times the probability that the error is larger than the noise. The slope is 0
        after the output has arrived at the new level.
        """
        change = level - previous_level
        way = max(self._reachable - np.sign(change) * previous_level, 0.0)
        remaining = np.abs(change) - way * self._progress[:, np.newaxis]
        slope: Array = np.sign(change) * (remaining > self._thresholds).mean(axis=1)
        slope[self._arrival_age :] = 0.0
        return slope

    def _mean_slope_after_change(self, level: float) -> Array:
        """Return the mean of `_slope_after_change` over all next levels, shape (samples,).

        The set point changes from `level`, degC, to a next level that is uniformly distributed.
        Element i is the mean slope at the age i of the next level.
        """
        A = self._amplitude
        progress = self._progress[:, np.newaxis]
        way_up = max(self._reachable - level, 0.0)
        way_down = max(self._reachable + level, 0.0)
        # Lengths of the intervals of next levels that the output has not reached.
        above = np.maximum(A - level - way_up * progress - self._thresholds, 0.0)
        below = np.maximum(A + level - way_down * progress - self._thresholds, 0.0)
        mean: Array = (above - below).mean(axis=1) / (2.0 * A)
        mean[self._arrival_age :] = 0.0
        return mean

    def _sums_after_next_change(self, level: float) -> Array:
        """Return cumulative sums of the mean slopes after the next change from `level`, degC.

        The element `longest + 1 + i` is the sum over the samples from the change to i samples
        after the change. The first `longest + 1` elements, for samples before the change, are
        0.
        """
        # After a second change, the mean slope is 0, as levels are symmetric around 0.
        mean_slope = self._mean_slope_after_change(level) * self._probability_held
        return np.append(np.zeros(self._longest + 1), np.cumsum(mean_slope))

    def _slope_after_arrival(self, change_sums: Array) -> Array:
        """Return the slopes of the error after the output has arrived at a level, by age.

        The slopes solve an equation for each age: an additional flow that acts from the age on
        does not change the mean error. So the sum of the impulse response times the mean slopes
        is 0. The equation of the highest age is solved first. `change_sums` is what
        `_sums_after_next_change` returns for the level.
        """
        samples = len(self._probability_held)
        slope = np.zeros(samples)
        if not self._impulse[0]:  # No flow has an effect.
            return slope
        for age in range(min(self._longest, samples) - 1, self._arrival_age - 1, -1):
            known_age = age - self._lag  # when the flow is chosen
            ages = np.arange(age, min(samples, age + HORIZON))
            expected = self._expected_slope(ages, known_age, slope, change_sums)
            effect_of_flow = self._impulse[: len(ages)] @ expected
            count = self._longest - max(self._shortest, known_age + 1) + 1
            held_probability = min(1.0, (self._longest - age) / count)
            solution = -effect_of_flow / (self._impulse[0] * held_probability)
            slope[age] = np.clip(solution, -1.0, 1.0)
        return slope
