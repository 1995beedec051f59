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
# as a `functools.partial` of a function of a module.
Task = Callable[[], Any]
LISTED_FAILURES = 20  # largest number of failed tasks that a message lists


class Outcome(NamedTuple):
    """The outcome of a task that has ended."""

    task: str  # the name of the task
    result: Any  # what the task returned; None if the task failed
    error: str  # why the task failed: a first line, and perhaps a traceback; "" after success


@options
@dataclass(frozen=True, kw_only=True)
class FanOut:
    """The options that say how many tasks run at once, and where the tasks run.

    With `--jobs 1`, tasks run in this process. The result of a task does not depend on these
    two options if all random numbers of the task come from seeds in its arguments.
    """

    jobs: Count | None = None
    """The number of tasks that run at once (default: one per core)."""
    backend: Literal["loky", "ray"] = "loky"
    """Where tasks run: loky is this machine, and ray is the Ray cluster at RAY_ADDRESS."""

    def stream(
        self, tasks: Mapping[str, Task], title: str, store: KeptResults | None = None
    ) -> Iterator[tuple[str, Any]]:
        """Run tasks, and yield the name and the result of each task that has succeeded.

        A result is yielded as soon as the task has finished, in any order. On a Ray cluster,
        all results are yielded at the end.

        Parameters
        ----------
        tasks
            The tasks by name.
        title
            Title of the progress bar.
        store
            Stored results, which are yielded first: their tasks are not run. The results of
            tasks that run are added to the store.

        Raises
        ------
        UnfinishedError
            At the end, if tasks failed. The message names the failed tasks and their errors.
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
        """Run tasks, and yield the outcome of each task when the task has ended, in any order.

        Raises
        ------
        UnfinishedError
            If the system killed a process that ran tasks.
        """
        import joblib  # imported here, as it is slow to import

        calls = [joblib.delayed(_attempt)(name, task) for name, task in tasks.items()]
        if self.backend == "ray":
            _connect_to_ray()
            yield from joblib.Parallel(self.jobs or -1, backend="ray")(calls)
            return
        jobs = min(self.jobs or joblib.cpu_count(), len(calls))
        jobs = max(jobs, 1)  # There are no calls if all results are stored.
        with joblib.parallel_config(
            "loky",
            inner_max_num_threads=1,
            initializer=_prepare_worker,
            initargs=(os.getpid(),),
        ):
            parallel = joblib.Parallel(jobs, return_as="generator_unordered", batch_size=1)
        # The processes that start here ignore Ctrl-C, too.
        handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
        try:
            outcomes = parallel(calls)
        finally:
            signal.signal(signal.SIGINT, handler)
        try:
            yield from outcomes
        except BrokenProcessPool as error:
            raise UnfinishedError(
                "a process was killed, perhaps because memory ran out: try fewer --jobs"
            ) from error


def _attempt(name: str, task: Task) -> Outcome:
    """Run the task called `name`, in any process, and return the outcome of the task.

    If the task raises an error, the outcome has the error as text, since some exceptions cannot
    be pickled.
    """
    try:
        return Outcome(name, task(), "")
    except UsageError as error:
        return Outcome(name, None, str(error))
    except (Exception, SystemExit) as error:
        reason = f"{type(error).__name__}: {error}"
        return Outcome(name, None, f"{reason}\n\n{traceback.format_exc()}")


def _summary(failures: Sequence[Outcome], tasks: int) -> str:
    """Return a message with the first line of each task's error, and all of the first error.

    `failures` are the outcomes of the failed tasks, and `tasks` is the number of all tasks,
    also of those that succeeded.
    """
    lines = [f"{len(failures)} of {tasks} tasks failed; the other tasks have finished"]
    for failure in failures[:LISTED_FAILURES]:
        first_line, _, _ = failure.error.partition("\n")
        lines.append(f"{failure.task}: {first_line}")
    return "\n".join([*lines, "", failures[0].error])


def _prepare_worker(parent: int) -> None:
    """Make this worker process ignore Ctrl-C, and end when its parent process has ended.

    A terminal sends Ctrl-C to all processes, and the parent ends its workers. `parent` is the
    process identifier of the parent.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def end_with_parent() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()


@contextmanager
def progress_bar(title: str, total: int) -> Iterator[Callable[[], None]]:
    """Show a progress bar during the block of a `with` statement.

    The block calls the yielded function, without arguments, each time a task has finished.
    `total` is the number of tasks. The bar is hidden if the standard error stream is not a
    terminal.
    """
    from rich.console import Console
    from rich.progress import Progress

    hidden = not sys.stderr.isatty()
    with Progress(console=Console(stderr=True), transient=True, disable=hidden) as progress:
        bar = progress.add_task(title, total=total)
        yield lambda: progress.advance(bar)


def _connect_to_ray() -> None:
    """Connect this process to a Ray cluster, and make "ray" a backend of joblib.

    The environment variable RAY_ADDRESS has the address of the cluster; by default, a cluster
    on this machine is looked for. Ray copies the code of the checkout to the nodes of the
    cluster.

    Raises
    ------
    UsageError
        If no cluster can be reached.
    """
    import ray  # imported here, as it is optional and slow to import
    from ray.util.joblib import register_ray

    register_ray()
    # The tasks need the code alone: the patterns with "!" make exceptions from the first one.
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
