"""Runs trainings side by side, and keeps what each has made as soon as it is finished."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from benchmarks.lib.fan_out import FanOut
from benchmarks.lib.storage import replacing


def train(
    trainings: Mapping[Path, Callable[[], Any]], fan_out: FanOut, *, retrain: bool = False
) -> None:
    """Run the trainings whose files are missing, or all of them to `retrain`.

    Parameters
    ----------
    trainings
        By the file that keeps the result, an object with `save(file)`. They run in other
        processes, on a cluster on other machines; files are written here.
    fan_out
        Runs them side by side.

    Raises
    ------
    TasksFailedError
        At the end, if some failed; the others are kept.
    """
    missing = {
        str(file): run for file, run in trainings.items() if retrain or not file.exists()
    }
    for name, made in fan_out.stream(missing, "training" if missing else ""):
        with replacing(Path(name)) as file:
            made.save(file)
