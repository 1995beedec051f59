"""Run independent tasks in parallel, in processes of this machine or on a Ray cluster.

A result does not depend on which process runs the task, or when, as long as all its randomness
comes from its arguments. A finished task is kept, so that an interrupted run goes on with the
missing ones.

The nodes of a cluster need Ray and the packages that a task imports. They need no shared folder
and no checkout: Ray unpacks the code where its workers run.
"""

from __future__ import annotations

import logging
import os
import signal
import socket
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pickle import PicklingError
from typing import Any, Literal

from benchmarks.lib.command import Count, blame, options
from benchmarks.lib.storage import ROOT, Kept, UnfinishedError, versions

LOST = "The process that ran it ended, perhaps for lack of memory: the same command tries again"
# Files that are not uploaded, in .gitignore syntax: the whole checkout except its packages and
# the modules beside them, such as a user's own controllers.
STAYS = [
    *("/*", "!/.", "!/agents", "!/benchmarks", "!/mptc_gym", "!/*.py"),
    *("__pycache__", "published", "*.md"),
]

Task = Callable[[], Any]
Tasks = Mapping[str, Task]
Answer = tuple[str, Any, str]  # the name of a task, its result, and its error or ""
Submit = Callable[[str, Task], Future[Answer]]


class TasksFailedError(UnfinishedError):
    """Some of `tasks` tasks failed; the results of the others are kept.

    `errors` maps the name of each failed task to a traceback or a sentence.
    """

    def __init__(self, errors: Mapping[str, str], tasks: int) -> None:
        self.errors = dict(errors)
        lines = [f"{name}: {text.strip().splitlines()[-1]}" for name, text in errors.items()]
        super().__init__(
            f"{len(errors)} of {tasks} tasks failed; the results of the others are kept\n"
            + "\n".join(lines[:10])
            + f"\nThe first of them:\n{next(iter(errors.values()))}"
        )


@options
@dataclass(frozen=True, kw_only=True)
class FanOut:
    """Where tasks run, and how many at once. With one job they run in this process."""

    jobs: Count | None = None
    """Number of tasks run at once (default: one per core)."""
    backend: Literal["loky", "ray"] = "loky"
    """Where tasks run: loky for this machine, ray for a Ray cluster."""

    def run(self, tasks: Tasks, title: str = "", kept: Kept | None = None) -> dict[str, Any]:
        """Run tasks, and return their results in the order of `tasks`; see `stream`."""
        results = dict(self.stream(tasks, title, kept))
        return {name: results[name] for name in tasks}

    def stream(
        self, tasks: Tasks, title: str = "", kept: Kept | None = None
    ) -> Iterator[tuple[str, Any]]:
        """Run tasks, and yield the name and result of each as it finishes.

        Parameters
        ----------
        tasks
            Functions without arguments, by name, such as a `functools.partial` of a function of
            a module. Those that cannot be pickled run in this process.
        title
            Label of the progress bar; "" for no bar.
        kept
            Where results are kept; those that are there already are yielded first. None:
            nothing is kept.

        Raises
        ------
        TasksFailedError
            At the end, if tasks raised an exception or lost their process.
        UsageError
            If there is no cluster.
        """
        from tqdm import tqdm

        missing, errors = dict(tasks), {}
        with tqdm(total=len(tasks), desc=title, disable=not title) as bar:
            if kept:
                for name, task in tasks.items():
                    with suppress(LookupError):
                        result = kept.load(task)
                        del missing[name]
                        bar.update()
                        yield name, result
            run = _on_cluster if self.backend == "ray" else _on_this_machine
            for name, result, error in run(missing, self.jobs):
                bar.update()
                if kept and not error:
                    try:
                        result = kept.save(tasks[name], result)
                    except (TypeError, ValueError) as fault:
                        error = f"Its result cannot be kept: {fault}"
                if error:
                    errors[name] = error
                else:
                    yield name, result
        if errors:
            raise TasksFailedError(errors, len(tasks))


