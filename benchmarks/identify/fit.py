"""Fit (28) and the dead zone of (29) to a log: choose the orders, delay and dead zone."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from copy import copy
from dataclasses import replace

import numpy as np
from scipy import stats

from benchmarks.identify.__main__ import Knowledge
from benchmarks.identify.armax import Array, Orders
from benchmarks.identify.cleaning import cleaned
from benchmarks.identify.guards import doubts
from benchmarks.identify.likelihood import Fit, Likelihood
from benchmarks.identify.log import Log
from benchmarks.identify.model import CannotTellError, HeldOut, Model
from benchmarks.identify.plant import noise_of
from benchmarks.identify.posterior import posterior
from benchmarks.identify.simulation import explained, of_impulse_response
from benchmarks.identify.valve import valve_fault

FIRST_ORDERS = Orders(2, 1, 2)  # of the first search for the delay
EVIDENT = 100.0  # gain in twice the log likelihood from which on an effect is beyond doubt


def identify(log: Log, knowledge: Knowledge | None = None) -> Model:
    """Fit (28), and the dead zone of (29), to a log.

    Models with several orders of A, B and C, with and without a random walk of the base line,
    are fitted by maximum likelihood. The best by information criteria are refitted to the first
    part of the log and simulate the rest; clearly worse ones are dropped. The intervals of
    delay, dead zone, gain and time constant come from the posterior over the rest. If a fault
    of the valve explains the log clearly better, the flow that it passes is fitted.

    Raises
    ------
    CannotTellError
        If the log does not determine the plant; the message says why.
    ValueError
        If the knowledge is invalid or does not fit the log.
    """
    knowledge = knowledge or Knowledge()
    log = cleaned(log, knowledge)
    likelihood = Likelihood(log, knowledge)
    fits = _fits(likelihood)
    _check_answer(likelihood, fits[0])
    rival = _of_impulse_response(likelihood)
    fault = valve_fault(likelihood, fits)
    if fault:
        log = replace(log, flow=fault.passed + likelihood.operating_flow)
        likelihood = Likelihood(
            log, replace(knowledge, operating_flow=likelihood.operating_flow)
        )
        fits = _fits(likelihood)
    tried = _tried(likelihood, fits, rival)
    chosen, possible, estimates = posterior(likelihood, list(tried))
    share = next(share for fit, share in tried.items() if fit.orders == chosen.orders)
    plant, *of_known = likelihood.models(chosen)
    noise, c = noise_of(
        replace(plant, c=(1.0, *chosen.c)), chosen.orders, estimates["noise_variance"].value
    )
    simulated = likelihood.simulated(chosen)
    level = float(np.nanmean(log.temperature - simulated))
    model = Model(
        plant=replace(plant, c=c), noise=noise,
        known=dict(zip(log.disturbances, of_known, strict=True)),
        estimates=estimates, possible=possible,
        u_min=likelihood.u_min, u_max=likelihood.u_max,
        operating_flow=likelihood.operating_flow, operating_temperature=level,
        orders=chosen.orders, errors=likelihood.errors(chosen, bridged=False),
        held_out=HeldOut(share, rival), held_out_rows=likelihood.last,
        log=log, simulated=level + simulated, fault=fault,
    )  # fmt: skip
    longest = likelihood.knowledge.longest_delay
    return replace(model, warnings=doubts(model, longest), notes=_notes(model, likelihood))


def _fits(likelihood: Likelihood) -> list[Fit]:
    """Return fits of promising orders, the best first."""
    scanned = []
    for base in likelihood.first_fits([FIRST_ORDERS, replace(FIRST_ORDERS, walk=True)]):
        finer = likelihood.gaps(base.place.gap)
        gap = likelihood.scan(base.orders, base.c, finer)[0].gap
        for a, b in itertools.product((1, 2, 3), (1, 2, 3, 6, 12)):
            orders = Orders(a, b, 2, base.orders.walk)
            place = likelihood.scan(orders, base.c, [gap])[0]
            scanned.append((orders, place, base.c))
    scanned.sort(key=lambda each: likelihood.criterion(each[0], each[1].deviance))
    # Keep at least one of each kind: a common C does not suit all of them.
    of_kinds = [
        next(each for each in scanned if (each[0].walk, each[0].b > 3) == kind)
        for kind in itertools.product((False, True), repeat=2)
    ]
    fits: dict[Orders, Fit] = {}
    for orders, place, c in [*scanned[:7], *of_kinds]:
        if orders not in fits:
            fits[orders] = likelihood.best_fit(place, orders, c)
    for fit in likelihood.ranked(fits.values())[:3]:
        for of_c in (0, 1, 3):
            orders = replace(fit.orders, c=of_c)
            if orders not in fits:
                fits[orders] = likelihood.best_fit(fit.place, orders, fit.c)
    found = likelihood.ranked(fits.values())
    return [fit for fit in found if not fit.walks_nowhere] or found


def _from_impulse_response(likelihood: Likelihood, best: Fit) -> list[Fit]:
    """Return fits that start from an impulse response.

    What it simulates has no noise, so that least squares find A. The search for C starts at A,
    where the noise is white, as that of a transmitter, and at each single pole of A, which the
    plant then does not share with the noise. The likelihood has peaks there that a search
    from the noise of other orders may miss.
    """
    inputs = [likelihood.applied(best.place.gap), *likelihood.known]
    smooth = copy(likelihood)
    smooth.smooth(
        of_impulse_response(inputs, likelihood.output, np.isfinite(likelihood.output))
    )
    found = []
    for b in (1, 2, 3):
        orders = Orders(2, b, 0)
        place = smooth.scan(orders, np.zeros(0), [best.place.gap])[0]
        a = smooth.fit(place, orders).linear[:2]
        starts = [a, *([-pole] for pole in np.roots([1.0, *a]).real)]
        for c in map(np.array, starts):
            orders = Orders(2, b, len(c))
            place = likelihood.scan(orders, c, [best.place.gap])[0]
            found.append(likelihood.fit(place, orders, c))
    return found


def _tried(likelihood: Likelihood, fits: list[Fit], rival: float) -> dict[Fit, float]:
    """Return the fits that simulate the last part well, and the shares explained there.

    `rival` is the share that an impulse response explains. If it is far larger, the fits that
    start from an impulse response are tried, however likely they are.
    """
    last, start = likelihood.last, likelihood.first()
    mild = likelihood.ranked(fits, mild=True)
    long = [fit for fit in fits if fit.orders.b > 3]  # with a response of any shape
    shares: dict[Fit, float] = {}

    def simulate(tried: Iterable[Fit]) -> None:
        for fit in tried:
            simulated = start.simulated(start.fit(fit.place, fit.orders, fit.c))
            shares[fit] = explained(likelihood.output, simulated, last)

    simulate(dict.fromkeys([*fits[:4], *mild[:2], *long[:1]]))
    far_behind = 1.0 - max(shares.values()) > 1.5 * (1.0 - rival)
    # What is worse by 25 in the Bayesian criterion is improbable: e^-12.
    most = 25.0 + likelihood.criterion(fits[0].orders, fits[0].place.deviance)
    simulate(
        fit for fit in _from_impulse_response(likelihood, fits[0])
        if far_behind or likelihood.criterion(fit.orders, fit.place.deviance) < most
    )  # fmt: skip
    # What the best simulation leaves unexplained, with a margin for the noise of a fifth.
    left = 1.0 - max(shares.values())
    good = {
        f: share for f, share in shares.items() if 1.0 - share <= max(1.2 * left, left + 0.005)
    }
    return good or dict(list(shares.items())[:1])


def _of_impulse_response(likelihood: Likelihood, *more: Array) -> float:
    """Return the share of the last part that an impulse response explains, of more inputs."""
    inputs = [likelihood.command, *likelihood.known, *more]
    impulse = of_impulse_response(inputs, likelihood.output, ~likelihood.last)
    return explained(likelihood.output, impulse, likelihood.last)


def _check_answer(likelihood: Likelihood, best: Fit) -> None:
    """Refuse a log in which the effect of the flow cannot be distinguished from noise."""
    gained = likelihood.gained(best)
    if gained < EVIDENT < _gained_when_swapped(likelihood):
        raise CannotTellError(
            "the direction is unusual: the flow answers the temperature rather than the "
            "temperature the flow. The two columns seem to be swapped; name them with "
            "--flow and --temperature. If they are not, the flow has too little effect to be "
            "told from noise: move it further, or move the set point of a closed loop more"
        )
    # Many delays and dead zones have been tried, so the best of them gains by chance.
    tried = len(likelihood.delays) * len(likelihood.gaps())
    least = float(stats.chi2.isf(0.01 / tried, best.orders.b))
    if gained < least:
        raise CannotTellError(
            "the temperature does not answer the flow in this log: a model without the "
            f"flow explains it as well (twice the log likelihood differs by {gained:.1f}, "
            f"and {least:.1f} are asked for). Move the flow further or longer, or look for "
            f"a longer delay with --longest-delay. {_of_other_columns(likelihood)}"
        )


def _gained_when_swapped(likelihood: Likelihood) -> float:
    """Return how much the temperature adds to twice the log likelihood of the flow."""
    log, longest_delay = likelihood.log, likelihood.knowledge.longest_delay
    mirrored = Log(log.temperature, log.flow, log.sampling_interval)
    try:
        swapped = Likelihood(mirrored, Knowledge(longest_delay=longest_delay))
        return swapped.gained(swapped.first_fits([FIRST_ORDERS])[0])
    except ValueError:
        return 0.0


def _of_other_columns(likelihood: Likelihood) -> str:
    """Return advice on columns that are held in steps and help to explain the temperature."""
    alone = max(_of_impulse_response(likelihood), 0.0)
    names = [
        f"--disturbance {name}"
        for name, each in likelihood.log.others.items()
        if np.isfinite(each).all() and np.mean(np.diff(each) == 0.0) > 0.5 and np.ptp(each)
        and _of_impulse_response(likelihood, each) > alone + 0.05
    ]  # fmt: skip
    return f"More is explained with {' or '.join(names)}: try that." if names else ""


def _notes(model: Model, likelihood: Likelihood) -> list[str]:
    """Return remarks for the user about the log and the fit."""
    log = model.log
    walk = model.noise["disturbance_walk_variance"]
    constants = len(log.flow) * log.sampling_interval / model.estimates["time_constant"].value
    notes = [
        (walk > likelihood.resolution,
         f"The base line wanders by {np.sqrt(walk):.2g} {log.temperature_unit} a sample, as a "
         "random walk: `disturbance_walk_variance`. What the plant settles at is known less "
         "well."),
        (constants < 3.0,
         "The log holds less than three time constants of the plant. Its gain rests on "
         "how the response goes on, which no one has seen."),
    ]  # fmt: skip
    others = _of_other_columns(likelihood)
    return [
        *log.notes,
        *(note for holds, note in notes if holds),
        *([others] if others else []),
    ]
