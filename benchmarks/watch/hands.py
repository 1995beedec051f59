"""Let a player control the plant in a window, with keys and mouse."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pygame

from benchmarks.controllers.engineered import Nothing
from mptc_gym import drawing
from mptc_gym.record import Record

HELP = (
    "keys: Up, Down or the mouse in the lower chart move the flow (with --agent you), Home "
    "sets it to 0; Page Up and Page Down move the set point, L and K the load, by 1 °C; "
    "+ and - change the speed; space pauses, Esc ends"
)
FLOW_STEP = 0.5  # t/h
STEP = 1.0  # of set point and load, degC
FASTEST = 1920  # samples per second

_FLOWS = {pygame.K_UP: FLOW_STEP, pygame.K_DOWN: -FLOW_STEP}
_SETPOINTS = {pygame.K_PAGEUP: STEP, pygame.K_PAGEDOWN: -STEP}
_LOADS = {pygame.K_l: STEP, pygame.K_k: -STEP}
_SPEEDS = {"+": 2.0, "=": 2.0, "-": 0.5}  # by character, as keyboards differ


class Closed(Exception):  # noqa: N818 (no error)
    """The window has been closed."""


class Hands(Nothing):
    """A controller whose flow is set with keys and mouse, and the window it is shown in."""

    def __init__(self, u_min: float, u_max: float, speed: float) -> None:
        super().__init__(u_min, u_max)
        self.speed = speed  # samples per second
        self.setpoint = self.load = 0.0  # added to both by hand, degC
        self.paused = False  # whether the plant stands still

    def show(self, record: Record) -> None:
        """Show a record in the window."""
        self._record = record
        drawing.show(record, self.speed)

    def take(self, events: Iterable[Any]) -> None:
        """Handle events of pygame; raise `Closed` if one ends the run."""
        for event in events:
            if event.type == pygame.QUIT:
                raise Closed
            if event.type == pygame.KEYDOWN:
                self._press(event.key, getattr(event, "unicode", ""))
            held = event.type == pygame.MOUSEBUTTONDOWN and event.button == 1
            dragged = event.type == pygame.MOUSEMOTION and event.buttons[0]
            if held or dragged:
                flow = drawing.flow_at(self._record, event.pos)
                if flow is not None:
                    self._move(flow)

    def _press(self, key: int, character: str) -> None:
        if key == pygame.K_ESCAPE:
            raise Closed
        if key == pygame.K_SPACE:
            self.paused = not self.paused
        elif key == pygame.K_HOME:
            self._move(0.0)
        elif character in _SPEEDS:
            self.speed = min(max(self.speed * _SPEEDS[character], 1.0), float(FASTEST))
        self._move(self.flow + _FLOWS.get(key, 0.0))
        self.setpoint += _SETPOINTS.get(key, 0.0)
        self.load += _LOADS.get(key, 0.0)

    def _move(self, flow: float) -> None:
        self.flow = min(max(flow, self.u_min), self.u_max)
