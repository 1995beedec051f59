"""Independent pieces of work, called tasks, side by side: on this machine or on a Ray cluster.

joblib hands them out here, Ray on a cluster. A task's result is saved as soon as it is known,
so that a run that was stopped goes on with what is missing. Which process runs a task, and
when, does not matter to its result as long as all its randomness comes from its arguments.
"""

from __future__ import annotations

import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import BrokenExecutor
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, Literal
from urllib.parse import quote

from benchmarks.lib import cluster
from benchmarks.lib.storage import seal, unseal, write_text

LOSSES = 3  # a task that saw so many workers vanish runs alone, to see whether it is to blame
GIVE_UP = 10  # when so many tasks were to blame, there is another fault
NAMED = 10  # failed tasks in a message
PATIENCE = 0.5  # s between two looks at whether the parent is still there

Tasks = Mapping[str, Callable[[], Any]]


class TasksFailedError(RuntimeError):
    """Some of `tasks` tasks have no result; those of all others are kept.

    `errors` says what went wrong, by the name of the task: a traceback, or a sentence.
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
    """Runs tasks on the cores of this machine, or on those of a Ray cluster.

    Parameters
    ----------
    jobs
        How many tasks run at once; None means as many as there are cores. With 1 they run in
        this process, if not on a cluster, which runs no more at once than it has cores.
    backend
        "loky", processes on this machine; or "ray", a Ray cluster that is running already.

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
        """Run the tasks that have no result yet; return the results of all, in their order.

        Parameters
        ----------
        tasks
            What to run, by name: functions that return what JSON can hold, such as
            `functools.partial` of a function of a module. Results are as JSON gives them back.
        folder
            Where results are saved, a file a task. What lies there under a task's name is taken
            for its result: tasks with other arguments or code need a folder of their own. A
            file that is not what was written is no result. None: they are not saved.
        title
            Stands before a progress bar; "" for none.

        Raises
        ------
        TasksFailedError
            At the end, if tasks raised an exception or lost their worker again and again.
        """
        results: dict[str, Any] = {}
        files = {key: folder / f"{quote(key, safe=' ,=+')}.json" for key in tasks if folder}
        for key, file in files.items():
            with suppress(FileNotFoundError, ValueError):  # not there, or damaged
                results[key] = unseal(file.read_text(encoding="utf-8"))
        missing = {key: tasks[key] for key in tasks if key not in results}
        for key, result in self.stream(missing, title, len(results)):
            text = seal(result)
            results[key] = unseal(text)
            if folder:
                write_text(files[key], text)
        return {key: results[key] for key in tasks}

    def stream(self, tasks: Tasks, title: str = "", done: int = 0) -> Iterator[tuple[str, Any]]:
        """Run tasks, and yield each name and result as they come.

        As `run`, but tasks may return whatever can be pickled, and those that cannot be pickled
        themselves run in this process, after the others. `done` tasks have been done before.
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
    """Run tasks on this machine, those again whose worker is lost."""
    import joblib  # here: it takes a while to load

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
            # Any of those under way may have been the end of the worker.
            losses.update(key for key in started if key in away)
            for key in suspects:
                del away[key]
                yield key, None, f"{lost}\nIts worker was lost each time.", True
    for key in here:
        yield key, *cluster.attempt(tasks[key]), False


def _in_processes(
    tasks: Tasks, jobs: int, started: list[str]
) -> Iterator[tuple[str, Any, str]]:
    """Run tasks, yield their answers as they come, and note which were handed out."""
    import joblib

    def handed_out() -> Iterator[Any]:
        for key, task in tasks.items():
            started.append(key)
            yield joblib.delayed(_answer)(key, task, os.getpid())

    # With one process joblib would use this one, which no task is to bring down.
    processes = max(2, min(jobs, len(tasks)))
    with joblib.parallel_config("loky", inner_max_num_threads=1):
        # One by one: a lost worker takes along no more than it must.
        parallel = joblib.Parallel(processes, return_as="generator_unordered", batch_size=1)
    yield from parallel(handed_out())


def _travels(task: Callable[[], Any]) -> bool:
    """Whether a task can be sent to another process: a user's controller may not be such."""
    from joblib.externals.loky.backend.reduction import dumps

    try:
        dumps(task)
    except Exception:
        return False
    return True


def _answer(key: str, task: Callable[[], Any], parent: int) -> tuple[str, Any, str]:
    _end_with(parent)
    return key, *cluster.attempt(task)


@cache
def _end_with(parent: int) -> None:
    """See to it that this process ends when its parent does, even if that was killed.

    Otherwise a worker would wait for work for some minutes, as it does on Windows, where it
    cannot tell.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(PATIENCE)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
