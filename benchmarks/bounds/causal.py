"""Penalise flows that use the future, to bound the cost of not knowing the next set point.

With `setpoint="random"` the set point has a law: levels are independent and uniform in
[-A, A], and each is held for a number of samples that is uniform from S to L. A controller
without preview learns of a change when it happens. So u_a(j) depends only on the set points up
to j, and for every pi(j) with E[pi(j) | set points up to j] = 0,

    E[sum_j pi(j) u_a(j)] = 0.

Hence the mean error of such a controller is the mean of the sum of |e(k)| and pi(k) u_a(k).
For given set points, this sum is at least its minimum over all flows, even flows that use the
future; so its mean is at least the mean of these minima over the set points (D. B. Brown,
J. E. Smith and P. Sun, "Information relaxations and duality in stochastic dynamic programs",
Operations Research 58, 2010, 785-801). Every pi gives a bound; a poor pi makes the bound loose,
never wrong. Here pi is

    pi(j) = sum_k G[k, j] (g(k) - E[g(k) | set points up to j]).

G[k, j] is the effect of u_a(j) on y(k), and g(k) a guess of the slope of E|e(k)|, whose
conditional means have a closed form. After a change of the set point, g is the sign of the
change, until the output can have followed. Later in the hold, g is a number between -1 and 1,
odd in the level, that weighs staying at the level against moving ahead to where the next level
is expected. The *age* of a level is the number of samples since it began.
"""

import numpy as np
import scipy  # loads its modules on first use
from numpy.typing import NDArray

from benchmarks.bounds.linear_program import Unknown, equations, response
from benchmarks.loop.linear import LinearModel
from benchmarks.loop.rollout import held
from mptc_gym.signals import Levels

Array = NDArray[np.float64]

THRESHOLDS = 8  # thresholds that represent the noise in the guess
# A finite stand-in for the reach of an integrating plant, which reaches every temperature.
LARGEST_GAIN = 1e9  # degC per t/h
# The output counts as having followed a change that is out of reach after four time constants.
FOLLOWED = 1.0 - np.exp(-4.0)
# Samples after which the response to a flow no longer counts in the guess late in a hold.
HORIZON = 200


class SetPointLaw:
    """The law of random set points, and the guess g for it on one plant.

    The guess uses the plant's dynamics at the start of the episode. The episode is as long as
    the `model`, which covers samples of one plant; `unknown` belongs to the same plant.
    """

    def __init__(self, model: LinearModel, unknown: Unknown) -> None:
        samples = len(model.load)
        parameters = model.parameters
        at_start = LinearModel(parameters, model.numbers, 0)
        self._flow_response = response(*equations(model, samples))
        self._lag = model.lag
        levels = Levels(parameters)
        self._amplitude = levels.amplitude
        self._shortest = levels.shortest
        self._longest = levels.longest
        # The largest temperature, degC, that the flow can hold on both sides of 0.
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
        # After a change the output stands still for `lag` samples. Then it approaches what the
        # limits allow; this is the share of the way that it has made, by age of the level.
        age = np.arange(samples)
        slowest_pole = np.abs(np.roots([1.0, *-at_start.alpha])).max(initial=0.0)
        self._progress = 1.0 - slowest_pole ** np.maximum(age - model.lag + 1, 0)
        # The age from which on the output has followed the largest change within reach.
        largest_share = 2.0 * self._amplitude / max(self._reach + self._amplitude, 1e-9)
        self._settled = int(np.searchsorted(self._progress, min(largest_share, FOLLOWED)))
        # The probability that a level is still held at an age.
        lengths = self._longest - self._shortest + 1
        self._still_held = np.clip((self._longest - age) / lengths, 0.0, 1.0)
        # The response to 1 t/h of flow, by the number of samples since the output can follow.
        zeros = model.lag - int(model.numbers.delay) - 1  # leading zeros of B
        self._impulse = at_start.impulse_response(samples + zeros)[zeros:]

    def penalty(self, setpoint: Array) -> Array:
        """Return pi(j), the price of u_a(j), degC per t/h, shape (samples,).

        `setpoint` is one draw of y_d(k), degC, shape (samples,).
        """
        samples = len(setpoint)
        holds = held(setpoint)
        level_before = 0.0
        guess = np.zeros(samples)  # g(k)
        guesses_of_holds = []
        for start, end in holds:
            level = setpoint[start]
            # What a change adds to the mean of g, summed up, after zeros for the time before
            # the change.
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
        """Return the mean of g at later ages of a level that is known to be held at an age.

        `ages` are later than `known_age`, samples. `stay` is g by age if the level never
        changes. `added` is what a change adds to the mean of g, summed up, from `longest + 1`
        samples before the change on.
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
        """Return g by age, from a change on until the output can have followed.

        The level changes from `before` to `after`, degC. The shape is (samples,).
        """
        change = after - before
        room = max(self._reach - np.sign(change) * before, 0.0)
        remaining = np.abs(change) - room * self._progress[:, np.newaxis]
        slope: Array = np.sign(change) * (remaining > self._thresholds).mean(axis=1)
        slope[self._settled :] = 0.0
        return slope

    def _mean_slope(self, before: float) -> Array:
        """Return the mean of `_slope` over all levels after `before`, degC, by age."""
        A = self._amplitude
        progress = self._progress[:, np.newaxis]
        upwards = A - before - max(self._reach - before, 0.0) * progress - self._thresholds
        downwards = A + before - max(self._reach + before, 0.0) * progress - self._thresholds
        difference = np.maximum(upwards, 0.0) - np.maximum(downwards, 0.0)
        mean: Array = difference.mean(axis=1) / (2.0 * A)
        mean[self._settled :] = 0.0
        return mean

    def _lean(self, added: Array) -> Array:
        """Return g by age late in a hold, such that it pays to stay; `added` as in `_expected`.

        At every age a flow is then worth nothing on average: the sum over later ages of its
        response times the mean of g vanishes. This is solved backwards from the last age.
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
