"""Render an episode in the mode that was asked for; draw the picture in text.

Pictures in pixels are made by `mptc_gym.drawing`, which is loaded with the first of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import ModuleType
from typing import cast

import numpy as np
from gymnasium import logger
from gymnasium.error import DependencyNotInstalled, ResetNeeded
from numpy.typing import NDArray

from mptc_gym.checks import reject
from mptc_gym.record import Axis, Record

Frame = NDArray[np.uint8]
_TEXT_COLUMNS = 72


def check_mode(mode: str | None, modes: Sequence[str]) -> None:
    """Refuse a render mode that is not None or one of `modes`, with a ValueError."""
    if mode is not None and not (isinstance(mode, str) and mode in modes):
        reject("render_mode", mode, " or ".join(["None", *map(repr, modes)]))


def warn_no_mode() -> None:
    """Warn that there is nothing to draw."""
    logger.warn(
        "render does nothing without a render mode: give one to gymnasium.make, as in "
        'make("MiddlePoint-v0", render_mode="rgb_array")'
    )


def render(mode: str | None, record: Record | None, fps: float) -> Frame | str | None:
    """Make a picture in a mode: return it, or show it in a window, at most `fps` a second.

    See `MiddlePointEnv.render`.
    """
    if mode is None:
        warn_no_mode()
        return None
    if record is None:
        raise ResetNeeded("call reset before render")
    if mode == "ansi":
        return text(record)
    if mode == "human":
        _drawing().show(record, fps)
        return None
    return frame(record)


def frame(record: Record) -> Frame:
    """Return a picture, shape (540, 960, 3), uint8."""
    return cast("Frame", _drawing().frame(record))


def close_window() -> None:
    """Close the window of the mode "human"."""
    _drawing().close_window()


def _drawing() -> ModuleType:
    try:
        import pygame  # noqa: F401 (alone, so that no other fault is taken for its absence)
    except ImportError as error:
        raise DependencyNotInstalled(
            'pygame is not installed, run `pip install "mptc_gym[render]"`'
        ) from error
    from mptc_gym import drawing

    return drawing


def text(record: Record) -> str:
    """Return a picture in text: set point -, temperature *; command +, applied #."""
    places = [round(c * record.span / (_TEXT_COLUMNS - 1)) for c in range(_TEXT_COLUMNS)]
    places = [place for place in places if record.first + place <= record.k]
    in_transit = [record.first + place > record.k - record.in_transit for place in places]

    temperatures = _Grid(record.temperatures, rows=11)
    flows = _Grid(record.flows, rows=9)
    flows.fill(-record.plant.dead_zone, record.plant.dead_zone, ":")
    samples = list(record.samples)
    for column, place in enumerate(places):
        setpoint, output, command, applied = samples[place]
        temperatures.put(column, setpoint, "-")
        temperatures.put(column, output, "*")
        flows.put(column, command, "+")
        flows.put(column, applied, "#")

    numbers = [f"{name} {value}" for name, value in record.readings.items()]
    marks = "".join("^" if still else " " for still in in_transit).rstrip()
    minutes = record.minutes
    left, right = f"{minutes.low:.4g} min", f"{minutes.high:.4g} min"
    return "\n".join(
        [
            "   ".join(numbers[:4]),
            "   ".join(numbers[4:]),
            "",
            "°C: set point -, temperature *",
            *temperatures.lines(),
            "t/h: command +, applied #, dead zone :, in transit ^",
            *flows.lines(),
            f"{'':9}{marks}",
            f"{'':9}{left}{right:>{_TEXT_COLUMNS - len(left)}}",
        ]
    )


class _Grid:
    """Characters in rows, the top one first."""

    def __init__(self, axis: Axis, rows: int) -> None:
        self._axis = axis
        self._rows = [[" "] * _TEXT_COLUMNS for _ in range(rows)]

    def put(self, column: int, value: float, character: str) -> None:
        self._rows[self._row(value)][column] = character

    def fill(self, low: float, high: float, character: str) -> None:
        """Fill the rows whose middle lies between two values."""
        for row, characters in enumerate(self._rows):
            share = 1.0 - row / (len(self._rows) - 1)
            if low < self._axis.low + share * (self._axis.high - self._axis.low) < high:
                characters[:] = character * _TEXT_COLUMNS

    def lines(self) -> list[str]:
        labels = {self._row(tick): f"{tick:.6g}" for tick in self._axis.ticks()}
        return [
            f"{labels.get(row, ''):>7} |{''.join(characters)}".rstrip()
            for row, characters in enumerate(self._rows)
        ]

    def _row(self, value: float) -> int:
        return round((1.0 - self._axis.share(value)) * (len(self._rows) - 1))
