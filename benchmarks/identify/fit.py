"""Fit (28) and the dead zone of (29) to a log: choose the orders, delay and dead zone."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
from scipy import stats

from benchmarks.identify.armax import Orders
from benchmarks.identify.cleaning import cleaned
from benchmarks.identify.likelihood import Fit, Likelihood
from benchmarks.identify.log import Log
from benchmarks.identify.model import CannotTellError, HeldOut, Model
from benchmarks.identify.options import Knowledge
from benchmarks.identify.plant import noise_of
from benchmarks.identify.posterior import posterior
from benchmarks.identify.simulation import explained, of_impulse_response

OWN_LAGS = 0.6, 0.75, 0.85, 0.92, 0.96  # poles of the plant that are not poles of the noise
FIRST_ORDERS = Orders(2, 1, 2)  # orders of the first search for the delay
OF_A, OF_B, OF_C = (1, 2, 3), (1, 2, 3, 6, 12), (0, 1, 3)
LONG = 3  # coefficients of B beyond which the response may have any shape
WORTH_A_FIT = 7  # orders that are fitted: the best with a common C
WORTH_A_TRIAL = 4  # fits that are tried on the last third: the best
CLOSE = 12.0  # difference in the criterion beyond which orders are dropped
WORSE = 1.2  # multiple of the least unexplained share beyond which orders are dropped
WEAK = 100.0  # gain in twice the log likelihood below which the columns may be swapped
CHANCE = 0.01  # probability that a flow without effect is accepted
SLOW = 3.0  # time constants that a log should cover


def identify(log: Log, knowledge: Knowledge | None = None) -> Model:
    """Fit (28), and the dead zone of (29), to a log.

    Models with several orders of A, B and C, with and without a random walk of the base line,
    are fitted by maximum likelihood. The best by information criteria are refitted to the first
    two thirds of the log and simulate the last third; clearly worse ones are dropped. The
    intervals of delay, dead zone, gain and time constant come from the posterior over the rest.

    Raises
    ------
    CannotTellError
        If the log does not determine the plant; the message says why.
    ValueError
        If the knowledge is invalid or does not fit the log.
    """
    knowledge = knowledge or Knowledge()
    given = Orders(*knowledge.orders) if knowledge.orders else None
    if given and min(given.a, given.b) < 1:
        raise ValueError(
            f"--orders: A and B must have at least 1 coefficient, got {(given.a, given.b)}"
        )
    log = cleaned(log, knowledge, given)
    likelihood = Likelihood(log, knowledge, given or Orders(max(OF_A), max(OF_B), 0))
    fits = likelihood.first_fits([given]) if given else _fits(likelihood)
    _check_answer(likelihood, fits[0])
    fits, held_out = _tried(likelihood, fits)
    chosen, possible, estimates = posterior(likelihood, fits)
    plant, *known = likelihood.models(chosen)
    largest = float(np.max(np.abs(plant.poles), initial=0.0))
    if largest >= 1.0 - 1e-4:
        raise CannotTellError(
            "the log does not show where the temperature settles: the best model has a "
            f"pole at {largest:.4f}, and one below 1 is asked for. Hold the flow longer, "
            "and see whether the temperature drifts"
        )
    noise, c = noise_of(
        replace(plant, c=(1.0, *chosen.c)), chosen.orders, estimates["noise_variance"].value
    )
    simulated = likelihood.simulated(chosen)
    level = float(np.nanmean(log.temperature - simulated))
    model = Model(
        plant=replace(plant, c=c), noise=noise,
        known=dict(zip(log.disturbances, known, strict=True)),
        estimates=estimates, possible=possible,
        u_min=likelihood.u_min, u_max=likelihood.u_max,
        operating_flow=likelihood.operating_flow, operating_temperature=level,
        orders=chosen.orders, errors=likelihood.errors(chosen, bridged=False),
        held_out=held_out, log=log, simulated=level + simulated, notes=list(log.notes),
    )  # fmt: skip
    model.notes.extend(_notes(model, likelihood))
    return model


def _fits(likelihood: Likelihood) -> list[Fit]:
    """Return fits of promising orders, the best first, then two with a lag of their own."""
    scanned = []
    for base in likelihood.first_fits([FIRST_ORDERS, replace(FIRST_ORDERS, walk=True)]):
        for a, b in itertools.product(OF_A, OF_B):
            orders = Orders(a, b, 2, base.orders.walk)
            place = likelihood.scan(orders, base.c, [base.place.gap])[0]
            scanned.append((orders, place, base.c))
    scanned.sort(key=lambda each: likelihood.criterion(each[0], each[1].deviance))
    # Keep at least one of each kind: a common C does not suit all of them.
    of_kinds = [
        next(each for each in scanned if (each[0].walk, each[0].b > LONG) == kind)
        for kind in itertools.product((False, True), repeat=2)
    ]
    fits: dict[Orders, Fit] = {}
    for orders, place, c in [*scanned[:WORTH_A_FIT], *of_kinds]:
        if orders not in fits:
            fits[orders] = likelihood.best_fit(place, orders, c)
    for fit in likelihood.ranked(fits.values())[:3]:
        for of_c in OF_C:
            orders = replace(fit.orders, c=of_c)
            if orders not in fits:
                fits[orders] = likelihood.best_fit(fit.place, orders, fit.c)
    found = likelihood.ranked(fits.values())
    # A second time constant that the noise does not share has its own peak of the likelihood.
    lags = []
    for orders in (Orders(2, 1, 1), Orders(2, 2, 1)):
        tried = []
        for pole in OWN_LAGS:
            c = np.array([-pole])
            place = likelihood.scan(orders, c, [found[0].place.gap])[0]
            tried.append(likelihood.with_c(place, orders, c))
        lags.append(min(tried, key=lambda fit: fit.place.deviance))
    return [*([fit for fit in found if not fit.walks_nowhere] or found), *lags]


def _tried(likelihood: Likelihood, fits: list[Fit]) -> tuple[list[Fit], HeldOut]:
    """Return the fits that simulate the last third well, and the shares explained there."""
    cut = int(likelihood.rows.index[len(likelihood.rows.index) * 2 // 3])
    last, start = np.arange(len(likelihood.output)) >= cut, likelihood.first(cut)
    mild = likelihood.ranked(fits, mild=True)
    long = [fit for fit in fits if fit.orders.b > LONG]
    own_lag = [fit for fit in fits if fit.has_own_lag]
    shares = {}
    for fit in dict.fromkeys([*fits[:WORTH_A_TRIAL], *mild[:2], *long[:1], *own_lag]):
        simulated = start.simulated(start.fit(fit.place, fit.orders, fit.c))
        shares[fit] = explained(likelihood.output, simulated, last)
    # The share that the best simulation leaves unexplained, with a margin for the noise.
    left = 1.0 - max(shares.values())
    least = max(WORSE * left, left + 0.005)
    good = [
        fit for fit, share in shares.items()
        if 1.0 - share <= least * (2.0 if fit.has_own_lag else 1.0)
    ] or list(shares)[:1]  # fmt: skip
    criteria = [likelihood.criterion(fit.orders, fit.place.deviance, mild=True) for fit in good]
    # Keep one of each kind: with and without a walk; with one, few or many coefficients of B;
    # with and without a time constant that the noise does not share.
    kinds: dict[tuple[bool, ...], Fit] = {}
    for fit, each in zip(good, criteria, strict=True):
        if each < min(criteria) + CLOSE:
            orders = fit.orders
            kind = orders.walk, orders.b > LONG, fit.has_own_lag, orders.b > 1
            kinds.setdefault(kind, fit)
    inputs = [likelihood.command, *likelihood.known]
    impulse, _ = of_impulse_response(inputs, likelihood.output, ~last)
    rival = explained(likelihood.output, impulse, last)
    return list(dict.fromkeys([good[0], *kinds.values()])), HeldOut(shares[good[0]], rival)


def _check_answer(likelihood: Likelihood, best: Fit) -> None:
    """Refuse a log in which the effect of the flow cannot be distinguished from noise."""
    gained = likelihood.gained(best)
    if gained < WEAK and _gained_when_swapped(likelihood) > WEAK:
        raise CannotTellError(
            "the direction is unusual: the flow answers the temperature rather than the "
            "temperature the flow. The two columns seem to be swapped; name them with "
            "--flow and --temperature. If they are not, the flow has too little effect to be "
            "told from noise: move it further, or move the set point of a closed loop more"
        )
    # Many delays and dead zones have been tried, so the best of them gains by chance.
    tried = len(likelihood.delays) * len(likelihood.gaps())
    least = float(stats.chi2.isf(CHANCE / tried, best.orders.b))
    if gained < least:
        raise CannotTellError(
            "the temperature does not answer the flow in this log: a model without the "
            f"flow explains it as well (twice the log likelihood differs by {gained:.1f}, "
            f"and {least:.1f} are asked for). Move the flow further or longer, or look for "
            "a longer delay with --longest-delay"
        )


def _gained_when_swapped(likelihood: Likelihood) -> float:
    """Return how much the temperature adds to twice the log likelihood of the flow."""
    log, longest_delay = likelihood.log, likelihood.knowledge.longest_delay
    mirrored = Log(log.temperature, log.flow, log.sampling_interval)
    try:
        swapped = Likelihood(mirrored, Knowledge(longest_delay=longest_delay), FIRST_ORDERS)
        return swapped.gained(swapped.first_fits([FIRST_ORDERS])[0])
    except ValueError:
        return 0.0


def _notes(model: Model, likelihood: Likelihood) -> list[str]:
    """Return remarks for the user about the fit."""
    longest, log = likelihood.knowledge.longest_delay, model.log
    gain, constant = model.estimates["gain"], model.estimates["time_constant"]
    walk = model.noise["disturbance_walk_variance"]
    endless = not np.isfinite([gain.low, gain.high, constant.high]).all()
    short = SLOW * constant.value > len(log.flow) * log.sampling_interval
    at_first_flow = likelihood.knowledge.operating_flow is None and model.operating_flow != 0.0
    notes = [
        (gain.value > 0.0,
         "The direction is unusual for a boiler: the temperature rises with the flow. If it "
         "should not, see whether the columns are swapped."),
        (model.plant.delay >= longest - 1,
         f"The delay is as long as was looked for, {longest} samples: try a longer "
         "--longest-delay, or a longer sampling interval."),
        (at_first_flow,
         f"The operating point is taken at the log's first flow, {model.operating_flow:g} "
         "t/h, and a dead zone would lie around it: say --operating-flow if it is elsewhere."),
        (walk > likelihood.resolution,
         f"The base line wanders by {np.sqrt(walk):.2g} °C a sample, as a random walk: "
         "`disturbance_walk_variance`. What the plant settles at is known less well."),
        (endless,
         "The plant may be integrating: an interval has no end, as the log does not show "
         "where the temperature settles. Hold the flow longer."),
        (short and not endless,
         f"The log holds less than {SLOW:g} time constants of the plant. Its gain rests on "
         "how the response goes on, which no one has seen."),
    ]  # fmt: skip
    return [note for holds, note in notes if holds]
