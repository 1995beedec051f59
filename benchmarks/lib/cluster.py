"""Tasks on a Ray cluster: the code travels with the job, results come back as objects.

The nodes need Ray and the packages that a task imports. They share no folder, and no checkout
is on them: Ray unpacks the code where its workers run.
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

# What stays here, as in a .gitignore: all of the checkout but the packages and the modules
# beside them, such as those of controllers of one's own.
STAYS = [
    *("/*", "!/.", "!/agents", "!/benchmarks", "!/mptc_gym", "!/*.py"),
    *("__pycache__", "published", "*.md"),
]
QUEUED = 4  # tasks a core that are handed out; also for nodes that come later

# The name of a task, its result, what went wrong, and whether its worker is lost.
Answer = tuple[str, Any, str, bool]


def connect() -> None:
    """Connect to the cluster of RAY_ADDRESS or of this machine; ValueError if there is none."""
    import ray  # here: an extra, which takes a second to load

    if ray.is_initialized():
        return
    # Code that `ray job submit` has brought there is the same.
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
    """Run tasks on the cluster that is connected, and yield their answers as they come.

    `jobs` tasks run at once; None means as many as the cluster has cores. A task whose worker
    or node is lost is begun again, `tries` times in all.
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
    """Run a task; return its result, what went wrong, and whether that was the node's fault."""
    there = _versions()
    if there != here:
        has, wanted = dict(there.items() - here.items()), dict(here.items() - there.items())
        return None, f"A node computes other numbers: it has {has}, and not {wanted}", True
    return *attempt(task), False


_versions = cache(versions)


def attempt(task: Callable[[], Any]) -> tuple[Any, str]:
    """Run a task; return its result, and what went wrong, if anything."""
    try:
        return task(), ""
    except Exception:
        # As text, since not every exception survives the way to another process.
        return None, traceback.format_exc()


def _knock() -> None:
    """Raise OSError if nobody listens where Ray would: it would wait for many minutes."""
    folder = os.environ.get("RAY_TMPDIR", tempfile.gettempdir())
    latest = Path(folder, "ray", "ray_current_cluster")  # of `ray start`; it may be gone
    found = latest.read_text().strip() if latest.exists() else ""
    address = os.environ.get("RAY_ADDRESS") or found
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if host and port.isdecimal():
        socket.create_connection((host, int(port)), timeout=10).close()
