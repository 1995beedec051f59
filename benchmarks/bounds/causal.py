"""Penalise flows that use the future, to bound the cost of not knowing the next set point.

With the environment's argument `setpoint="random"`, the set point is piecewise constant with a
known distribution. Its *levels*, the values between changes, are independent and uniformly
distributed in [-A, A]. The number of samples for which a level lasts is uniformly distributed
from S to L. The *age* of a level is the number of samples since the level began.

A controller without preview learns of a change of the set point when the change happens. So the
flow u_a(j) depends only on the set points up to j. For every price pi(j) of the flow with
E[pi(j) | set points up to j] = 0, it follows that

    E[sum_j pi(j) u_a(j)] = 0.

Hence the expected sum of errors |e(k)| of a controller without preview equals the expected sum
of |e(k)| + pi(k) u_a(k). For fixed set points, the sum of |e(k)| + pi(k) u_a(k) is at least its
minimum over all flows, even flows that use the future. So the mean over the set points of these
minima is a lower bound (D. B. Brown, J. E. Smith and P. Sun, "Information relaxations and
duality in stochastic dynamic programs", Operations Research 58, 2010, 785-801). Every pi gives
a valid bound, but a poor choice of pi makes the bound loose. The choice of pi in this module is

    pi(j) = sum_k G[k, j] (g(k) - E[g(k) | set points up to j]).

G[k, j] is the effect of the flow u_a(j) on the output y(k). The number g(k) is a guess of the
slope of E|e(k)|, whose conditional means have a closed form. After a change of the set point, g
is the sign of the change, until the output can have followed. At later ages of the level, g is
a number between -1 and 1, odd in the level. It weighs staying at the present level against
moving towards 0, where the next level is expected.
"""

import numpy as np
import scipy  # loads its modules on first use
from numpy.typing import NDArray

from benchmarks.bounds.linear_program import Unknown, equations, response
from benchmarks.loop.linear import LinearModel
from benchmarks.loop.rollout import held
from mptc_gym.plant.signals import SetPointLevels

Array = NDArray[np.float64]

# Number of thresholds of the error, equally probable, that represent the noise in the guess g.
THRESHOLDS = 8
# Largest steady-state gain, degC per t/h. It stands for the infinite gain of an integrating
# plant, which can reach every temperature.
LARGEST_GAIN = 1e9
# If the flow's limits keep the output from reaching a set point, the output counts as having
# followed after four time constants. This is the share of the way after four time constants.
FOLLOWED = 1.0 - np.exp(-4.0)
# Samples after which the impulse response of the plant is neglected in the guess g.
HORIZON = 200


