"""Run a controller, or compute the least possible error, on a plant of a sweep."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchmarks.bounds import least_possible
from benchmarks.controllers.records import Factory
from benchmarks.loop.designs import Arguments
from benchmarks.loop.metrics import held, measure
from benchmarks.loop.rollout import Trajectory
from mptc_gym import Parameters

SETPOINT: Arguments = {"setpoint": "square", "setpoint_period": 600}
SEED = 0  # seed of a plant's first run


def limit_task(plant: Arguments, samples: int) -> float | None:
    """Return the least mean |e| on a plant, degC; None if it does not settle between changes.

    This is the least possible error if each change of the set point finds the plant settled
    and is not foreseen; see `benchmarks.bounds`.
    """
    case = {**plant, **SETPOINT}
    try:
        return least_possible(samples=samples, kind="reference", folder=None, **case).value
    except ValueError:
        return None


def agent_task(
    factory: Factory, told: Arguments, plant: Arguments, samples: int, runs: int
) -> dict[str, list[float]]:
    """Run a controller that is made for the plant it is `told` on another plant.

    Run i has the noise and the initial weights of seed `SEED + i`.

    Returns
    -------
    dict of list
        For each run, all measures of `METRICS`; `late`, the mean |e| of its second half, degC;
        and `swing`.
    """
    controller = factory.in_service({**told, **SETPOINT}, runs, SEED)
    case = {**plant, **SETPOINT}
    trajectory = factory.run(case, samples, runs, SEED, controller)
    measures = {
        **measure(trajectory, Parameters(**case)),
        "late": np.abs(trajectory.error[samples // 2 :]).mean(axis=0),
        "swing": swing(trajectory),
    }
    return {name: values.tolist() for name, values in measures.items()}


def swing(trajectory: Trajectory) -> NDArray[np.float64]:
    """Return the swing of the error while a set point is held, degC, shape (runs,).

    This is the root mean square of the standard deviations in the second half of each hold.
    """
    error = trajectory.setpoint - trajectory.output
    variances = [
        error[(start + stop) // 2 : stop].var(axis=0)
        for start, stop in held(trajectory.setpoint[:, 0])
    ]
    deviation: NDArray[np.float64] = np.sqrt(np.mean(variances, axis=0))
    return deviation
