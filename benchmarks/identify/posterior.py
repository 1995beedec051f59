"""Compute the posterior of orders, delays, dead zones and coefficients, given a log."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy import stats

from benchmarks.identify.armax import Array, Orders
from benchmarks.identify.likelihood import Fit, Gap, Likelihood, Place
from benchmarks.identify.model import CannotTellError, Interval
from benchmarks.lib.statistics import CONFIDENCE, ENDS
from benchmarks.loop.linear import LinearModel

# Power of the likelihood in the set of possible plants. Where a response begins rests on few
# samples after each step, and the best of thousands of delays, dead zones and orders gains by
# chance: without it the intervals of plants with a lag miss the delay in every third log.
TEMPER = 0.5
NEAR = 25.0  # deviance behind the best at which the probability is negligible, e^-12.5
WALKS = [0.0, *np.geomspace(0.001, 0.512, 10)]  # distances of the walk's root of C' from 1


class Entry(NamedTuple):
    """A place with a fit, for its orders and C."""

    fit: Fit
    place: Place


def posterior(
    likelihood: Likelihood, fits: list[Fit]
) -> tuple[Fit, list[LinearModel], dict[str, Interval]]:
    """Return the most likely fit, plants drawn from the posterior, and a `Model`'s estimates.

    `fits` has one fit for each of the candidate orders, the best first.
    """
    entries = _entries(likelihood, fits)
    # The most likely plant has the simplest adequate orders, by the Bayesian criterion. The set
    # of possible plants has Akaike's weights (K. P. Burnham and D. R. Anderson, "Model
    # Selection and Multimodel Inference", 2nd edition, 2002, section 2.9): none of the orders
    # is true, and a second time constant may account for part of the delay.
    likeliest, weights = (_weights(likelihood, entries, mild=mild) for mild in (False, True))
    delay = _of_delay([entry.place.delay for entry in entries], likeliest, weights)
    dead_zone = _of_dead_zone(likelihood, [entry.place.gap for entry in entries], weights)
    chosen = _choose(likelihood, entries, likeliest, delay.value, dead_zone.value)
    drawn = _draw(likelihood, entries, weights)
    plant, interval = likelihood.models(chosen)[0], likelihood.log.sampling_interval
    freedom = max(len(likelihood.rows) - chosen.orders.count, 1)
    high, low = (chosen.square / stats.chi2.ppf(ENDS, freedom)).tolist()
    return chosen, drawn, {
        "delay": delay,
        "dead_zone": dead_zone,
        "gain": _interval(plant.gain, [each.gain for each in drawn]),
        "time_constant": _interval(
            interval * slowest(plant.a), [interval * slowest(each.a) for each in drawn]
        ),
        "noise_variance": Interval(chosen.square / freedom, low, high),
    }  # fmt: skip


def _entries(likelihood: Likelihood, fits: list[Fit]) -> list[Entry]:
    """Return entries for each fit, over the delays near its best place."""
    found, gaps = [], likelihood.gaps()
    for i, fit in enumerate(fits):
        places = likelihood.scan(fit.orders, fit.c, gaps)
        near = [p.delay for p in places if p.deviance < places[0].deviance + 2.0 * NEAR]
        delays = range(min(near), max(near) + 1)
        if i == 0:
            gaps = _refined(likelihood, places)
            at_its_own = range(fit.place.delay, fit.place.delay + 1)
            gap = likelihood.scan(fit.orders, fit.c, gaps, at_its_own)[0].gap
        # The best C depends on the delay. It is found anew for eight delays, roughly.
        stride = max(len(delays) // 8, 1)
        for around in (delays[k : k + stride] for k in range(0, len(delays), stride)):
            refit = likelihood.fit(Place(around[len(around) // 2], gap), fit.orders, fit.c)
            places = likelihood.scan(fit.orders, refit.c, gaps, around)
            found += [Entry(refit, place) for place in places]
    return found


def _refined(likelihood: Likelihood, places: list[Place]) -> list[Gap]:
    """Return the gaps near the best, split at the commands inside them unless they are many."""
    best: dict[Gap, float] = {}
    for place in places:
        best.setdefault(place.gap, place.deviance)  # places are sorted, the best first
    # A gap has the deviance of its lower end, and the one above that of its upper end.
    gaps, limit = sorted(best), min(best.values()) + NEAR
    near = [
        gap
        for gap, above in zip(gaps, [*gaps[1:], gaps[-1]], strict=True)
        if min(best[gap], best[above]) < limit
    ]
    return [finer for gap in near for finer in likelihood.gaps(gap)] if len(near) < 7 else near


def _weights(likelihood: Likelihood, entries: list[Entry], *, mild: bool) -> Array:
    """Return the probabilities of the entries, by either criterion for their orders.

    The milder one is for the set of possible plants, and their evidence is tempered.
    """
    low, high = np.array([entry.place.gap for entry in entries]).T
    # The prior probability of no dead zone is one half.
    prior = 0.5 * (high - low) / likelihood.magnitudes[-1] + 0.5 * (low == 0.0)
    criteria = np.array([
        likelihood.criterion(entry.fit.orders, entry.place.deviance, mild=mild)
        for entry in entries
    ])  # fmt: skip
    power = TEMPER if mild else 1.0
    weights: Array = prior * np.exp(power * (criteria.min() - criteria) / 2.0)
    weights /= weights.sum()
    return weights


def _choose(
    likelihood: Likelihood, entries: list[Entry], weights: Array, delay: float, zone: float
) -> Fit:
    """Return the fit of the most likely orders with the given delay and dead zone."""
    shares: dict[Orders, float] = {}
    for entry, weight in zip(entries, weights.tolist(), strict=True):
        if entry.place.delay == delay:
            orders = entry.fit.orders
            shares[orders] = shares.get(orders, 0.0) + weight
    likeliest = max(shares, key=lambda orders: shares[orders])
    best = max(
        (e for e in entries if e.fit.orders == likeliest and e.place.delay == delay),
        key=lambda e: (e.place.gap.low <= zone <= e.place.gap.high, -e.place.deviance),
    )
    return likelihood.fit(best.place, best.fit.orders, best.fit.c)


def _draw(likelihood: Likelihood, entries: list[Entry], weights: Array) -> list[LinearModel]:
    """Draw 360 plants: 60 entries by systematic sampling, walks and coefficients at random.

    Those that do not settle are left out; if they are the most, the log is refused.
    """
    generator = np.random.default_rng(0)
    points = (np.arange(60) + generator.random()) / 60
    picked = np.minimum(np.searchsorted(np.cumsum(weights), points), len(weights) - 1)
    fits = dict.fromkeys(entries[i].fit for i in picked)
    walks = {fit: _walks(likelihood, fit) for fit in fits}
    draws = []
    for i, times in zip(*np.unique(picked, return_counts=True), strict=True):
        likely, shares = walks[entries[i].fit]
        counts = generator.multinomial(6 * times, shares)
        for (orders, c), count in zip(likely, counts, strict=True):
            if not count:
                continue
            found = likelihood.with_c(entries[i].place, orders, c)
            table = likelihood.table(orders, found.place)
            covariance = likelihood.rows.covariance(table, orders, c, found.errors)
            drawn = generator.multivariate_normal(
                found.linear, covariance, count, "ignore", method="eigh"
            )
            draws += [likelihood.models(replace(found, linear=each))[0] for each in drawn]
    stable = [each for each in draws if np.max(np.abs(each.poles), initial=0.0) < 1.0]
    # One whose time constant is longer than the log cannot be told from one that integrates.
    settling = [each for each in stable if slowest(each.a) < len(likelihood.output)]
    if len(settling) <= len(draws) / 2:
        raise CannotTellError(
            "the log does not show where the temperature settles: most of the plants that it "
            "leaves possible are integrating, unstable or slower than the log is long. Hold "
            "the flow longer, and see whether the temperature drifts"
        )
    return stable


def _walks(likelihood: Likelihood, fit: Fit) -> tuple[list[tuple[Orders, Array]], Array]:
    """Return orders and C' for random walks of all sizes, and their probabilities.

    A walk too small for any criterion to select may still move the base line, above all where
    the noise is slow too. The root of C' nearest 1 determines its size; at 1 there is no walk.
    The prior probability of no walk is one half; the rest is uniform over the logarithm of the
    root's distance from 1. The coefficients of A and B and the levels are integrated out.
    """
    rest = np.roots([1.0, *fit.c])
    if fit.orders.walk:
        rest = np.delete(rest, np.argmax(rest.real - 9.0 * (rest.imag != 0.0)))
    c = np.atleast_1d(np.real(np.poly(rest)))
    orders = replace(fit.orders, walk=True)
    table = np.roll(likelihood.table(orders, fit.place), -1, axis=1)
    found, scores = [], []
    for distance in WALKS:
        of_walk = np.convolve(c, [1.0, distance - 1.0])[1:]
        white = likelihood.white(table, of_walk, orders)
        sizes = np.abs(np.diag(np.linalg.qr(white, mode="r")))
        logs = np.log(np.maximum(sizes, 1e-300))
        scores.append(-(len(white) - len(logs)) * logs[-1] - logs.sum())
        found.append((orders, of_walk))
    found[0] = replace(orders, walk=False), c[1:]
    shares = np.exp(np.array(scores) - max(scores))
    shares[0] *= len(WALKS) - 1
    return found, shares / shares.sum()


def slowest(a: Sequence[float]) -> float:
    """Return the time constant with which a step response settles, samples.

    It belongs to the largest real pole above 0, if any: poles below 0, whose responses change
    sign at every sample, describe the noise.
    """
    poles = np.roots(a)
    settling = poles[np.isreal(poles) & (poles.real > 0.0)]
    size = float(np.max(np.abs(settling if len(settling) else poles), initial=0.0))
    return math.inf if size >= 1.0 else -1.0 / math.log(max(size, 1e-12))


def _interval(value: float, drawn: Sequence[float]) -> Interval:
    """Return a value with the interval of draws, in which it may not lie."""
    return Interval(value, *np.quantile(drawn, ENDS).tolist())


def _of_delay(delays: list[int], likeliest: Array, weights: Array) -> Interval:
    """Return the delay with the most probability within one sample of it, and its interval."""
    tried, member = np.unique(delays, return_inverse=True)
    shares, of_interval = (np.bincount(member, each) for each in (likeliest, weights))
    near = np.abs(tried[:, np.newaxis] - tried) <= 1
    # Ties go to the delay that is itself more likely.
    value = float(tried[np.lexsort((shares, (near @ shares).round(6)))[-1]])
    # The shortest run of delays that holds the required probability.
    sums = np.concatenate([[0.0], np.cumsum(of_interval)])
    first, last = np.nonzero(sums[1:] - sums[:-1, np.newaxis] >= CONFIDENCE - 1e-9)
    best = np.lexsort((sums[first] - sums[last + 1], tried[last] - tried[first]))[0]
    low, high = float(tried[first[best]]), float(tried[last[best]])
    return Interval(value, min(low, value), max(high, value))


def _of_dead_zone(likelihood: Likelihood, places: list[Gap], weights: Array) -> Interval:
    """Return the dead zone, with a posterior that is uniform within each gap.

    The commands at both ends of a gap have the error of the flow.
    """
    gaps, member = np.unique(places, axis=0, return_inverse=True)
    shares = np.bincount(member.ravel(), weights)
    sums = np.cumsum(shares)
    below = np.column_stack([sums - shares, sums]).ravel()
    low, middle, high = np.interp([ENDS[0], 0.5, ENDS[1]], below, gaps.ravel()).tolist()
    slack = float(stats.norm.ppf(ENDS[1])) * likelihood.log.flow_error
    low, high = max(low - slack, 0.0), high + slack
    if gaps[0, 0] == 0.0 and shares[0] > 0.5:
        return Interval(0.0, 0.0, high)  # every command has had an effect
    return Interval(middle, low, high)