class SetPointLaw:
    """The distribution of random set points on one plant, and the penalty for using the future.

    The guess g in the penalty uses the plant's dynamics at the start of the episode.

    Parameters
    ----------
    model
        The plant, for all samples of an episode.
    unknown
        The lower bounds of E|m - n| for the same plant; they tell how large the noise is.
    """

    def __init__(self, model: LinearModel, unknown: Unknown) -> None:
        samples = len(model.load)
        parameters = model.parameters
        at_start = LinearModel(parameters, model.numbers, 0)
        self._flow_response = response(*equations(model, samples))
        self._lag = model.lag
        levels = SetPointLevels(parameters)
        self._amplitude = levels.amplitude
        self._shortest = levels.shortest
        self._longest = levels.longest
        # The largest temperature, degC, that a constant flow can keep on both sides of 0.
        low, high = model.limits
        gain = min(float(np.abs(at_start.gain)), LARGEST_GAIN)
        self._reach = gain * min(-low, high)
        # Noise blurs the sign of a small error. Equally probable thresholds of the error, degC,
        # represent it: quantiles of the magnitude of a normal number.
        deviation = unknown.intercepts[-1, 0] / np.sqrt(2.0 / np.pi)
        shares = (np.arange(THRESHOLDS) + 0.5) / THRESHOLDS
        self._thresholds = np.zeros(1)
        if deviation > 0.0:
            self._thresholds = deviation * scipy.special.ndtri((1.0 + shares) / 2.0)
        # After a change of the set point, the output does not move for `lag` samples. Then the
        # output approaches the farthest temperature that the limits allow. `_progress` is the
        # share of this way that the output has made, by the age of the level.
        age = np.arange(samples)
        slowest_pole = np.abs(np.roots([1.0, *-at_start.alpha])).max(initial=0.0)
        self._progress = 1.0 - slowest_pole ** np.maximum(age - model.lag + 1, 0)
        # The age from which on the output has followed the largest change within reach.
        largest_share = 2.0 * self._amplitude / max(self._reach + self._amplitude, 1e-9)
        self._settled = int(np.searchsorted(self._progress, min(largest_share, FOLLOWED)))
        # The probability that a level lasts beyond an age, by age.
        lengths = self._longest - self._shortest + 1
        self._still_held = np.clip((self._longest - age) / lengths, 0.0, 1.0)
        # The response to an impulse of 1 t/h of flow, degC, by the number of samples since the
        # first sample at which the output reacts.
        zeros = model.lag - int(model.numbers.delay) - 1  # leading zeros of B
        self._impulse = at_start.impulse_response(samples + zeros)[zeros:]

    def penalty(self, setpoint: Array) -> Array:
        """Return the prices pi(j) of the flows u_a(j), degC per t/h, shape (samples,).

        `setpoint` holds the set points y_d(k) of one episode, degC, shape (samples,).
        """
        samples = len(setpoint)
        holds = held(setpoint)
        level_before = 0.0
        guess = np.zeros(samples)  # g(k)
        guesses_of_holds = []
        for start, end in holds:
            level = setpoint[start]
            # The mean of what a change at the end of this level adds to g, as a cumulative sum
            # over the samples after the change. Zeros stand for the time before the change.
            summed = np.cumsum(self._mean_slope(level) * self._still_held)
            added = np.append(np.zeros(self._longest + 1), summed)
            stay = self._slope(level_before, level) + self._lean(added)
            guess[start:end] = stay[: end - start]
            guesses_of_holds.append((stay, added))
            level_before = level
        surprise = np.zeros((samples, samples))  # [k, j]: g(k) - E[g(k) | set points up to j]
        for (start, end), (stay, added) in zip(holds, guesses_of_holds, strict=True):
            for j in range(start, end):
                ages = np.arange(j + 1 - start, samples - start)
                expected = self._expected(ages, j - start, stay, added)
                surprise[j + 1 :, j] = guess[j + 1 :] - expected
        return np.asarray(np.einsum("kj,kj->j", self._flow_response, surprise))

    def _expected(
        self, ages: NDArray[np.intp], known_age: int, stay: Array, added: Array
    ) -> Array:
        """Return the expected guess g at later ages of a level that lasts at the present age.

        Parameters
        ----------
        ages
            Ages of the level at which g is wanted, samples, all later than `known_age`.
        known_age
            The present age of the level, samples: the level has not changed up to this age.
        stay
            The guess g by age if the level never changes, shape (samples,).
        added
            The mean of what a change of the level adds to g, as a cumulative sum over samples,
            from `longest + 1` samples before the change on.

        Returns
        -------
        ndarray
            The conditional means of g, in the shape of `ages`.
        """
        # The next level begins at an age from `first` to `longest`, all equally probable.
        first = max(self._shortest, known_age + 1)
        count = self._longest - first + 1
        changed = np.clip((ages - first + 1) / count, 0.0, 1.0)
        # After a second change g is as often positive as negative, as levels are symmetric.
        expected: Array = (1.0 - changed) * stay[ages]
        expected += (added[ages + count] - added[ages]) / count
        return expected

    def _slope(self, before: float, after: float) -> Array:
        """Return the guess g after a change of the set point, by age, shape (samples,).

        The set point changes from `before` to `after`, degC. From the age at which the output
        can have followed the change, the returned g is 0.
        """
        change = after - before
        room = max(self._reach - np.sign(change) * before, 0.0)
        remaining = np.abs(change) - room * self._progress[:, np.newaxis]
        slope: Array = np.sign(change) * (remaining > self._thresholds).mean(axis=1)
        slope[self._settled :] = 0.0
        return slope

    def _mean_slope(self, before: float) -> Array:
        """Return the mean of `_slope` over all possible next levels, by age, shape (samples,).

        `before` is the level before the change, degC.
        """
        A = self._amplitude
        progress = self._progress[:, np.newaxis]
        upwards = A - before - max(self._reach - before, 0.0) * progress - self._thresholds
        downwards = A + before - max(self._reach + before, 0.0) * progress - self._thresholds
        difference = np.maximum(upwards, 0.0) - np.maximum(downwards, 0.0)
        mean: Array = difference.mean(axis=1) / (2.0 * A)
        mean[self._settled :] = 0.0
        return mean

    def _lean(self, added: Array) -> Array:
        """Return the guess g at ages when the output has followed, by age, shape (samples,).

        The guess is such that an additional flow at any of these ages changes the expected
        error by nothing: the sum over later ages of the impulse response times the mean of g is
        0. The equations are solved from the highest age of a set point, the number of samples
        since it changed, down to the lowest. `added` is defined as in `_expected`.
        """
        samples = len(self._still_held)
        lean = np.zeros(samples)
        if not self._impulse[0]:
            return lean
        for age in range(min(self._longest, samples) - 1, self._settled - 1, -1):
            known_age = age - self._lag  # when the flow is chosen
            ages = np.arange(age, min(samples, age + HORIZON))
            worth = self._impulse[: len(ages)] @ self._expected(ages, known_age, lean, added)
            count = self._longest - max(self._shortest, known_age + 1) + 1
            held_at_age = min(1.0, (self._longest - age) / count)  # probability
            lean[age] = np.clip(-worth / (self._impulse[0] * held_at_age), -1.0, 1.0)
        return lean
