"""Runs trainings side by side, and keeps what each has made as soon as it is finished."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeVar

from agents import LawNetwork, PolicyNetwork
from benchmarks.lib.fan_out import FanOut
from benchmarks.lib.storage import replacing

Network = TypeVar("Network", LawNetwork, PolicyNetwork)


def trained(
    trainings: Mapping[Path, Callable[[], Network]],
    load: Callable[[Path], Network],
    fan_out: FanOut,
    *,
    retrain: bool = False,
) -> dict[Path, Network]:
    """Return what trainings have made, by the files that keep it.

    Trainings run where their file is missing, or all of them to `retrain`: in other processes,
    on a cluster on other machines. Files are written here.

    Raises
    ------
    TasksFailedError
        At the end, if some failed; the others are kept.
    ValueError
        If a file is damaged; the message names it, and what to do.
    """
    missing = {
        str(file): run for file, run in trainings.items() if retrain or not file.exists()
    }
    for name, made in fan_out.stream(missing, "training" if missing else ""):
        with replacing(Path(name)) as file:
            made.save(file)
    try:
        return {file: load(file) for file in trainings}
    except ValueError as error:
        raise ValueError(f"{error}: remove it, or --retrain") from error