def _attempt(name: str, task: Task, needed: Mapping[str, str] | None = None) -> Answer:
    """Run a task, on a node of a cluster only if it has the needed versions of packages."""
    if needed and versions() != needed:
        here, there = versions().items(), needed.items()
        text = f"it has {dict(here - there)}, and not {dict(there - here)}"
        return name, None, f"A node computes other numbers: {text}"
    try:
        return name, task(), ""
    except SystemExit as left:
        return name, None, f"A controller called sys.exit({left.code!r})"
    except Exception:  # as text, since not every exception can be pickled
        return name, None, traceback.format_exc()


def _answers(tasks: Tasks, submit: Submit, at_once: int) -> Iterator[Answer]:
    """Keep so many tasks under way, and yield each answer as it comes."""
    waiting, running = iter(tasks.items()), dict[Future[Answer], str]()
    while True:
        for name, task in islice(waiting, at_once - len(running)):
            running[submit(name, task)] = name
        if not running:
            return
        for done in wait(running, return_when=FIRST_COMPLETED).done:
            name = running.pop(done)
            try:
                yield done.result()
            except PicklingError:  # perhaps of a user's own controller: it runs here
                yield _attempt(name, tasks[name])
            except Exception as lost:
                yield name, None, f"{lost}\n{LOST}"


def _on_this_machine(tasks: Tasks, jobs: int | None) -> Iterator[Answer]:
    """Run tasks in processes of their own. If one is killed, the tasks under way fail."""
    from joblib import cpu_count  # here: slow to import
    from joblib.externals.loky import get_reusable_executor

    jobs = jobs or cpu_count()
    if jobs == 1 or not tasks:
        yield from (_attempt(name, task) for name, task in tasks.items())
        return
    at_once = min(jobs, len(tasks))
    one_thread = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL")}
    pool = partial(get_reusable_executor, at_once, env=one_thread)  # anew if it is broken

    def submit(*task: Any) -> Any:
        with _without_interruption():
            return pool().submit(_attempt, *task)

    try:
        yield from _answers(tasks, submit, at_once)
    except BaseException:  # including Ctrl-C
        pool().shutdown(kill_workers=True)
        raise


@contextmanager
def _without_interruption() -> Iterator[None]:
    """Put Ctrl-C off, and keep it from processes that start here: the first one ends them."""
    if sys.platform == "win32":
        yield
        return
    from multiprocessing import resource_tracker  # which Windows lacks

    resource_tracker.ensure_running()  # as its start lets Ctrl-C through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _on_cluster(tasks: Tasks, jobs: int | None) -> Iterator[Answer]:
    """Run tasks on the cluster at RAY_ADDRESS or on this machine; Ray replaces lost nodes."""
    import ray  # here: an optional package that takes a second to import

    if not ray.is_initialized():
        with blame("--backend"):
            _connect(os.environ.get("RAY_ADDRESS", "127.0.0.1:6379"))
    remote: Any = ray.remote(num_cpus=1, max_retries=2)(_attempt)
    # Several tasks a core, enough to occupy nodes that join later.
    at_once = jobs or 4 * int(ray.cluster_resources().get("CPU", 1))
    needed = versions()
    return _answers(tasks, lambda *task: remote.remote(*task, needed).future(), at_once)


def _connect(address: str) -> None:
    import ray

    # `ray job submit` has uploaded the same code.
    os.environ.setdefault("RAY_OVERRIDE_JOB_RUNTIME_ENV", "1")
    host, _, port = address.removeprefix("ray://").rpartition(":")
    try:
        if port.isdecimal():  # Ray itself would wait for minutes
            socket.create_connection((host, int(port)), timeout=10).close()
        ray.init(
            address=address,
            runtime_env={"working_dir": str(ROOT), "excludes": STAYS},
            log_to_driver=False,
            logging_level=logging.ERROR,
        )
    except OSError as error:
        raise ValueError(
            "no Ray cluster can be reached: start one with `ray start --head`, or set "
            f"RAY_ADDRESS ({error})"
        ) from error
