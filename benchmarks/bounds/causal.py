"""Penalise flows that use the future, to bound the cost of not knowing the next set point.

With `setpoint="random"` the set point has a law: levels are independent and uniform in
[-A, A], and each is held for a number of samples that is uniform from S to L. A controller
without preview learns of a change when it happens. So u_a(j) depends only on the set points up
to j, and for every pi(j) with E[pi(j) | set points up to j] = 0,

    E[sum_j pi(j) u_a(j)] = 0.

Hence the mean error of such a controller is the mean of the sum of |e(k)| and pi(k) u_a(k),
which is at least the mean, over the set points, of its minimum over all flows, even those that
know the future (D. B. Brown, J. E. Smith and P. Sun, "Information relaxations and duality in
stochastic dynamic programs", Operations Research 58, 2010, 785-801). Every pi gives a bound; a
poor one makes it loose, never wrong. Here it is

    pi(j) = sum_k G[k, j] (g(k) - E[g(k) | set points up to j]).

G[k, j] is the effect of u_a(j) on y(k), and g(k) a guess of the slope of E|e(k)|, whose
conditional means have a closed form. After a change it is the sign of the change, until the
output can have followed; later in a hold it is a number between -1 and 1, odd in the level,
that weighs staying against moving ahead to where the next level is expected.
"""

import numpy as np
import scipy  # loads its modules on first use
from numpy.typing import NDArray

from benchmarks.bounds.linear_program import Unknown, equations, response
from benchmarks.loop.linear import LinearModel
from benchmarks.loop.rollout import held

Array = NDArray[np.float64]

THRESHOLDS = 8  # thresholds that represent the noise in the guess


class SetPointLaw:
    """The law of random set points, and the guess for it on one plant.

    The guess uses the plant's dynamics at the start of the episode.
    """

    def __init__(self, model: LinearModel, unknown: Unknown) -> None:
        samples, parameters = len(model.load), model.parameters
        self._flow_response = response(*equations(model, samples))
        self._lag = model.lag
        self._amplitude = parameters.setpoint_amplitude
        self._shortest = max(1, -(-parameters.setpoint_period // 6))
        self._longest = max(self._shortest, parameters.setpoint_period // 2)
        at_start = LinearModel(parameters, model.numbers, 0)
        pace = np.abs(np.roots([1.0, *-at_start.alpha])).max(initial=0.0)
        low, high = model.limits
        # An integrating plant reaches everything.
        self._reach = min(float(np.abs(at_start.gain)), 1e9) * min(-low, high)
        # Noise blurs the sign of a small error; equally probable thresholds represent it.
        deviation = unknown.intercepts[-1, 0] / np.sqrt(2.0 / np.pi)
        shares = (np.arange(THRESHOLDS) + 0.5) / THRESHOLDS
        blur = scipy.special.ndtri((1.0 + shares) / 2.0)  # of |a standard normal number|
        self._blur = deviation * blur if deviation > 0.0 else np.zeros(1)
        # After a change the output stands still for `lag` samples. Then it approaches what the
        # limits allow; this is the share of the way that it has made, by age of the level.
        age = np.arange(samples)
        self._share = 1.0 - pace ** np.maximum(age - model.lag + 1, 0)
        # The age from which the largest change within reach has been made.
        far = 2.0 * self._amplitude / max(self._reach + self._amplitude, 1e-9)
        slowly = 1.0 - np.exp(-4.0)
        self._settled = int(np.searchsorted(self._share, min(far, slowly)))
        # The probability that a level is still held at an age, given that it began.
        self._left = np.clip(
            (self._longest - age) / (self._longest - self._shortest + 1), 0.0, 1.0
        )
        # The response to 1 t/h of flow, by the number of samples since the output can follow.
        dead = model.lag - int(model.numbers.delay) - 1
        self._impulse = at_start.impulse_response(samples + dead)[dead:]

    def penalty(self, setpoint: Array) -> Array:
        """Return pi for one draw of y_d(k), degC times samples per t/h, shape (samples,)."""
        samples, holds, before = len(setpoint), held(setpoint), 0.0
        courses = []  # of each level, by age
        guess = np.zeros(samples)
        for start, end in holds:
            # What a change adds to the mean of g, summed up, after zeros for the time before
            # it; and g, if the level never changed.
            summed = np.cumsum(self._mean_slope(setpoint[start]) * self._left)
            change = np.append(np.zeros(self._longest + 1), summed)
            stay = self._slope(before, setpoint[start]) + self._lean(change)
            guess[start:end], before = stay[: end - start], setpoint[start]
            courses.append((stay, change))
        surprise = np.zeros((samples, samples))  # [k, j]: g(k) - E[g(k) | up to j]
        for (start, end), course in zip(holds, courses, strict=True):
            for j in range(start, end):
                ages = np.arange(j + 1 - start, samples - start)
                surprise[j + 1 :, j] = guess[j + 1 :] - self._expected(ages, j - start, *course)
        return np.asarray(np.einsum("kj,kj->j", self._flow_response, surprise))

    def _expected(self, ages: NDArray[np.intp], now: int, stay: Array, change: Array) -> Array:
        """Return the mean of g at later ages of a level that is still held at age `now`."""
        # The next level begins at one of these ages, all equally probable.
        first = max(self._shortest, now + 1)
        count = self._longest - first + 1
        gone = np.clip((ages - first + 1) / count, 0.0, 1.0)
        added = (change[ages + count] - change[ages]) / count
        expected: Array = (1.0 - gone) * stay[ages] + added
        # After one more change g is as often positive as negative, as levels are symmetric.
        return expected

    def _slope(self, before: float, after: float) -> Array:
        """Return g by age, from a change until the output can have followed."""
        change = after - before
        room = max(self._reach - np.sign(change) * before, 0.0)
        left = np.abs(change) - room * self._share[:, np.newaxis]
        slope: Array = np.sign(change) * (left > self._blur).mean(axis=1)
        slope[self._settled :] = 0.0
        return slope

    def _mean_slope(self, before: float) -> Array:
        """Return the mean of `_slope` over all possible next levels."""
        A = self._amplitude
        share, blur = self._share[:, np.newaxis], self._blur
        up = A - before - max(self._reach - before, 0.0) * share - blur
        down = A + before - max(self._reach + before, 0.0) * share - blur
        mean: Array = (np.maximum(up, 0.0) - np.maximum(down, 0.0)).mean(axis=1) / (2.0 * A)
        mean[self._settled :] = 0.0
        return mean

    def _lean(self, change: Array) -> Array:
        """Return g by age late in a hold, such that it pays to stay.

        At every age a flow is then worth nothing on average: the sum over later ages of its
        response times the mean of g vanishes. This is solved backwards from the last age.
        """
        samples = len(self._left)
        lean = np.zeros(samples)
        if not self._impulse[0]:
            return lean
        for age in range(min(self._longest, samples) - 1, self._settled - 1, -1):
            now = age - self._lag
            ages = np.arange(age, min(samples, age + 200))
            worth = self._impulse[: len(ages)] @ self._expected(ages, now, lean, change)
            count = self._longest - max(self._shortest, now + 1) + 1
            still = min(1.0, (self._longest - age) / count)
            lean[age] = np.clip(-worth / (self._impulse[0] * still), -1.0, 1.0)
        return lean
