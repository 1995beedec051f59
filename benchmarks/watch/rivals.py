"""Run the controllers on a plant that was controlled by hand, for comparison."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pandas as pd
from gymnasium.vector import SyncVectorEnv

from benchmarks.bounds import least_possible
from benchmarks.controllers.records import Factory
from benchmarks.controllers.roster import ROSTER
from benchmarks.loop.metrics import mean_error, travel
from benchmarks.loop.rollout import Agent, Trajectory, rollout
from benchmarks.loop.scenarios import Scenario
from mptc_gym import MiddlePointEnv
from mptc_gym.record import Record

Moves = dict[int, tuple[float, float]]  # k: additions to set point and load from k + 1 on
EPISODES = 20  # for the bound, where plants are drawn


class Touched(MiddlePointEnv):
    """The environment, with a set point and a load that can be moved while it runs.

    `show`, if given, is called with a record of the last samples at each reset and step.
    """

    def __init__(
        self, show: Callable[[Record], object] | None = None, **arguments: Any
    ) -> None:
        super().__init__(render_mode="rgb_array" if show else None, **arguments)
        self._shown = show
        self.setpoint = self.load = 0.0  # added from the next sample on, degC

    def step(self, action: Any) -> Any:
        """Step the plant, with the additions to set point and load."""
        if not self._ahead:  # external signals, the next sample last
            self._look_ahead()
        setpoint, noise, load, transmitter_noise = self._ahead[-1]
        self._ahead[-1] = setpoint + self.setpoint, noise, load + self.load, transmitter_noise
        return super().step(action)

    def _show(self) -> None:
        if self._shown and self._record:
            self._shown(self._record)


def run(
    plant: Touched, agent: Agent, samples: int, seed: int, before: Callable[[int], object]
) -> Trajectory:
    """Run a controller on one plant, as `rollout` does on a batch."""
    return rollout(SyncVectorEnv([lambda: plant]), agent, samples, seed, before)


def replay(
    factory: Factory,
    scenario: Scenario,
    seed: int,
    moves: Moves | None = None,
    show: Callable[[Record], object] | None = None,
) -> Trajectory:
    """Run a controller with the noise and the moves of another run."""
    arguments = factory.arguments(scenario.arguments)
    plant, moves = Touched(show, **arguments), moves or {}

    def move(k: int) -> None:
        plant.setpoint, plant.load = moves.get(k, (plant.setpoint, plant.load))

    return run(plant, factory(arguments, 1, seed), scenario.samples, seed, move)


def table(
    label: str, trajectory: Trajectory, moves: Moves, scenario: Scenario, seed: int
) -> pd.DataFrame:
    """Return mean error and valve travel of a run and of the controllers, and the bound.

    There is no bound if the load was moved by hand.
    """
    runs = {label: trajectory} | {
        controller.label: replay(controller.first(), scenario, seed, moves)
        for controller in ROSTER.values()
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
            # The viewer knows the moves of the set point in advance.
            kind, longer = "preview", replace(scenario, samples=scenario.samples + 1)
            idle = replay(ROSTER["nothing"].first(), longer, seed, moves)
            arguments["setpoint"] = idle.setpoint[:, 0].tolist()
        bound = least_possible(
            samples=scenario.samples, kind=kind, episodes=EPISODES, **arguments
        )
        rows.insert(0, ("least possible, on average", f"{bound.value:.3f}", ""))
    return pd.DataFrame(rows, columns=["", "mean |e| (°C)", "valve travel (t/h)"])
