"""Tasks for the tests of the fan-out; other processes import them from here."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import numpy as np

Rows = list[dict[str, float]]


def draw(seed: int, calls: Path | None = None, seconds: float = 0.0) -> Rows:
    """Return random numbers of a seed, and leave a file for each call."""
    if calls is not None:
        (calls / f"{seed} {time.time_ns()} {os.getpid()}").touch()
    time.sleep(seconds)
    rng = np.random.default_rng(seed)
    product = rng.normal(size=(9, 9)) @ rng.normal(size=9)
    return [{"seed": seed, "sum": float(product.sum())}]


def die_of_memory(seed: int) -> None:
    """Kill the own process as the system does if memory runs out."""
    os.kill(os.getpid(), getattr(signal, "SIGKILL", signal.SIGTERM))  # as Windows has it


def hears_ctrl_c() -> bool:
    """Return whether Ctrl-C interrupts the own process."""
    try:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.1)
    except KeyboardInterrupt:
        return True
    return False


def fail(seed: int) -> Rows:
    """Raise an exception that cannot be pickled."""

    class LocalError(Exception):
        pass

    raise LocalError(f"no such plant as {seed}")
