"""Find out whether something other than a dead zone lies between the command and the flow.

Whatever the valve, the plant behind it is linear. So the flows that faulty valves of several
kinds and sizes would pass are put in the place of the command, and the likelihoods of the log
are compared. The fault that explains the log best is the one that is found.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

from benchmarks.identify.armax import Array
from benchmarks.identify.likelihood import Fit, Gap, Likelihood, dead_within
from benchmarks.identify.model import Fault
from benchmarks.identify.simulation import held

# Sizes that are tried, as shares of the range of the flow: smaller ones do no harm, and larger
# ones leave too little of the log.
WIDTHS = np.geomspace(0.15, 0.6, 12)
CENTRES, ZONES = (-0.3, -0.2, -0.1, 0.1, 0.2, 0.3), (0.05, 0.1, 0.15, 0.2, 0.25)
RATIOS = (0.5, 0.625, 0.8, 1.25, 1.6, 2.0)  # of the gain above a flow to that below
# Least gain in twice the log likelihood for a fault to be reported. The log of a sound valve
# excludes backlash of these widths, so that little is asked for. The other faults show in fewer
# samples, and the best of many sizes gains by chance.
LEAST = {"backlash": 1.0, "stiction": 6.0, "gain": 8.0, "zone": 10.0}


def valve_fault(likelihood: Likelihood, fits: list[Fit]) -> Fault | None:
    """Return the fault that explains a log best, if it is evident enough.

    `fits` are those without a fault, the best first. The orders and C of the best one are
    tried, and of the best one of the other kind: a random walk may stand for a fault.
    """
    best = fits[0]
    others = [fit for fit in fits if fit.orders.walk != best.orders.walk]
    without = likelihood.criterion(best.orders, best.place.deviance)
    gaps = dict.fromkeys([Gap(0.0, 0.0), best.place.gap])
    found: list[tuple[float, Fault]] = []
    for kind, fault in _faults(likelihood):
        flows = [dead_within(gap, fault.passed) for gap in gaps]
        criterion = min(
            likelihood.criterion(fit.orders, likelihood.of_flows(flows, fit))
            for fit in [best, *others[:1]]
        )
        if without - criterion > LEAST[kind]:
            found.append((criterion, fault))
    return min(found, key=lambda each: each[0])[1] if found else None


def _faults(likelihood: Likelihood) -> Iterator[tuple[str, Fault]]:
    """Yield faults of all kinds and sizes, with their kinds."""
    flow, unit = held(likelihood.command), likelihood.log.flow_unit
    span, rest = float(np.ptp(flow)), likelihood.operating_flow
    test = (
        "Test the valve: move the flow up and down in small steps, twice in each direction. If "
        "it follows them all, the plant is not of the model's form."
    )
    for width, passed in zip(span * WIDTHS, _backlash(flow, span * WIDTHS), strict=True):
        what = f"The flow seems to depend on its last direction: backlash of {width:.2g}"
        yield "backlash", Fault(f"{what} {unit} explains the log better.", test, passed)
    for least, passed in zip(
        span * WIDTHS / 2, _stiction(flow, span * WIDTHS / 2), strict=True
    ):
        what = f"The valve seems to stick: stiction of ±{least:.2g}"
        yield "stiction", Fault(f"{what} {unit} explains the log better.", test, passed)
    for centre, ratio in itertools.product(span * np.array([-0.2, 0.0, 0.2]), RATIOS):
        what = f"The gain above {rest + centre:.4g} {unit} seems {ratio:.2g} times that below"
        advice = "Identify both sides from logs of their own."
        above, below = min(ratio, 1.0), min(1.0 / ratio, 1.0)  # so that the gain is the larger
        passed = centre + np.where(flow > centre, above, below) * (flow - centre)
        yield "gain", Fault(f"{what}, roughly.", advice, passed)
    for centre, zone in itertools.product(span * np.array(CENTRES), span * np.array(ZONES)):
        within = np.abs(flow - centre) < zone
        where = f"{rest + centre:.4g}"
        what = f"There seems to be a dead zone around {where} {unit}, not around {rest:g}"
        advice = f"If that is the operating point, say --operating-flow {where}. {test}"
        for inside in (0.0, centre):
            yield "zone", Fault(f"{what} {unit}.", advice, np.where(within, inside, flow))


def _backlash(flow: Array, widths: Array) -> Array:
    """Return the flow past a backlash of each width, shape (widths, rows)."""
    passed, at = np.empty((len(widths), len(flow))), flow[0] + 0.0 * widths
    for k, u in enumerate(flow):
        at = passed[:, k] = np.clip(at, u - widths / 2.0, u + widths / 2.0)
    return passed


def _stiction(flow: Array, least: Array) -> Array:
    """Return the flow of a valve that does not make a move of less than each of some steps."""
    passed, at = np.empty((len(least), len(flow))), flow[0] + 0.0 * least
    for k, u in enumerate(flow):
        at = passed[:, k] = np.where(np.abs(u - at) > least, u, at)
    return passed
