"""Fits (28) and the dead zone of (29) to a log: the search for delay, dead zone and orders."""

from __future__ import annotations

import math

import numpy as np
from scipy import stats

from benchmarks.identify.armax import Array, Orders
from benchmarks.identify.intervals import Estimates, polynomials
from benchmarks.identify.likelihood import MAGNITUDES, Candidate, Likelihood, Place
from benchmarks.identify.log import Log
from benchmarks.identify.model import CannotTellError, Interval, Model, Options

FIRST_ORDERS = Orders(2, 1, 2)  # to look for the delay with, before the orders are known
WORTH_A_FIT = 16.0  # candidates that the search leaves this far behind get no fit of their own
MOST_FITS = 60
WEAK = 100.0  # twice the log likelihood, below which a log may be the wrong way round
CHANCE = 0.01  # that a flow without effect is taken for one with effect


def identify(log: Log, options: Options | None = None) -> Model:
    """Fit (28), and the dead zone of (29), to a log.

    The delay and the dead zone are searched: every delay, and every gap between two neighbours
    among the magnitudes of the commands, since the likelihood is the same all over a gap.
    For each pair that is any good, A, B and C are those of maximum likelihood.

    The delay is then the one with most of the posterior within one sample, with no preference
    beforehand, and the dead zone is the median of its posterior. Their intervals hold 95 % of
    it; that of the dead zone takes gaps as a whole. The intervals of gain and time constant are
    where the likelihood, at its maximum over all else, is within what chance would explain.

    Parameters
    ----------
    log
        What was recorded.
    options
        What is known.

    Raises
    ------
    CannotTellError
        If the log cannot tell; the message says why.
    ValueError
        If the options do not fit to the log.
    """
    options = options or Options()
    likelihood = Likelihood(log, options)
    fits, criteria = _search(likelihood)
    orders = next(iter(criteria))
    _check_answer(likelihood, fits[0], orders, log)
    found = Estimates(likelihood, orders, fits)
    a, b, c, constant = polynomials(found.chosen.solution, orders)
    _check_stable(a)
    covariance = found.covariance()
    interval = log.sampling_interval
    samples = found.time_constant()
    estimates = {
        "delay": found.delay,
        "dead_zone": found.dead_zone,
        "gain": found.gain(),
        "time_constant": Interval(
            interval * samples.value, interval * samples.low, interval * samples.high
        ),
        "noise_variance": found.noise_variance(),
        **found.coefficients(covariance),
    }
    errors = np.full(len(likelihood.output), np.nan)
    errors[likelihood.rows.index] = found.chosen.solution.errors
    return Model(
        a=a, b=b, c=c,
        estimates=estimates,
        u_min=likelihood.u_min, u_max=likelihood.u_max,
        operating_flow=likelihood.operating_flow,
        operating_temperature=likelihood.level + constant / sum(a),
        orders=orders,
        sampling_interval=interval,
        criteria=criteria,
        errors=errors,
        covariance=covariance,
        profile=_profile_of_delay(fits),
        notes=_notes(found.chosen, estimates["gain"], options),
    )  # fmt: skip


def _search(likelihood: Likelihood) -> tuple[list[Candidate], dict[Orders, float]]:
    """Return the fits that are worth a look and the criterion of all orders, the best first.

    Afterwards the likelihood looks at the delays of these fits only.
    """
    first = likelihood.options.orders or FIRST_ORDERS
    _, delay, gap = likelihood.scan(first, np.zeros(0), likelihood.gaps())[0]
    c = likelihood.fit(delay, gap, first).solution.c
    best = likelihood.scan(first, c, likelihood.gaps())
    criteria = _criteria(likelihood, best, c)
    orders = next(iter(criteria))
    c = likelihood.fit(*best[0][1:], orders, c).solution.c
    gaps = likelihood.gaps()
    best = likelihood.scan(orders, c, gaps)
    if len(likelihood.magnitudes) > MAGNITUDES and likelihood.options.find_dead_zone:
        gaps = likelihood.gaps(around=best[0][2])
        best = likelihood.scan(orders, c, gaps)
    # Without the longest delays, rows at the beginning and after gaps are known, too.
    likelihood.narrow(max(delay for _, delay, _ in _near(best)))
    fits = [
        likelihood.fit(delay, gap, orders, c)
        for _, delay, gap in _near(likelihood.scan(orders, c, gaps))
    ]
    return sorted(fits, key=lambda fit: fit.deviance), criteria


