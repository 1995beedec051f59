"""What is run on each plant of a sweep: every controller, and the limit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchmarks.controllers.records import Factory
from benchmarks.limits import least_possible
from benchmarks.loop.designs import Arguments
from benchmarks.loop.metrics import measure, steady_stretches
from mptc_gym import Parameters

SETPOINT: Arguments = {"setpoint": "square", "setpoint_period": 600}
SEED = 0  # of a plant's first run


def limit_task(plant: Arguments, samples: int) -> float | None:
    """Return the least mean |e| on a plant, degC; None if it does not settle between changes.

    It is the least possible error if each change of the set point finds the plant settled and
    is not foreseen; see `benchmarks.limits`.
    """
    case = {**plant, **SETPOINT}
    try:
        return least_possible(samples=samples, kind="reference", folder=None, **case).value
    except ValueError:
        return None


def agent_task(
    factory: Factory, told: Arguments, plant: Arguments, samples: int, runs: int
) -> dict[str, list[float]]:
    """Run a controller that is made for the plant that it is told on another.

    Run i has the noise, and the initial weights, of seed `SEED + i`.

    Returns
    -------
    dict of list
        Of each run, every measure of `METRICS`; `late`, the mean |e| of its second half; and
        `swing`, the standard deviation of the error on the steady stretches, both in degC.
    """
    controller = factory.in_service({**told, **SETPOINT}, runs, SEED)
    case = {**plant, **SETPOINT}
    trajectory = factory.run(case, samples, runs, SEED, controller)
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
