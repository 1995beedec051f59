"""Run independent tasks in parallel, by joblib: in processes of this machine or on Ray.

A result does not depend on which process runs the task, or when, as long as all its randomness
comes from its arguments. A task that raises an exception costs no other.

The nodes of a Ray cluster need Ray and the packages that a task imports. They need no checkout:
Ray unpacks the code where its workers run.
"""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any, Literal

from benchmarks.lib.command import Count, listen, options
from benchmarks.lib.storage import ROOT, Kept, UnfinishedError, UsageError

# Files that are not uploaded to a cluster, in .gitignore syntax: the whole checkout except its
# packages and the modules beside them, such as a user's own controllers.
STAYS = [
    *("/*", "!/.", "!/agents", "!/benchmarks", "!/mptc_gym", "!/*.py"),
    *("__pycache__", "published", "*.md"),
]

Task = Callable[[], Any]
Answer = tuple[str, Any, str]  # the name of a task, its result, and its error or ""


@options
@dataclass(frozen=True, kw_only=True)
class FanOut:
    """Where tasks run, and how many at once. With one job they run in this process."""

    jobs: Count | None = None
    """Number of tasks run at once (default: one per core)."""
    backend: Literal["loky", "ray"] = "loky"
    """Where tasks run: loky for this machine, ray for the Ray cluster at RAY_ADDRESS."""

    def run(
        self, tasks: Mapping[str, Task], title: str = "", kept: Kept | None = None
    ) -> dict[str, Any]:
        """Run tasks, and return their results in the order of `tasks`; see `stream`."""
        results = dict(self.stream(tasks, title, kept))
        return {name: results[name] for name in tasks}

    def stream(
        self, tasks: Mapping[str, Task], title: str = "", kept: Kept | None = None
    ) -> Iterator[tuple[str, Any]]:
        """Run tasks, and yield the name and result of each as it finishes; on Ray, at the end.

        Parameters
        ----------
        tasks
            Functions without arguments, by name, such as a `functools.partial` of a function of
            a module.
        title
            Label of the progress bar; "" for no bar.
        kept
            Where results are kept; those that are there already are yielded first.

        Raises
        ------
        UnfinishedError
            At the end, with the errors, if tasks raised an exception; or if a process was
            killed, perhaps for lack of memory.
        UsageError
            If there is no cluster.
        """
        missing, errors = dict(tasks), {}
        with progress_bar(title, len(tasks)) as advance:
            if kept:
                for name, task in tasks.items():
                    with suppress(LookupError):
                        result = kept.load(task)
                        del missing[name]
                        advance()
                        yield name, result
            for name, result, error in self._answers(missing):
                advance()
                if error:
                    errors[name] = error
                    continue
                if kept:
                    kept.save(tasks[name], result)
                yield name, result
        if errors:
            last = {name: text.strip().splitlines()[-1] for name, text in errors.items()}
            lines = [f"{len(errors)} of {len(tasks)} tasks failed; the others are done"]
            lines += [f"{name}: {text}" for name, text in last.items()][:10]
            tracebacks = [text for name, text in errors.items() if text != last[name]]
            raise UnfinishedError("\n".join([*lines, *tracebacks[:1]]))

    def _answers(self, tasks: Mapping[str, Task]) -> Iterator[Answer]:
        """Run tasks, and yield each answer as it comes."""
        import joblib  # here: slow to import
        from joblib.externals.loky.process_executor import TerminatedWorkerError

        calls = [joblib.delayed(_attempt)(name, task) for name, task in tasks.items()]
        if self.backend == "ray":
            _connect()
            with joblib.parallel_config("ray", n_jobs=self.jobs or -1):
                yield from joblib.Parallel()(calls)
            return
        jobs = max(1, min(self.jobs or joblib.cpu_count(), len(calls)))
        try:
            with joblib.parallel_config("loky", inner_max_num_threads=1):
                parallel = joblib.Parallel(
                    jobs, return_as="generator_unordered", batch_size=1, pre_dispatch="2*n_jobs"
                )
                with _deaf():
                    answers: Iterator[Answer] = parallel(calls)
            with warnings.catch_warnings():
                # Of tasks that nobody waits for any more, as an error ends the command.
                warnings.filterwarnings("ignore", module="joblib")
                yield from answers
        except TerminatedWorkerError as error:
            raise UnfinishedError(
                "a process was killed, perhaps for lack of memory: try fewer --jobs"
            ) from error
        except KeyboardInterrupt:
            listen()  # now that joblib has ended its processes
            raise


def _attempt(name: str, task: Task) -> Answer:
    """Run a task, and return its error as text, since not every exception can be pickled."""
    try:
        return name, task(), ""
    except UsageError as error:  # a sentence, of a user's own controller
        return name, None, str(error)
    except SystemExit as left:
        return name, None, f"A controller called sys.exit({left.code!r})"
    except Exception:
        return name, None, traceback.format_exc()


@contextmanager
def _deaf() -> Iterator[None]:
    """Ignore Ctrl-C, and so do processes that start here: the first one ends them."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def progress_bar(title: str, total: int) -> Iterator[Callable[[], None]]:
    """Show a progress bar on a terminal, and yield what moves it on by one task."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

    columns = "{task.description}", BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    console, hidden = Console(stderr=True), not (title and sys.stderr.isatty())
    with Progress(*columns, console=console, transient=True, disable=hidden) as progress:
        bar = progress.add_task(title, total=total)
        yield lambda: progress.advance(bar)


def _connect() -> None:
    """Connect to the cluster at RAY_ADDRESS, or the one that was started on this machine."""
    import ray  # here: an optional package that takes a second to import
    from ray.util.joblib import register_ray

    register_ray()
    if ray.is_initialized():
        return
    # `ray job submit` has uploaded the same code.
    os.environ.setdefault("RAY_OVERRIDE_JOB_RUNTIME_ENV", "1")
    try:
        ray.init(
            address=os.environ.get("RAY_ADDRESS", "auto"),
            runtime_env={"working_dir": str(ROOT), "excludes": STAYS},
            log_to_driver=False,
            logging_level=logging.ERROR,
        )
    except (OSError, RuntimeError, ValueError) as error:
        raise UsageError(
            "--backend: no Ray cluster can be reached: start one with `ray start --head`, or "
            f"set RAY_ADDRESS ({error})"
        ) from error
