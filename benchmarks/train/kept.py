"""Run trainings in parallel, and save each network as soon as it is finished."""

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
    """Return trained networks by file, and train those whose file is missing.

    `retrain` trains all of them. Trainings run in other processes or, on a cluster, on other
    machines; this process writes the files.

    Raises
    ------
    TasksFailedError
        At the end, if some trainings failed; the other networks are saved.
    ValueError
        If a file is damaged; the message names it and says what to do.
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
