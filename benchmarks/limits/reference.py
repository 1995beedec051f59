"""Plan as a controller without preview can, if each change finds the plant settled.

Three things limit every controller of this plant: an input takes d + 1 samples to show, the
actuator has limits, and the next set point is not known. How much the last costs depends on how
set points change. Where they have no law (a square wave, a list), there is no bound but that
with preview: for one given course any controller may have the times of the changes built in.
What is here is a reference under a condition: each change of the set point comes when the plant
has settled at the one before, and was not foreseen. A controller that counts samples can come
below it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchmarks.limits.programme import Plan, plan
from benchmarks.limits.unknown import Unknown
from benchmarks.loop.linear import Course
from benchmarks.loop.metrics import held

Array = NDArray[np.float64]

SETTLED = 0.05  # of the flow's range: how much a flow that has settled may move within the lag
TAIL = 60  # samples more than the lag that a plan looks beyond the end of a hold
LEVEL = 0.001  # least slope of an error that counts in plans, so that they end at the set point
SMOOTH = 1e-4  # price of a t/h of travel, so that of equal plans the quiet one is taken


def reference(
    course: Course, unknown: Unknown, setpoint: Array, *, price: float = SMOOTH
) -> Plan:
    """Return the best mean flow of a controller that never reckons with another change.

    At each change it takes, from where it is, the flow that is best if the new set point stays.
    If the plant has settled by the next change, each change costs the least that it can
    without preview: see `benchmarks.limits.programme.plan` for why, and for what is loose.

    Parameters
    ----------
    course, unknown
        The plant and what is unknown, for `course.lag + TAIL` samples more than set points.
    setpoint
        y_d(k), degC, shape (samples,).
    price
        Of valve travel, degC times samples for each t/h.

    Raises
    ------
    ValueError
        If the plant has not settled when a change comes.
    """
    holds = held(setpoint)
    settled = SETTLED * (course.high - course.low)
    found: Plan | None = None
    error = np.zeros(len(setpoint))
    for start, stop in holds:
        last = stop == len(setpoint)
        beyond = np.full(0 if last else course.lag + TAIL, setpoint[start])
        ahead = np.concatenate([setpoint[:stop], beyond])
        found = plan(
            course, unknown, ahead, before=found, start=start, price=price, least_slope=LEVEL
        )
        error[start:stop] = found.error[start:stop]
        begun = max(stop - course.lag, start)
        if not last and (
            stop - start < course.lag or np.ptp(found.flow[max(begun - 1, 0) : stop]) > settled
        ):
            raise ValueError(
                "setpoint must be held until the plant has settled, or there is no reference; "
                f"got a hold of {stop - start} samples"
            )
    assert found is not None
    moves = found.travel.sum()
    return Plan(error, found.output, found.flow, float(error.sum() + price * moves))
