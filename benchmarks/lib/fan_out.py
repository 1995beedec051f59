"""Independent pieces of work, called cells, side by side: on this machine or on a Ray cluster.

joblib hands them out. A cell's result is saved as soon as it is known, so that a run that was
stopped goes on with what is missing. Which process runs a cell, and when, does not matter to
its result as long as all its randomness comes from its arguments.
"""

from __future__ import annotations

import json
import logging
import os
import socket
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import BrokenExecutor
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import quote

import joblib
from tqdm import tqdm

from benchmarks.lib.storage import seal, unseal, write_text

BACKENDS = ("loky", "ray")
LOSSES = 3  # a cell that saw so many workers vanish runs alone, to see whether it is to blame
GIVE_UP = 10  # when so many cells were to blame, there is another fault
NAMED = 10  # failed cells in a message
PATIENCE = 0.5  # s between two looks at whether the parent is still there

INSTALL_RAY = 'Ray is not installed: pip install -e ".[bench,ray]"'
START_RAY = (
    "No Ray cluster can be reached: start one with `ray start --head`, or set RAY_ADDRESS"
)


class CellsFailedError(RuntimeError):
    """Some cells have no result; those of all others are kept.

    Parameters
    ----------
    errors
        What went wrong, by the name of the cell: a traceback, or a sentence.
    cells
        How many there were in all.
    """

    def __init__(self, errors: Mapping[str, str], cells: int) -> None:
        self.errors = dict(errors)
        lines = [f"{key}: {text.strip().splitlines()[-1]}" for key, text in errors.items()]
        if len(lines) > NAMED:
            lines[NAMED:] = [f"and {len(lines) - NAMED} more"]
        first = next(iter(errors.values()))
        super().__init__(
            f"{len(errors)} of {cells} cells failed; the results of the others are kept\n"
            + "\n".join(lines)
            + f"\nThe first of them:\n{first}"
        )


class FanOut:
    """Runs cells on the cores of this machine, or on those of a Ray cluster.

    Parameters
    ----------
    jobs
        How many cells run at once; None means as many as there are cores. With 1 they run in
        this process. A cluster runs no more at once than it has cores.
    backend
        "loky", processes on this machine; or "ray", a Ray cluster that is running already.

    Raises
    ------
    ValueError
        If the backend is unknown, Ray is not installed, or no cluster is found.
    """

    def __init__(self, jobs: int | None = None, backend: str = "loky") -> None:
        if backend not in BACKENDS:
            raise ValueError(f"backend must be one of {', '.join(BACKENDS)}, got {backend!r}")
        self.backend = backend
        self._lost: tuple[type[BaseException], ...] = (BrokenExecutor,)
        self._options: dict[str, Any] = {}
        if backend == "ray":
            cores, error = _connect()
            self._lost += (error,)
            # The cluster makes up for a lost worker by itself, and no other notices.
            of_workers = {"num_cpus": 1, "max_restarts": -1, "max_task_retries": LOSSES - 1}
            # Ray deals cells to its workers in turn, also to those that are busy; the more
            # each has before it, the less often one has nothing to do.
            self._options = {"ray_remote_args": of_workers, "pre_dispatch": "8 * n_jobs"}
            self.jobs = min(jobs or cores, cores)
        else:
            self.jobs = jobs or joblib.cpu_count()

    def run(
        self,
        cells: Mapping[str, Callable[[], Any]],
        folder: Path | None = None,
        *,
        title: str = "cells",
        progress: bool = True,
    ) -> dict[str, Any]:
        """Run the cells that have no result yet, and return the results of all.

        Parameters
        ----------
        cells
            What to run, by name: functions that can be pickled, such as `functools.partial`
            of a function of a module, and return what JSON can hold.
        folder
            Where results are saved, a file a cell. What lies there under a cell's name is taken
            for its result: cells with other arguments or code need a folder of their own. A
            file that is not what was written is no result. None: they are not saved.
        title
            Stands before the progress bar.
        progress
            Whether to show one.

        Returns
        -------
        dict
            The results in the order of the cells, as JSON gives them back.

        Raises
        ------
        CellsFailedError
            At the end, if cells raised an exception or lost their worker again and again.
        """
        results = {} if folder is None else _saved(cells, folder)
        missing = {key: cell for key, cell in cells.items() if key not in results}
        errors: dict[str, str] = {}
        losses: Counter[str] = Counter()
        blamed = 0
        bar = tqdm(total=len(cells), initial=len(results), desc=title, disable=not progress)
        with bar:
            while missing:
                suspect = next((key for key in missing if losses[key] >= LOSSES), None)
                started: list[str] = []
                try:
                    tried = missing if suspect is None else {suspect: missing[suspect]}
                    for key, text, error in self._answers(tried, started):
                        if error:
                            errors[key] = error
                        else:
                            results[key] = json.loads(text)
                            if folder is not None:
                                write_text(_file(folder, key), seal(results[key]))
                        del missing[key]
                        bar.update()
                except self._lost as lost:
                    if suspect is None:
                        # Any of these may have been the end of the worker.
                        in_flight = [key for key in started if key in missing]
                        if not in_flight:
                            raise
                        losses.update(in_flight)
                        continue
                    errors[suspect] = f"{lost}\nIts worker was lost each time."
                    del missing[suspect]
                    blamed += 1
                    if blamed == GIVE_UP:
                        errors |= dict.fromkeys(missing, "Not run: too many lost their worker.")
                        missing = {}
        if errors:
            named = {key: errors[key] for key in cells if key in errors}
            raise CellsFailedError(named, len(cells))
        return {key: results[key] for key in cells}

    def _answers(
        self, cells: Mapping[str, Callable[[], Any]], started: list[str]
    ) -> Iterator[tuple[str, str, str]]:
        """Run cells, yield their answers as they come, and note which were handed out."""
        # The workers of a cluster are its own, and end with their driver.
        parent = os.getpid() if self.backend == "loky" else None

        def tasks() -> Iterator[Any]:
            for key, cell in list(cells.items()):
                started.append(key)
                yield joblib.delayed(_answer)(key, cell, parent)

        # With one process joblib would use this one, which no cell is to bring down.
        processes = 1 if self.jobs == 1 else max(2, min(self.jobs, len(cells)))
        parallel = joblib.Parallel(
            processes,
            backend=self.backend,
            return_as="generator_unordered",
            batch_size=1,  # a lost worker takes along no more than it must
            **self._options,
        )
        yield from parallel(tasks())


