"""Run tasks on a Ray cluster: the code travels with the job, results come back as objects.

The nodes need Ray and the packages that a task imports. They need no shared folder and no
checkout: Ray unpacks the code where its workers run.
"""

from __future__ import annotations

import logging
import os
import socket
import tempfile
import traceback
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Any

from benchmarks.lib.storage import ROOT, versions

# Files that are not uploaded, in .gitignore syntax: the whole checkout except its packages and
# the modules beside them, such as a user's own controllers.
STAYS = [
    *("/*", "!/.", "!/agents", "!/benchmarks", "!/mptc_gym", "!/*.py"),
    *("__pycache__", "published", "*.md"),
]
QUEUED = 4  # tasks submitted per core, enough to occupy nodes that join later

# The name of a task, its result, its error message, and whether its worker was lost.
Answer = tuple[str, Any, str, bool]


def connect() -> None:
    """Connect to the cluster at RAY_ADDRESS or on this machine; ValueError if there is none."""
    import ray  # here: an optional package that takes a second to import

    if ray.is_initialized():
        return
    # `ray job submit` has uploaded the same code.
    os.environ.setdefault("RAY_OVERRIDE_JOB_RUNTIME_ENV", "1")
    try:
        _knock()
        ray.init(
            address="auto",
            runtime_env={"working_dir": str(ROOT), "excludes": STAYS},
            log_to_driver=False,
            logging_level=logging.ERROR,
        )
    except OSError as error:
        raise ValueError(
            "No Ray cluster can be reached: start one with `ray start --head`, or set "
            f"RAY_ADDRESS ({error})"
        ) from error


def answers(
    tasks: Mapping[str, Callable[[], Any]], jobs: int | None, tries: int
) -> Iterator[Answer]:
    """Run tasks on the connected cluster, and yield their answers as they arrive.

    `jobs` tasks run at once; None means one per core of the cluster. A task whose worker or
    node is lost is restarted, up to `tries` attempts in all.
    """
    import ray

    remote = ray.remote(num_cpus=1, max_retries=tries - 1)(_answer)
    at_once = jobs or QUEUED * int(ray.cluster_resources().get("CPU", 1))
    here, waiting = versions(), iter(tasks.items())
    running: dict[Any, str] = {}
    try:
        while True:
            for key, task in islice(waiting, at_once - len(running)):
                running[remote.remote(task, here)] = key
            if not running:
                return
            for done in ray.wait(list(running))[0]:
                key = running.pop(done)
                try:
                    answer = ray.get(done)
                except ray.exceptions.RayError as lost:
                    reason = f"No result came back: {type(lost).__name__}"
                    answer = None, f"{lost}\n{reason}", True
                yield key, *answer
    finally:
        for left in running:
            ray.cancel(left, force=True)


def _answer(task: Callable[[], Any], here: dict[str, str]) -> tuple[Any, str, bool]:
    """Run a task; return its result, its error message, and whether the node is to blame."""
    there = _versions()
    if there != here:
        has, wanted = dict(there.items() - here.items()), dict(here.items() - there.items())
        return None, f"A node computes other numbers: it has {has}, and not {wanted}", True
    return *attempt(task), False


_versions = cache(versions)


def attempt(task: Callable[[], Any]) -> tuple[Any, str]:
    """Run a task; return its result and its traceback, "" if it succeeded."""
    try:
        return task(), ""
    except Exception:
        # As text, since not every exception can be pickled.
        return None, traceback.format_exc()


def _knock() -> None:
    """Raise OSError if nothing listens at Ray's address: Ray itself would wait for minutes."""
    folder = os.environ.get("RAY_TMPDIR", tempfile.gettempdir())
    latest = Path(folder, "ray", "ray_current_cluster")  # of `ray start`; may be stale
    found = latest.read_text().strip() if latest.exists() else ""
    address = os.environ.get("RAY_ADDRESS") or found
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if host and port.isdecimal():
        socket.create_connection((host, int(port)), timeout=10).close()
