"""Runs trainings side by side, and keeps what each has made as soon as it is finished."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Protocol

from tqdm import tqdm

from benchmarks.lib.fan_out import FanOut
from benchmarks.lib.storage import replacing


class Savable(Protocol):
    """What a training makes."""

    def save(self, path: Path) -> None:
        """Write it to a file."""


def train(
    trainings: Mapping[Path, Callable[[], Savable]], fan_out: FanOut, *, retrain: bool = False
) -> None:
    """Run the trainings whose files are missing.

    Parameters
    ----------
    trainings
        By the file that keeps the result. They run in other processes, on a cluster on other
        machines; files are written here.
    fan_out
        Runs them side by side.
    retrain
        Whether to train even where the file is there.

    Raises
    ------
    TasksFailedError
        At the end, if some failed; the others are kept.
    """
    missing = {
        str(path): training
        for path, training in trainings.items()
        if retrain or not path.exists()
    }
    made_ones = fan_out.stream(missing)
    for path, made in tqdm(made_ones, "training", len(missing), disable=not missing):
        with replacing(Path(path)) as file:
            made.save(file)
