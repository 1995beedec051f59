"""What a log leaves open: orders, delays, dead zones and coefficients by their probability."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy import stats

from benchmarks.identify.armax import Array, Orders
from benchmarks.identify.likelihood import MOST_GAPS, Candidate, Gap, Likelihood, Place
from benchmarks.identify.model import Interval
from benchmarks.lib.statistics import CONFIDENCE, ENDS
from benchmarks.loop.linear import LinearModel

ENDS_OF_ERRORS = float(stats.norm.ppf(ENDS[1]))  # standard errors
NEAR = 25.0  # of deviances: what is further off has no probability worth a mention
AS_GOOD = 8.0  # of Akaike's criterion: orders that are no further behind count the same
MOST_FITS = 8  # of orders, at as many delays
WALKS = [0.0, *np.geomspace(0.001, 0.512, 10)]  # of the root of C' from 1, where a walk shows
PLACES, DRAWS_EACH = 60, 6  # drawn: orders with a delay and a dead zone, and coefficients


class Entry(NamedTuple):
    """Orders, as one of the fits that take part has them, with a C, at a place."""

    number: int
    fit: Candidate
    place: Place


class Posterior:
    """The posterior of the plant, and draws from it.

    Parameters
    ----------
    likelihood
        Of the log.
    fits
        Of orders that take part, the best first.

    Attributes
    ----------
    delay, dead_zone, gain : Interval
        Samples, t/h and degC per t/h.
    chosen : Candidate
        The fit of delay and dead zone.
    draws : list of LinearModel
        Plants.
    """

    def __init__(self, likelihood: Likelihood, fits: list[Candidate]) -> None:
        self._likelihood = likelihood
        entries = self._entries(fits)
        places = [entry.place for entry in entries]
        # The likeliest plant is of the simplest orders that will do. What is possible gives
        # all orders that are about as good the same weight: a second time constant may stand
        # for a part of the delay, and a log tells little of it.
        likeliest, weights = self._weights(entries), self._weights(entries, possible=True)
        # A B with more coefficients than it need have may begin with some that are nearly 0:
        # its delay is not when the response begins.
        lengths = np.array([entry.fit.orders.b for entry in entries])
        short = weights * (lengths <= lengths[np.argmax(likeliest)])
        self.delay = _of_delay(places, likeliest, short / short.sum())
        self.dead_zone = _of_dead_zone(
            [place.gap for place in places], weights, ENDS_OF_ERRORS * likelihood.log.flow_error
        )
        self.chosen = self._choose(entries, likeliest)
        self.draws = self._draw(entries, weights)
        value = self._linear(self.chosen, self.chosen.solution.linear).gain
        endless = math.copysign(math.inf, value)  # where nothing settles
        self.gain = _interval(
            value, np.array([d.gain if sum(d.a) > 0.0 else endless for d in self.draws])
        )

    def _entries(self, fits: list[Candidate]) -> list[Entry]:
        """Return places for all orders that are near the best."""
        likelihood, found = self._likelihood, []
        gaps = likelihood.gaps()
        for i, fit in enumerate(fits):
            places = likelihood.scan(fit.orders, fit.solution.c, gaps)
            near = [p.delay for p in places if p.deviance < places[0].deviance + 2.0 * NEAR]
            delays = range(min(near), max(near) + 1)
            if i == 0:
                gaps = self._refined(fit, places, delays)
                at_its_own = range(fit.place.delay, fit.place.delay + 1)
                gap = likelihood.scan(fit.orders, fit.solution.c, gaps, at_its_own)[0].gap
            # Another delay may ask for another C.
            stride = max(len(delays) // MOST_FITS, 1)
            for delay in delays[::stride]:
                around = range(delay, min(delay + stride, delays.stop))
                middle = Place(0.0, around[len(around) // 2], gap)
                refit = likelihood.fit(middle, fit.orders, fit.solution.c)
                if fit.has_own_lag and not refit.has_own_lag:
                    refit = fit
                places = likelihood.scan(fit.orders, refit.solution.c, gaps, around)
                found += [Entry(i, refit, place) for place in places]
        return found

    def _weights(self, entries: list[Entry], *, possible: bool = False) -> Array:
        """Return the probabilities of places."""
        likelihood = self._likelihood
        deviances = np.array([entry.place.deviance for entry in entries])
        prior = np.array([self._prior(entry.place.gap) for entry in entries])
        member = np.array([entry.number for entry in entries])
        weights = np.zeros(len(entries))
        behind = np.zeros(member.max() + 1)
        for number in range(member.max() + 1):
            own = member == number
            least, fit = deviances[own].min(), entries[int(np.argmax(own))].fit
            behind[number] = likelihood.criterion(fit.orders, least, mild=possible)
            # How a response with a lag sets in is a matter of few samples, and of chance: the
            # likelihood of delays is trusted half as far.
            trust = 0.5 if possible and fit.has_own_lag else 1.0
            weights[own] = np.exp(trust * (least - deviances[own]) / 2.0) * prior[own]
            if possible:
                weights[own] /= weights[own].sum()
        behind = np.maximum(behind - behind.min() - AS_GOOD * possible, 0.0)
        weights *= np.exp(-behind / 2.0)[member]
        weights /= weights.sum()
        return weights

    def _refined(self, fit: Candidate, places: list[Place], delays: range) -> list[Gap]:
        """Return gaps near the best, with all gaps between commands told apart there."""
        likelihood = self._likelihood
        best: dict[Gap, float] = {}
        for place in places:
            best.setdefault(place.gap, place.deviance)  # the best of a gap comes first
        while len(best) < MOST_GAPS:
            gaps = sorted(best)
            limit = min(best.values()) + NEAR
            parts = {
                gap: likelihood.halves(gap)
                for gap, above in zip(gaps, [*gaps[1:], gaps[-1]], strict=True)
                if min(best[gap], best[above]) < limit
            }
            parts = {gap: halves for gap, halves in parts.items() if len(halves) > 1}
            if not parts:
                break
            # The lower half has the same commands at rest as the whole.
            for gap, (lower, _) in parts.items():
                best[lower] = best.pop(gap)
            upper = [halves[1] for halves in parts.values()]
            for place in likelihood.scan(fit.orders, fit.solution.c, upper, delays):
                best.setdefault(place.gap, place.deviance)
        return sorted(gap for gap in best if best[gap] < min(best.values()) + NEAR)

    def _prior(self, gap: Gap) -> float:
        """Return the probability beforehand: a half that there is no dead zone."""
        if self._likelihood.options.applied:
            return 1.0
        share = (gap.high - gap.low) / float(self._likelihood.magnitudes[-1])
        return 0.5 * share + 0.5 * (gap.low == 0.0)

    def _choose(self, entries: list[Entry], weights: Array) -> Candidate:
        """Return the fit of the likeliest orders with the delay and the dead zone."""
        there = np.array([entry.place.delay == self.delay.value for entry in entries])
        shares = np.bincount([entry.number for entry in entries], weights * there)
        best = max(
            (entry for entry, right in zip(entries, there, strict=True)
             if right and entry.number == int(np.argmax(shares))),
            key=lambda entry: (
                entry.place.gap.low <= self.dead_zone.value <= entry.place.gap.high,
                -entry.place.deviance,
            ),
        )  # fmt: skip
        return self._likelihood.fit(best.place, best.fit.orders, best.fit.solution.c)

    def _draw(self, entries: list[Entry], weights: Array) -> list[LinearModel]:
        generator = np.random.default_rng(0)
        points = (np.arange(PLACES) + generator.random()) / PLACES
        picked = np.minimum(np.searchsorted(np.cumsum(weights), points), len(weights) - 1)
        walks: dict[Candidate, tuple[list[tuple[Orders, Array]], Array]] = {}
        draws = []
        for i, times in zip(*np.unique(picked, return_counts=True), strict=True):
            _, fit, place = entries[i]
            if fit not in walks:
                walks[fit] = self._walks(fit)
            likely, shares = walks[fit]
            counts = generator.multinomial(times * DRAWS_EACH, shares)
            for (orders, c), count in zip(likely, counts, strict=True):
                if not count:
                    continue
                found = self._likelihood.linear(place, orders, c)
                size = len(found.solution.linear)
                covariance = self.covariance(found)[:size, :size]
                draws += [
                    self._linear(found, linear)
                    for linear in generator.multivariate_normal(
                        found.solution.linear, covariance, count, method="eigh"
                    )
                ]
        return draws

    def _walks(self, fit: Candidate) -> tuple[list[tuple[Orders, Array]], Array]:
        """Return orders and C' for random walks of all sizes, and their probabilities.

        A walk that no criterion asks for may still move the base line, above all where the
        noise is slow as well. Its size is the root of C' nearest 1: there the walk is none. The
        probability beforehand is a half for that, and the rest is even over the logarithm of
        the root's distance from 1. The coefficients of A, B and the levels are integrated over.
        """
        rest = np.roots([1.0, *fit.solution.c])
        if fit.orders.walk:
            rest = np.delete(rest, np.argmax(rest.real - 9.0 * (rest.imag != 0.0)))
        c = np.atleast_1d(np.real(np.poly(rest)))
        orders = replace(fit.orders, walk=True)
        target, columns = self._likelihood.regressors(fit.place, orders)
        both = np.column_stack([columns, target])
        found, scores = [], []
        for distance in WALKS:
            of_walk = np.convolve(c, [1.0, distance - 1.0])[1:]
            white = self._likelihood.white(both, of_walk, orders)
            sizes = np.abs(np.diag(np.linalg.qr(white, mode="r")))
            sizes = np.maximum(sizes, 1e-300)
            freedom = len(white) - len(sizes) + 1
            scores.append(-freedom * math.log(sizes[-1]) - float(np.log(sizes[:-1]).sum()))
            found.append((orders, of_walk))
        found[0] = replace(orders, walk=False), c[1:]
        shares = np.exp(np.array(scores) - max(scores))
        shares[0] *= len(WALKS) - 1
        return found, shares / shares.sum()

    def _linear(self, fit: Candidate, linear: Array) -> LinearModel:
        a, b = fit.orders.a, fit.orders.b
        return LinearModel(
            [1.0, *linear[:a].tolist()],
            linear[a : a + b].tolist(),
            delay=fit.place.delay,
            sampling_interval=self._likelihood.log.sampling_interval,
        )

    def covariance(self, fit: Candidate) -> Array:
        """Return the covariance of the linear coefficients and C."""
        target, columns = self._likelihood.regressors(fit.place, fit.orders)
        return self._likelihood.rows.covariance(
            target, columns, fit.solution, walk=fit.orders.walk
        )

    def time_constant(self, interval: float) -> Interval:
        """Return the time constant of the slowest pole, s."""
        value = self._linear(self.chosen, self.chosen.solution.linear)
        drawn = np.array([slowest(draw.a) for draw in self.draws])
        return _interval(interval * slowest(value.a), interval * drawn)

    def noise_variance(self) -> Interval:
        """Return the variance of the prediction errors, degC^2."""
        freedom = len(self._likelihood.rows) - self.chosen.orders.count
        low, high = stats.chi2.ppf(ENDS, freedom)
        square = self.chosen.solution.square
        return Interval(square / freedom, square / float(high), square / float(low))

    def coefficients(self) -> dict[str, Interval]:
        """Return A, B and C of the chosen fit with intervals, by name."""
        fit = self.chosen
        values = np.concatenate([fit.solution.linear, fit.solution.c])
        spreads = stats.norm.ppf(ENDS[1]) * np.sqrt(np.diag(self.covariance(fit)))
        a, b, all_linear = fit.orders.a, fit.orders.b, len(fit.solution.linear)
        places = {f"a{i + 1}": i for i in range(a)} | {f"b{i + 1}": a + i for i in range(b)}
        places |= {f"c{i + 1}": all_linear + i for i in range(fit.orders.noise)}
        return {
            name: Interval(*(float(values[i] + sign * spreads[i]) for sign in (0, -1, 1)))
            for name, i in places.items()
        }


def slowest(a: Sequence[float]) -> float:
    """Return the time constant that a step response ends with, samples.

    It is that of the largest real pole above 0, if any: poles below 0, whose responses change
    sign at every sample, tell how the noise is made.
    """
    poles = np.roots(a)
    settling = poles[np.isreal(poles) & (poles.real > 0.0)]
    size = float(np.max(np.abs(settling if len(settling) else poles), initial=0.0))
    return math.inf if size >= 1.0 else -1.0 / math.log(max(size, 1e-12))


def _interval(value: float, drawn: Array) -> Interval:
    """Return a value with the quantiles of draws."""
    # Without interpolation: between a number and infinity there is none.
    low, high = np.quantile(drawn, ENDS, method="nearest")
    return Interval(value, min(float(low), value), max(float(high), value))


def _of_delay(places: list[Place], likeliest: Array, weights: Array) -> Interval:
    """Return the delay that has most probability within one sample, and its interval."""
    delays = np.array([place.delay for place in places])
    tried = np.unique(delays)
    shares, of_interval = (
        np.array([each[delays == delay].sum() for delay in tried])
        for each in (likeliest, weights)
    )
    near = np.abs(tried[:, np.newaxis] - tried) <= 1
    # Of equal ones, the delay that is itself the likelier.
    value = float(tried[np.lexsort((shares, (near @ shares).round(6)))[-1]])
    # Of whole samples, the fewest in a row that have the probability.
    sums = np.concatenate([[0.0], np.cumsum(of_interval)])
    first, last = np.nonzero(sums[1:] - sums[:-1, np.newaxis] >= CONFIDENCE - 1e-9)
    best = np.lexsort((sums[first] - sums[last + 1], tried[last] - tried[first]))[0]
    low, high = float(tried[first[best]]), float(tried[last[best]])
    return Interval(value, min(low, value), max(high, value))


def _of_dead_zone(places: list[Gap], weights: Array, slack: float) -> Interval:
    """Return the dead zone: its posterior is spread evenly within each gap.

    The commands at both ends of a gap may be off by `slack`, t/h.
    """
    each = np.array([(gap.low, gap.high) for gap in places])
    gaps, member = np.unique(each, axis=0, return_inverse=True)
    shares = np.bincount(member.ravel(), weights)
    sums = np.cumsum(shares)
    below = np.column_stack([sums - shares, sums]).ravel()
    low, middle, high = np.interp([ENDS[0], 0.5, ENDS[1]], below, gaps.ravel()).tolist()
    low, high = max(low - slack, 0.0), high + slack
    if gaps[0, 0] == 0.0 and shares[0] > 0.5:
        return Interval(0.0, 0.0, high)  # every command has had an effect
    return Interval(middle, low, high)
