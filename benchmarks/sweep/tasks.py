"""What is run on each plant of a sweep: every controller, and the limit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchmarks.controllers.records import Factory
from benchmarks.limits import least_possible
from benchmarks.loop.designs import Arguments
from benchmarks.loop.metrics import measure, steady_stretches
from benchmarks.loop.rollout import make_plants, rollout
from mptc_gym import Parameters

SETPOINT: Arguments = {"setpoint": "square", "setpoint_period": 600}


def limit_task(plant: Arguments, samples: int) -> dict[str, float | None]:
    """Return the least mean |e| on a plant, degC; None if it does not settle between changes.

    It is the least possible error if each change of the set point finds the plant settled and
    is not foreseen; see `benchmarks.limits`.
    """
    case = {**plant, **SETPOINT}
    try:
        limit = least_possible(samples=samples, kind="reference", folder=None, **case)
    except ValueError:
        return {"mae": None}
    return {"mae": limit.value}


def agent_task(
    factory: Factory, nominal: Arguments, plant: Arguments, samples: int, runs: int, seed: int
) -> dict[str, list[float]]:
    """Run a controller that is made for the nominal plant, and told about it, on another.

    Run i has the noise, and the initial weights, of seed `seed + i`.

    Returns
    -------
    dict of list
        Of each run, every measure of `METRICS`; `late`, the mean |e| of its second half; and
        `swing`, the standard deviation of the error on the steady stretches, both in degC.
    """
    controller = factory.in_service({**nominal, **SETPOINT}, runs, seed)
    case = {**plant, **SETPOINT}
    plants = make_plants(runs, samples, **factory.arguments(case))
    trajectory = rollout(plants, controller, samples, seed)
    steady = steady_stretches(trajectory.setpoint[:, 0])
    measures = {
        **measure(trajectory, Parameters(**case)),
        "late": np.abs(trajectory.error[samples // 2 :]).mean(axis=0),
        "swing": swing(trajectory.setpoint - trajectory.output, steady),
    }
    return {name: values.tolist() for name, values in measures.items()}


def swing(error: NDArray[np.float64], steady: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the deviation of the error within each stretch, in the mean square of all.

    The error has the shape (samples, runs), `steady` the shape (samples,).
    """
    edges = np.flatnonzero(np.diff(steady, prepend=False, append=False))
    variances = [
        error[start:stop].var(axis=0)
        for start, stop in zip(edges[::2], edges[1::2], strict=True)
    ]
    deviation: NDArray[np.float64] = np.sqrt(np.mean(variances, axis=0))
    return deviation
