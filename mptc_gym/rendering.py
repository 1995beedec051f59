"""Render an episode in the requested mode; draw the text picture.

`mptc_gym.drawing` makes pictures in pixels, and is imported for the first of them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from types import ModuleType
from typing import cast

import numpy as np
from gymnasium import logger
from gymnasium.error import DependencyNotInstalled, ResetNeeded
from numpy.typing import NDArray

from mptc_gym.checks import reject
from mptc_gym.record import Axis, Record

Frame = NDArray[np.uint8]
_COLUMNS = 72  # width of the text picture


def check_mode(mode: str | None, modes: Sequence[str]) -> None:
    """Raise ValueError if a render mode is neither None nor one of `modes`."""
    if mode is not None and not (isinstance(mode, str) and mode in modes):
        reject("render_mode", mode, " or ".join(["None", *map(repr, modes)]))


def warn_no_mode() -> None:
    """Warn that `render` does nothing without a mode."""
    logger.warn(
        "render does nothing without a render mode: give one to gymnasium.make, as in "
        'make("MiddlePoint-v0", render_mode="rgb_array")'
    )


def render(mode: str | None, record: Record | None, fps: float) -> Frame | str | None:
    """Return a picture, or show it in a window at up to `fps` frames per second.

    See `MiddlePointEnv.render`.
    """
    if mode is None:
        warn_no_mode()
        return None
    if record is None:
        raise ResetNeeded("call reset before render")
    if mode == "ansi":
        return text(record)
    if mode == "rgb_array":
        return frame(record)
    _drawing().show(record, fps)
    return None


def frame(record: Record) -> Frame:
    """Return a picture, shape (540, 960, 3), uint8."""
    return cast("Frame", _drawing().frame(record))


def close_window() -> None:
    """Close the window of the mode "human"."""
    _drawing().close_window()


def _drawing() -> ModuleType:
    try:
        import pygame  # noqa: F401 (alone: another failed import must not look like this)
    except ImportError as error:
        raise DependencyNotInstalled(
            'pygame is not installed, run `pip install "mptc_gym[render]"`'
        ) from error
    from mptc_gym import drawing

    return drawing


def text(record: Record) -> str:
    """Return the text picture: set point -, temperature *; command +, applied #."""
    places = np.round(np.arange(_COLUMNS) * record.span / (_COLUMNS - 1)).astype(int)
    places = places[record.first + places <= record.k]
    setpoints, outputs, commands, applied = np.array(record.samples)[places].T
    in_transit = record.first + places > record.k - record.in_transit
    marks = "".join(np.where(in_transit, "^", " ")).rstrip()
    numbers = [f"{name} {value}" for name, value in record.readings.items()]
    left, right = f"{record.minutes.low:.4g} min", f"{record.minutes.high:.4g} min"
    zone = record.plant.dead_zone
    return "\n".join(
        [
            "   ".join(numbers[:4]),
            "   ".join(numbers[4:]),
            "",
            "°C: set point -, temperature *",
            *_panel(record.temperatures, 11, {"-": setpoints, "*": outputs}),
            "t/h: command +, applied #, dead zone :, in transit ^",
            *_panel(record.flows, 9, {"+": commands, "#": applied}, zone),
            f"{'':9}{marks}",
            f"{'':9}{left}{right:>{_COLUMNS - len(left)}}",
        ]
    )


def _panel(
    axis: Axis, rows: int, lines: dict[str, NDArray[np.float64]], dead_zone: float = 0.0
) -> Iterator[str]:
    """Yield rows of characters from the top: lines over the shaded dead zone."""

    def row_of(value: float) -> int:
        return round((1.0 - axis.share(value)) * (rows - 1))

    middles = axis.low + (1.0 - np.arange(rows) / (rows - 1)) * (axis.high - axis.low)
    grid = np.full((rows, _COLUMNS), " ")
    grid[np.abs(middles) < dead_zone] = ":"
    for character, values in lines.items():
        grid[[row_of(value) for value in values], range(len(values))] = character
    labels = {row_of(tick): f"{tick:.6g}" for tick in axis.ticks()}
    for row, characters in enumerate(grid):
        yield f"{labels.get(row, ''):>7} |{''.join(characters)}".rstrip()
