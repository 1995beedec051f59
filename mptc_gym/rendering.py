"""Render episodes in the requested mode; `mptc_gym.drawing` makes the pictures."""

from __future__ import annotations

from collections.abc import Sequence
from types import ModuleType

import numpy as np
from gymnasium import logger
from gymnasium.error import DependencyNotInstalled, ResetNeeded
from numpy.typing import NDArray

from mptc_gym.record import Record

Frame = NDArray[np.uint8]


def render(
    mode: str | None, records: Sequence[Record], fps: float = 0.0
) -> tuple[Frame, ...] | None:
    """Return pictures, or show the first in a window, see `MiddlePointEnv.render`."""
    if mode is None:
        logger.warn(
            "render does nothing without a render mode: give one to gymnasium.make, as in "
            'make("MiddlePoint-v0", render_mode="rgb_array")'
        )
        return None
    if not records:
        raise ResetNeeded("call reset before render")
    drawing = _drawing()
    if mode == "human":
        drawing.show(records[0], fps)
        return None
    return tuple(map(drawing.frame, records))


def close_window() -> None:
    """Close the window of the mode "human"."""
    _drawing().pygame.display.quit()


def _drawing() -> ModuleType:
    try:
        import pygame  # noqa: F401 (alone: another failed import must not look like this)
    except ImportError as error:
        raise DependencyNotInstalled(
            'pygame is not installed, run `pip install "mptc_gym[render]"`'
        ) from error
    from mptc_gym import drawing

    return drawing
