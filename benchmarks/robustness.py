"""Plants that are not the one a controller was made for, and what it makes of them."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from agents import DirectNNController, PIController
from benchmarks import opponents
from benchmarks.experiments import mean_error
from benchmarks.limits import scenario_limit, steady_stretches
from benchmarks.rollout import Agent, make_plants, rollout
from benchmarks.scenarios import Scenario

Plant = dict[str, Any]  # arguments of the environment

SETPOINT: Plant = {"setpoint": "square", "setpoint_period": 600}
LEARNING = 1200  # samples on the nominal plant, with which a network is commissioned
COMMISSIONING_SEED = 3_000_000  # of the noise then, if there were any

# What a random design draws from. A gain below 0.74 puts 5 degC beyond the limits.
SPANS = {
    "delay": (6, 36),
    "dead_zone": (0.0, 8.0),
    "noise_variance": (0.0, 1.0),
    "gain_factor": (0.75, 1.6),
    "time_constant_factor": (0.5, 2.0),
}
GRID = {"delay": range(2, 42, 2), "gain_factor": np.linspace(0.75, 1.65, 10)}


def grid() -> list[Plant]:
    """Return the paper's plant with other delays and other gains, without noise."""
    return [
        {"delay": delay, "gain_factor": round(float(gain), 6)}
        for gain in GRID["gain_factor"]
        for delay in GRID["delay"]
    ]


def random_design(count: int, seed: int, samples: int) -> list[Plant]:
    """Return plants that differ in everything, spread evenly over `SPANS`.

    The second half of them drift: in the course of `samples` samples, gain and time constant
    go to another place in their spans.

    Parameters
    ----------
    count
        How many.
    seed
        Of the design, a Latin hypercube.
    samples
        How long they drift.
    """
    drawn = qmc.LatinHypercube(len(SPANS) + 2, rng=np.random.default_rng(seed)).random(count)
    drifting = ("gain_factor", "time_constant_factor")
    spans = np.array([*SPANS.values(), *(SPANS[name] for name in drifting)])
    rows = spans[:, 0] + drawn * (spans[:, 1] - spans[:, 0])
    plants = []
    for i, row in enumerate(rows.round(4).tolist()):
        plant = dict(zip(SPANS, row, strict=False)) | {"delay": round(row[0])}
        if i >= count // 2:
            gain, time_constant = row[len(SPANS) :]
            plant |= {
                "gain_drift": gain / plant["gain_factor"],
                "time_constant_drift": time_constant / plant["time_constant_factor"],
                "drift_samples": samples,
            }
        plants.append(plant)
    return plants


class Nothing:
    """Leaves the valve where it is."""

    def reset(self) -> None:
        """Do nothing."""

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return actions of 0 t/h."""
        return np.zeros((len(observation), 1), np.float32)


def network(runs: int, seed: int, *, learning: bool) -> DirectNNController:
    """Return networks that have learnt on the nominal plant, and may go on learning or not."""
    controller = DirectNNController(num_envs=runs, seed=seed)
    plants = make_plants(runs, LEARNING, **SETPOINT)
    rollout(plants, controller, LEARNING, COMMISSIONING_SEED)
    controller.learning = learning
    return controller


# By name; called with the number of runs and their first seed.
FIXED: dict[str, Callable[[int, int], Agent]] = {
    "nothing": lambda runs, seed: Nothing(),
    "nn": lambda runs, seed: network(runs, seed, learning=True),
    "nn-frozen": lambda runs, seed: network(runs, seed, learning=False),
    "pi": lambda runs, seed: PIController(),
    "pi-simc": lambda runs, seed: opponents.simc_pi(-10.0, 10.0),
    "pi-searched": lambda runs, seed: opponents.searched_pi(-10.0, 10.0),
    "smith": lambda runs, seed: opponents.smith(-10.0, 10.0),
}


def limit_cell(plant: Plant, samples: int) -> dict[str, float | None]:
    """Return the least mean |e| that is possible on a plant, degC; None if it is not known."""
    try:
        limit = scenario_limit(Scenario("", "", samples, {**plant, **SETPOINT}))
    except ValueError:  # it drifts
        return {"mae": None}
    return {"mae": limit.mae}


def agent_cell(
    agent: str, plant: Plant, samples: int, runs: int, seed: int, policy: Path | None = None
) -> dict[str, list[float]]:
    """Run a controller on a plant that it was not made for.

    Parameters
    ----------
    agent
        Its name, one of `FIXED`, or anything with a policy.
    plant
        The plant.
    samples
        Length of a run.
    runs
        How many; run i has the noise, and the initial weights, of seed `seed + i`.
    seed
        The first.
    policy
        The folder of a trained policy.

    Returns
    -------
    dict of list
        Of each run: `mae`, mean |e|; `late`, the same over the second half; and `swing`, the
        standard deviation of the error on the steady stretches; all in degC.
    """
    windows = {}
    if policy is None:
        controller = FIXED[agent](runs, seed)
    else:
        factory = _policy(policy)
        controller, windows = factory(), factory.observation
    plants = make_plants(runs, samples, **plant, **SETPOINT, **windows)
    trajectory = rollout(plants, controller, samples, seed)
    error = trajectory.setpoint - trajectory.output
    steady = steady_stretches(trajectory.setpoint[:, 0])
    measures = {
        "mae": mean_error(trajectory),
        "late": np.abs(error[samples // 2 :]).mean(axis=0),
        "swing": _swing(error, steady),
    }
    return {name: values.tolist() for name, values in measures.items()}


def _swing(error: NDArray[np.float64], steady: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the deviation of the error within each stretch, in the mean square of all."""
    edges = np.flatnonzero(np.diff(steady, prepend=False, append=False))
    variances = [
        error[start:stop].var(axis=0)
        for start, stop in zip(edges[::2], edges[1::2], strict=True)
    ]
    swing: NDArray[np.float64] = np.sqrt(np.mean(variances, axis=0))
    return swing


@cache
def _policy(folder: Path) -> Any:
    from benchmarks.ppo import kept_policy  # here: torch takes seconds to load

    return kept_policy(folder)