def _answer(key: str, cell: Callable[[], Any], parent: int | None) -> tuple[str, str, str]:
    """Run a cell; return its name, its result as JSON, and what went wrong, if anything."""
    if parent is not None and parent != os.getpid():
        _end_with(parent)
    try:
        return key, json.dumps(cell()), ""
    except Exception:
        # As text, since not every exception survives the way to another process.
        return key, "", traceback.format_exc()


@cache
def _end_with(parent: int) -> None:
    """See to it that this process ends when its parent does, even if that was killed.

    Otherwise a worker would finish what it is at, and wait for more for some minutes. Windows
    does not tell that a parent is gone, and workers do so there.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(PATIENCE)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _file(folder: Path, key: str) -> Path:
    return folder / f"{quote(key, safe=' ,=+')}.json"


def _saved(keys: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    results = {}
    for key in keys:
        with suppress(FileNotFoundError, ValueError):  # not there, or damaged
            results[key] = unseal(_file(folder, key).read_text(encoding="utf-8"))
    return results


def _connect() -> tuple[int, type[BaseException]]:
    """Connect to the Ray cluster; return the number of its cores, and what a loss raises."""
    # Ray tells of every worker that it stops at the end, as if that were an error. It reads
    # this when it is imported.
    os.environ.setdefault("RAY_DEDUP_LOGS_SKIP_REGEX", "__ray_terminate__")
    try:
        import ray  # here: an extra, which takes a second to load
        from ray.util.joblib import register_ray
        from ray.util.joblib.ray_backend import RayBackend
    except ImportError as error:
        raise ValueError(INSTALL_RAY) from error
    if not ray.is_initialized():
        try:
            _knock(os.environ.get("RAY_ADDRESS", ""))
            ray.init(address="auto", log_to_driver=False, logging_level=logging.ERROR)
        except OSError as error:
            raise ValueError(f"{START_RAY} ({error})") from error
    register_ray()
    # joblib denies generators to the pools of multiprocessing, whose class this is, because
    # those hang when a worker dies. Ray's do not: they report it.
    RayBackend.supports_return_generator = True
    return int(ray.cluster_resources().get("CPU", 1)), ray.exceptions.RayError


def _knock(address: str) -> None:
    """Raise OSError if nobody listens there: Ray itself would wait for many minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if host and port.isdecimal():
        socket.create_connection((host, int(port)), timeout=10).close()
