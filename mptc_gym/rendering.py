"""Render an episode in the requested mode; `mptc_gym.drawing` makes the pictures."""

from __future__ import annotations

from types import ModuleType
from typing import cast

import numpy as np
from gymnasium import logger
from gymnasium.error import DependencyNotInstalled, ResetNeeded
from numpy.typing import NDArray

from mptc_gym.record import Record

Frame = NDArray[np.uint8]


def warn_no_mode() -> None:
    """Warn that `render` does nothing without a mode."""
    logger.warn(
        "render does nothing without a render mode: give one to gymnasium.make, as in "
        'make("MiddlePoint-v0", render_mode="rgb_array")'
    )


def render(mode: str | None, record: Record | None, fps: float) -> Frame | None:
    """Return a picture, or show it in a window at up to `fps` frames per second.

    See `MiddlePointEnv.render`.
    """
    if mode is None:
        warn_no_mode()
        return None
    if record is None:
        raise ResetNeeded("call reset before render")
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
