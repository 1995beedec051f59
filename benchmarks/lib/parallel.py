"""Run the tasks of a command in parallel, on this machine or on a Ray cluster."""

import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from benchmarks.lib.command import Count, options
from benchmarks.lib.errors import UnfinishedError, UsageError
from benchmarks.lib.provenance import ROOT
from benchmarks.lib.results import KeptResults

# A part of a command's work: a function without arguments that can run in another process, such
# as a `functools.partial` of a module's function.
Task = Callable[[], Any]
LISTED_FAILURES = 20  # largest number of failed tasks that a message lists


class Outcome(NamedTuple):
    """The result of a task, or the reason why the task failed."""

    task: str  # the name of the task
    result: Any  # what the task returned; None if the task failed
    error: str  # why the task failed: a first line, and perhaps a traceback; "" after success


@options
@dataclass(frozen=True, kw_only=True)
class FanOut:
    """The options `--jobs` and `--backend`: how many tasks run at once, and on which machines.

    A task that draws all random numbers from seeds in its arguments has the same result with
    all values of `--jobs` and `--backend`.
    """

    jobs: Count | None = None
    """The number of tasks that run at once (default: one per core)."""
    backend: Literal["loky", "ray"] = "loky"
    """Where tasks run: loky is this machine, and ray is the Ray cluster at RAY_ADDRESS."""

    def stream(
        self, tasks: Mapping[str, Task], title: str, store: KeptResults | None = None
    ) -> Iterator[tuple[str, Any]]:
        """Run tasks, and yield the name and the result of each task that has succeeded.

        Saved results are yielded first, and new results in the order in which tasks finish.
        With `--backend ray`, new results are yielded only after the last task has finished.

        Parameters
        ----------
        tasks
            Tasks by name: functions without arguments.
        title
            Title of the progress bar.
        store
            Results that an interrupted run of the command has saved. A task with a saved result
            does not run again; the results of all other tasks are saved in `store`.

        Raises
        ------
        UnfinishedError
            If tasks failed: the error is raised after all other tasks have finished. Also if
            the operating system killed a worker process: the error is raised at once.
        """
        missing: dict[str, Task] = {}
        failures: list[Outcome] = []
        with progress_bar(title, len(tasks)) as advance:
            for name, task in tasks.items():
                result = store.load(name) if store else None
                if result is None:
                    missing[name] = task
                else:
                    advance()
                    yield name, result
            for outcome in self._outcomes(missing):
                advance()
                if outcome.error:
                    failures.append(outcome)
                    continue
                if store:
                    store.save(outcome.task, outcome.result)
                yield outcome.task, outcome.result
        if failures:
            raise UnfinishedError(_summary(failures, len(tasks)))

    def _outcomes(self, tasks: Mapping[str, Task]) -> Iterator[Outcome]:
        """Run tasks, and yield an `Outcome` for each task, in the order in which tasks end.

        Raises
        ------
        UnfinishedError
            If the operating system killed a worker process.
        """
        import joblib  # imported here, as it is slow to import

        calls = [joblib.delayed(_attempt)(name, task) for name, task in tasks.items()]
        if self.backend == "ray":
            _connect_to_ray()
            yield from joblib.Parallel(self.jobs or -1, backend="ray")(calls)
            return
        jobs = min(self.jobs or joblib.cpu_count(), len(calls))
        jobs = max(jobs, 1)  # `calls` is empty if all results are stored.
        with joblib.parallel_config(
            "loky",
            inner_max_num_threads=1,
            initializer=_prepare_worker,
            initargs=(os.getpid(),),
        ):
            parallel = joblib.Parallel(jobs, return_as="generator_unordered", batch_size=1)
        # The worker processes inherit this handler, so a Ctrl-C does not end them.
        handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
        try:
            outcomes = parallel(calls)
        finally:
            signal.signal(signal.SIGINT, handler)
        try:
            yield from outcomes
        except BrokenProcessPool as error:
            raise UnfinishedError(
                "a process that ran tasks was killed, perhaps because memory ran out: "
                "try fewer --jobs"
            ) from error


def _attempt(name: str, task: Task) -> Outcome:
    """Run the task called `name`, and return an `Outcome` with the result or the error.

    An `Outcome` holds an error as text, because some exceptions cannot be pickled.
    """
    try:
        return Outcome(name, task(), "")
    except UsageError as error:
        return Outcome(name, None, str(error))
    except (Exception, SystemExit) as error:
        reason = f"{type(error).__name__}: {error}"
        return Outcome(name, None, f"{reason}\n\n{traceback.format_exc()}")


def _summary(failures: Sequence[Outcome], tasks: int) -> str:
    """Return a message that lists failed tasks, and ends with the whole first error.

    `tasks` is the number of failed and successful tasks together.
    """
    lines = [f"{len(failures)} of {tasks} tasks failed; the other tasks have finished"]
    for failure in failures[:LISTED_FAILURES]:
        first_line, _, _ = failure.error.partition("\n")
        lines.append(f"{failure.task}: {first_line}")
    return "\n".join([*lines, "", failures[0].error])


def _prepare_worker(parent: int) -> None:
    """Make a worker process ignore Ctrl-C, and end soon after its parent process has ended.

    After Ctrl-C, which a terminal sends to all processes, the parent process ends the worker
    processes. `parent` is the process identifier of the parent process.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def end_with_parent() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()


@contextmanager
def progress_bar(title: str, total: int) -> Iterator[Callable[[], None]]:
    """Show a progress bar for `total` tasks during the block of a `with` statement.

    Each call of the yielded function, without arguments, advances the progress bar by one task.
    The progress bar is hidden if the standard error stream is not a terminal.
    """
    from rich.console import Console
    from rich.progress import Progress

    hidden = not sys.stderr.isatty()
    with Progress(console=Console(stderr=True), transient=True, disable=hidden) as progress:
        bar = progress.add_task(title, total=total)
        yield lambda: progress.advance(bar)


def _connect_to_ray() -> None:
    """Connect this process to a Ray cluster, and make "ray" a backend of joblib.

    The environment variable RAY_ADDRESS has the address of the Ray cluster (default: a Ray
    cluster on this machine). Ray copies the source code of the project to all nodes of the
    cluster.

    Raises
    ------
    UsageError
        If no Ray cluster can be reached.
    """
    import ray  # imported here, as it is optional and slow to import
    from ray.util.joblib import register_ray

    register_ray()
    # Tasks need only the source code: "/*" excludes all files and folders, and a pattern with
    # "!", as in .gitignore, includes a folder again.
    excluded = ["/*", "!/.", "!/agents", "!/benchmarks", "!/mptc_gym", "!/*.py"]
    excluded += ["published", "*.md"]
    try:
        ray.init(
            address=os.environ.get("RAY_ADDRESS", "auto"),
            runtime_env={"working_dir": str(ROOT), "excludes": excluded},
            ignore_reinit_error=True,
            log_to_driver=False,
        )
    except (OSError, RuntimeError, ValueError) as error:
        raise UsageError(
            "--backend: no Ray cluster can be reached: start one with `ray start --head`, or "
            f"set RAY_ADDRESS ({error})"
        ) from error
