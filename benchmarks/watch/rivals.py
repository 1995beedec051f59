"""Run the controllers on the plant that someone has controlled by hand."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, cast

import gymnasium
import pandas as pd

from benchmarks.controllers.roster import ROSTER
from benchmarks.limits import least_possible
from benchmarks.loop.metrics import mean_error, travel
from benchmarks.loop.rollout import Trajectory, rollout
from benchmarks.loop.scenarios import Scenario
from benchmarks.watch.touched import Touched
from mptc_gym.record import Record

Moves = dict[int, tuple[float, float]]  # k: what is added to set point and load from k + 1 on
EPISODES = 20  # of the bound, where a plant is drawn


def touched_plants(
    samples: int, arguments: Mapping[str, Any], show: Callable[[Record], None] | None = None
) -> tuple[gymnasium.vector.SyncVectorEnv, Touched]:
    """Return a batch of one plant that can be touched, and that plant."""
    plants = gymnasium.make_vec(
        "MiddlePoint-v0",
        1,
        vectorization_mode="sync",
        wrappers=(lambda env: Touched(env, show),),
        max_episode_steps=samples,
        **arguments,
    )
    assert isinstance(plants, gymnasium.vector.SyncVectorEnv)
    return plants, cast("Touched", plants.envs[0])


def replay(name: str, moves: Moves, scenario: Scenario, seed: int) -> Trajectory:
    """Run a controller of the roster, with the noise and the moves of another's run."""
    (factory,) = ROSTER[name].members()
    arguments = factory.arguments(scenario.arguments)
    plants, touched = touched_plants(scenario.samples, arguments)

    def move(k: int) -> None:
        if k in moves:
            touched.setpoint, touched.load = moves[k]

    try:
        return rollout(plants, factory(arguments, 1, seed), scenario.samples, seed, move)
    finally:
        plants.close()


def table(
    label: str, trajectory: Trajectory, moves: Moves, scenario: Scenario, seed: int
) -> pd.DataFrame:
    """Return mean error and valve travel of a run, and of the controllers; and the bound.

    There is no bound where the load was moved by hand.
    """
    runs = {label: trajectory} | {
        controller.label: replay(name, moves, scenario, seed)
        for name, controller in ROSTER.items()
        if controller.compared and not controller.trained and controller.label != label
    }
    found = {name: float(mean_error(run)[0]) for name, run in runs.items()}
    rows = [
        (name, f"{found[name]:.3f}", f"{travel(runs[name])[0]:.0f}")
        for name in sorted(found, key=lambda name: found[name])
    ]
    if not any(load for _, load in moves.values()):
        arguments, kind = dict(scenario.arguments), None
        if moves:
            # Whoever moves the set point knows it beforehand.
            kind, longer = "preview", replace(scenario, samples=scenario.samples + 1)
            arguments["setpoint"] = (
                replay("nothing", moves, longer, seed).setpoint[:, 0].tolist()
            )
        bound = least_possible(
            samples=scenario.samples, kind=kind, episodes=EPISODES, **arguments
        )
        rows.insert(0, ("least possible, on average", f"{bound.value:.3f}", ""))
    return pd.DataFrame(rows, columns=["", "mean |e| (°C)", "valve travel (t/h)"])
