"""Let a viewer take part: keys and mouse, and the controllers under what the viewer changed."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import pandas as pd
import pygame
from gymnasium.vector import SyncVectorEnv

from benchmarks.bounds.least import least_possible
from benchmarks.controllers.engineered import limits
from benchmarks.controllers.records import Factory
from benchmarks.controllers.roster import ROSTER
from benchmarks.loop.metrics import mean_error, travel
from benchmarks.loop.rollout import Agent, IdleValve, Trajectory, rollout
from benchmarks.loop.scenarios import Scenario
from mptc_gym import MiddlePointEnv, Parameters, drawing

HELP = (
    "keys: Up, Down or the mouse in the lower chart move the flow (with --agent you), Home "
    "sets it to 0; Page Up and Page Down move the set point, L and K the load, by 1 °C; "
    "+ and - change the speed; space pauses, Esc ends"
)
# What keys add, by attribute of `Hands`: t/h, degC and degC.
_ADDED = {
    pygame.K_UP: ("flow", 0.5),
    pygame.K_DOWN: ("flow", -0.5),
    pygame.K_PAGEUP: ("setpoint", 1.0),
    pygame.K_PAGEDOWN: ("setpoint", -1.0),
    pygame.K_l: ("load", 1.0),
    pygame.K_k: ("load", -1.0),
}
_SPEEDS = {"+": 2.0, "=": 2.0, "-": 0.5}  # by character, as keyboards differ

Moves = dict[int, tuple[float, float]]  # k: additions to set point and load from k + 1 on


class Closed(Exception):  # noqa: N818 (no error)
    """The window has been closed."""


class Hands(IdleValve):
    """A controller whose flow, and what else a viewer can change, is set by keys and mouse."""

    def __init__(self, u_min: float, u_max: float, speed: float) -> None:
        super().__init__(u_min, u_max)
        self.speed = speed  # samples per second
        self.setpoint = self.load = 0.0  # added to both by hand, degC
        self.paused = False  # whether the plant stands still

    def take(self, events: Iterable[Any]) -> None:
        """Handle events of pygame; raise `Closed` if one ends the run."""
        for event in events:
            if event.type == pygame.QUIT:
                raise Closed
            if event.type == pygame.KEYDOWN:
                self._press(event.key, getattr(event, "unicode", ""))
            clicked = event.type == pygame.MOUSEBUTTONDOWN and event.button == 1
            dragged = event.type == pygame.MOUSEMOTION and event.buttons[0]
            if clicked or dragged:
                flow = drawing.flow_at(event.pos, self.u_min, self.u_max)
                self.flow = self.flow if flow is None else flow
            self.flow = min(max(self.flow, self.u_min), self.u_max)

    def _press(self, key: int, character: str) -> None:
        if key == pygame.K_ESCAPE:
            raise Closed
        if key == pygame.K_SPACE:
            self.paused = not self.paused
        elif key == pygame.K_HOME:
            self.flow = 0.0
        elif key in _ADDED:
            name, more = _ADDED[key]
            setattr(self, name, getattr(self, name) + more)
        elif character in _SPEEDS:
            self.speed = min(max(self.speed * _SPEEDS[character], 1.0), 1920.0)


def play(
    factory: Factory | None, scenario: Scenario, seed: int, speed: int
) -> tuple[Trajectory, Moves]:
    """Run a controller, or let the viewer control if there is none, and show it in a window.

    Return the run and the moves of set point and load. Closing the window before the end
    raises `Closed`.
    """
    arguments = factory.arguments(scenario.arguments) if factory else scenario.arguments
    hands = Hands(**limits(Parameters(**arguments)), speed=speed)
    plant = MiddlePointEnv(render_mode="human", **arguments)
    moves: Moves = {}
    moved = 0.0, 0.0

    def attend(k: int) -> None:
        nonlocal moved
        hands.take(pygame.event.get())
        while hands.paused:
            pygame.time.wait(20)
            hands.take(pygame.event.get())
        if (hands.setpoint, hands.load) != moved:
            moves[k] = moved = hands.setpoint, hands.load
        plant.disturb(setpoint=hands.setpoint, load=hands.load)
        plant.metadata = {**plant.metadata, "render_fps": hands.speed}

    controller = factory(arguments, 1, seed) if factory else hands
    pygame.display.init()
    pygame.key.set_repeat(300, 60)  # ms
    try:
        return run(plant, controller, scenario.samples, seed, attend), moves
    finally:
        drawing.close_window()


def run(
    plant: MiddlePointEnv,
    agent: Agent,
    samples: int,
    seed: int,
    before: Callable[[int], object],
) -> Trajectory:
    """Run a controller on one plant, as `rollout` does on a batch."""
    return rollout(SyncVectorEnv([lambda: plant]), agent, samples, seed, before)


def replay(factory: Factory, scenario: Scenario, seed: int, moves: Moves) -> Trajectory:
    """Run a controller with the noise and the moves of another run."""
    arguments = factory.arguments(scenario.arguments)
    plant, now = MiddlePointEnv(**arguments), (0.0, 0.0)

    def move(k: int) -> None:
        nonlocal now
        setpoint, load = now = moves.get(k, now)
        plant.disturb(setpoint=setpoint, load=load)

    return run(plant, factory(arguments, 1, seed), scenario.samples, seed, move)


def tabulate(
    label: str, trajectory: Trajectory, moves: Moves, scenario: Scenario, seed: int
) -> pd.DataFrame:
    """Return mean error and valve travel of a run and of the controllers, and the bound.

    There is no bound if the load was moved by hand.
    """
    runs = {label: trajectory} | {
        controller.label: replay(controller.members()[0], scenario, seed, moves)
        for controller in ROSTER.values()
        if controller.compared and controller.label != label
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
            idle = replay(ROSTER["nothing"].members()[0], longer, seed, moves)
            arguments["setpoint"] = idle.setpoint[:, 0].tolist()
        # Over few episodes, where plants are drawn: the viewer waits.
        bound = least_possible(samples=scenario.samples, kind=kind, episodes=20, **arguments)
        rows.insert(0, ("least possible, on average", f"{bound.value:.3f}", ""))
    return pd.DataFrame(rows, columns=["", "mean |e| (°C)", "valve travel (t/h)"])