def _near(found: list[Place]) -> list[Place]:
    """Return what is worth a fit of its own, out of what is sorted by its deviance."""
    return [place for place in found if place[0] < found[0][0] + WORTH_A_FIT][:MOST_FITS]


def _criteria(likelihood: Likelihood, best: list[Place], c: Array) -> dict[Orders, float]:
    """Return the Bayesian information criterion of all orders, the best first.

    A coefficient of B beyond the first counts twice: it is chosen, as the delay is, from
    several places, and one before or behind the right ones gains by chance.
    """
    places = {(delay, gap) for _, delay, gap in best[:3]}
    criteria = {}
    for orders in likelihood.orders:
        # More coefficients of B can stand for a longer delay.
        tried = places | {(delay - 1, gap) for delay, gap in places if delay and orders.b > 1}
        least = min(likelihood.fit(delay, gap, orders, c).deviance for delay, gap in tried)
        counted = orders.count + orders.b - 1
        criteria[orders] = least + counted * math.log(len(likelihood.rows))
    return dict(sorted(criteria.items(), key=lambda entry: entry[1]))


def _check_answer(likelihood: Likelihood, best: Candidate, orders: Orders, log: Log) -> None:
    """Refuse a log in which the flow does nothing that can be told from noise."""
    gained = likelihood.gained(best, orders)
    longest = likelihood.options.longest_delay
    if gained < WEAK and _gained_when_swapped(log, longest) > WEAK:
        raise CannotTellError(
            "the direction is unusual: the flow answers the temperature rather than the "
            "temperature the flow. The two columns seem to be swapped; name them with "
            "--flow and --temperature"
        )
    # As many delays and dead zones have been tried, the best of them gains by chance.
    tried = (longest + 1) * len(likelihood.gaps())
    least = float(stats.chi2.isf(CHANCE / tried, orders.b))
    if gained < least:
        raise CannotTellError(
            "the temperature does not answer the flow in this log: a model without the "
            f"flow explains it as well (twice the log likelihood differs by {gained:.1f}, "
            f"and {least:.1f} are asked for). Move the flow further or longer, or look for "
            "a longer delay with --longest-delay"
        )


def _gained_when_swapped(log: Log, longest_delay: int) -> float:
    """Return what the temperature adds to the likelihood of the flow."""
    swapped = Log(log.temperature, log.flow, log.sampling_interval)
    try:
        likelihood = Likelihood(swapped, Options(longest_delay=longest_delay))
    except ValueError:
        return 0.0
    _, delay, gap = likelihood.scan(FIRST_ORDERS, np.zeros(0), likelihood.gaps())[0]
    return likelihood.gained(likelihood.fit(delay, gap, FIRST_ORDERS), FIRST_ORDERS)


def _check_stable(a: tuple[float, ...]) -> None:
    largest = float(np.max(np.abs(np.roots(a)), initial=0.0))
    if largest >= 1.0 - 1e-4:
        raise CannotTellError(
            "the log does not show where the temperature settles: the best model has a "
            f"pole at {largest:.4f}, and one below 1 is asked for. Hold the flow longer, "
            "and see whether the temperature drifts"
        )


def _profile_of_delay(fits: list[Candidate]) -> dict[int, float]:
    """Return what each delay falls short of the best by, twice the log likelihood."""
    profile: dict[int, float] = {}
    for fit in fits:
        short = fit.deviance - fits[0].deviance
        profile[fit.delay] = min(short, profile.get(fit.delay, math.inf))
    return dict(sorted(profile.items()))


def _notes(chosen: Candidate, gain: Interval, options: Options) -> list[str]:
    """Return what the user should know about the fit."""
    notes = []
    if gain.value > 0:
        notes.append(
            "The direction is unusual for a boiler: the temperature rises with the flow. "
            "If it should not, see whether the columns are swapped."
        )
    if chosen.delay >= options.longest_delay - 1:
        notes.append(
            f"The delay is as long as was looked for, {options.longest_delay} "
            "samples: try a longer --longest-delay, or a longer sampling interval."
        )
    return notes
