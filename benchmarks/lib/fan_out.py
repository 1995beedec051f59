"""Run independent tasks in parallel, on this machine or on a Ray cluster.

joblib schedules them on this machine, Ray on a cluster. Each result is saved as soon as it
arrives, so an interrupted run resumes with the missing tasks. A result does not depend on which
process runs the task, or when, as long as all its randomness comes from its arguments.
"""

from __future__ import annotations

import json
import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import BrokenExecutor
from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from typing import Any, Literal
from urllib.parse import quote

from benchmarks.lib import cluster
from benchmarks.lib.storage import seal, unseal, write_text

LOSSES = 3  # lost workers before a task is run alone, to see whether it is to blame
GIVE_UP = 10  # tasks to blame before all stop, as the cause must lie elsewhere
NAMED = 10  # failed tasks listed in a message
PATIENCE = 0.5  # s between checks that the parent is still running

Tasks = Mapping[str, Callable[[], Any]]


class TasksFailedError(RuntimeError):
    """Some of `tasks` tasks failed; the results of the others are kept.

    `errors` maps the name of each failed task to a traceback or a sentence.
    """

    def __init__(self, errors: Mapping[str, str], tasks: int) -> None:
        self.errors = dict(errors)
        lines = [f"{key}: {text.strip().splitlines()[-1]}" for key, text in errors.items()]
        super().__init__(
            f"{len(errors)} of {tasks} tasks failed; the results of the others are kept\n"
            + "\n".join(lines[:NAMED])
            + f"\nThe first of them:\n{next(iter(errors.values()))}"
        )


class FanOut:
    """Run tasks on the cores of this machine or of a Ray cluster.

    Parameters
    ----------
    jobs
        Number of tasks run at once; None means one per core. On this machine, 1 runs them in
        this process. A cluster never runs more at once than it has cores.
    backend
        "loky" for processes on this machine, "ray" for a Ray cluster that is already running.

    Raises
    ------
    ValueError
        If no cluster is found.
    """

    def __init__(
        self, jobs: int | None = None, backend: Literal["loky", "ray"] = "loky"
    ) -> None:
        self._jobs, self._backend = jobs, backend
        if backend == "ray":
            cluster.connect()

    def run(self, tasks: Tasks, folder: Path | None = None, title: str = "") -> dict[str, Any]:
        """Run the tasks that have no saved result; return all results, in the order of `tasks`.

        Parameters
        ----------
        tasks
            Functions without arguments, by name, such as a `functools.partial` of a function of
            a module. They return JSON values; the results are as read back from JSON.
        folder
            Folder for the results, one file per task; None saves nothing. A file named after a
            task counts as its result, so tasks with other arguments or code need a folder of
            their own. A damaged file is ignored.
        title
            Label of the progress bar; "" for no bar.

        Raises
        ------
        TasksFailedError
            At the end, if tasks raised an exception or lost their worker repeatedly.
        """
        results: dict[str, Any] = {}
        files = {key: folder / f"{quote(key, safe=' ,=+')}.json" for key in tasks if folder}
        for key, file in files.items():
            with suppress(FileNotFoundError, ValueError):  # not there, or damaged
                results[key] = unseal(file.read_text(encoding="utf-8"))
        missing = {key: partial(_as_json, tasks[key]) for key in tasks if key not in results}
        for key, text in self.stream(missing, title, len(results)):
            results[key] = json.loads(text)
            if folder:
                write_text(files[key], seal(results[key]))
        return {key: results[key] for key in tasks}

    def stream(self, tasks: Tasks, title: str = "", done: int = 0) -> Iterator[tuple[str, Any]]:
        """Run tasks, and yield the name and result of each as it finishes.

        Like `run`, but a task may return anything that can be pickled. On this machine, tasks
        that cannot be pickled run in this process, last. `done` tasks have finished before.
        """
        from tqdm import tqdm

        bar = tqdm(total=done + len(tasks), initial=done, desc=title, disable=not title)
        errors = dict.fromkeys(tasks, "Not run: too many lost their worker.")
        blamed = 0
        if self._backend == "ray":
            answers = cluster.answers(tasks, self._jobs, LOSSES)
        else:
            answers = _local(tasks, self._jobs)
        with bar:
            for key, result, error, lost in answers:
                if not error:
                    del errors[key]
                    bar.update()
                    yield key, result
                    continue
                errors[key] = error
                blamed += lost
                if blamed == GIVE_UP:
                    break
        if errors:
            raise TasksFailedError(errors, done + len(tasks))


def _local(tasks: Tasks, jobs: int | None) -> Iterator[cluster.Answer]:
    """Run tasks on this machine, and rerun those that lose their worker."""
    import joblib  # here: slow to import

    jobs = jobs or joblib.cpu_count()
    away = {key: task for key, task in tasks.items() if jobs > 1 and _travels(task)}
    here = [key for key in tasks if key not in away]
    losses: Counter[str] = Counter()
    while away:
        suspects = [key for key in away if losses[key] >= LOSSES][:1]
        started: list[str] = []
        try:
            tried = {key: away[key] for key in suspects or away}
            for key, result, error in _in_processes(tried, jobs, started):
                del away[key]
                yield key, result, error, False
        except BrokenExecutor as lost:
            # Any of the tasks under way may have killed the worker.
            under_way = [key for key in started if key in away]
            if not under_way:
                raise
            losses.update(under_way)
            for key in suspects:
                del away[key]
                yield key, None, f"{lost}\nIts worker was lost each time.", True
    for key in here:
        yield key, *cluster.attempt(tasks[key]), False


def _in_processes(
    tasks: Tasks, jobs: int, started: list[str]
) -> Iterator[tuple[str, Any, str]]:
    """Run tasks in other processes, yield their answers, and list in `started` which began."""
    import joblib

    def handed_out() -> Iterator[Any]:
        for key, task in tasks.items():
            started.append(key)
            yield joblib.delayed(_answer)(key, task, os.getpid())

    # With one process joblib would use this one, which no task may bring down.
    processes = max(2, min(jobs, len(tasks)))
    with joblib.parallel_config("loky", inner_max_num_threads=1):
        # Batches of one, so that a lost worker takes as few tasks with it as possible.
        parallel = joblib.Parallel(processes, return_as="generator_unordered", batch_size=1)
    yield from parallel(handed_out())


def _travels(task: Callable[[], Any]) -> bool:
    """Return whether a task can be pickled: one with a user's own controller may not be."""
    from joblib.externals.loky.backend.reduction import dumps

    try:
        dumps(task)
    except Exception:
        return False
    return True


def _as_json(task: Callable[[], Any]) -> str:
    """Run a task; a result that JSON cannot hold is then an error of that task alone."""
    return json.dumps(task())


def _answer(key: str, task: Callable[[], Any], parent: int) -> tuple[str, Any, str]:
    _end_with(parent)
    return key, *cluster.attempt(task)


@cache
def _end_with(parent: int) -> None:
    """End this process when its parent ends, even if the parent was killed.

    An orphaned worker would otherwise wait for work for some minutes. On Windows it still does,
    since it cannot tell.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(PATIENCE)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
