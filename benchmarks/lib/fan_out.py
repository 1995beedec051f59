"""Run the tasks of a command in parallel, on this machine or on a Ray cluster."""

import signal
import traceback
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, TypeVar

from benchmarks.lib.command import CommandError, Count, options
from benchmarks.lib.outputs import ROOT

# A part of a command's work: a function without arguments that can run in another process, such
# as a `functools.partial` of a module's function.
Task = Callable[[], Any]
Item = TypeVar("Item")


class Outcome(NamedTuple):
    """The result of a task, or the reason why the task failed."""

    task: str  # the name of the task
    result: Any  # what the task returned; None if the task failed
    # "" after success; the message of a `CommandError`, by which a task refuses what the user
    # asked for; or the traceback of another exception
    error: str


class Finished(NamedTuple):
    """The results of the tasks that have finished, and why others are missing."""

    results: dict[str, Any]  # what the tasks returned, by name, in the order of the tasks
    # An error that names the missing tasks, to be raised when the results are written; None if
    # all tasks have finished.
    error: CommandError | None


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

    def run(
        self,
        tasks: Mapping[str, Task],
        title: str,
        save: Callable[[str, Any], object] | None = None,
    ) -> Finished:
        """Run tasks, and return the results of all tasks that have finished.

        A task that raises an exception does not stop the others. After Ctrl-C, no further task
        starts. With `--backend ray`, all results come after the last task has finished, so an
        earlier Ctrl-C loses them.

        Parameters
        ----------
        tasks
            Tasks by name: functions without arguments.
        title
            Title of the progress bar.
        save
            Function that is called with the name and the result of each task when it has
            finished. With `--backend ray`, this is after the last task has finished.

        Raises
        ------
        CommandError
            If no task has finished.
        """
        results: dict[str, Any] = {}
        failures: dict[str, str] = {}
        reason = ""
        status = 1
        try:
            for outcome in with_progress_bar(self._outcomes(tasks), title, len(tasks)):
                if outcome.error:
                    failures[outcome.task] = outcome.error
                    continue
                results[outcome.task] = outcome.result
                if save:
                    save(outcome.task, outcome.result)
        except KeyboardInterrupt:
            reason = "interrupted: "
            status = 130
        except BrokenProcessPool as killed:  # The system may have run out of memory.
            reason = f"{killed}: "
        results = {name: results[name] for name in tasks if name in results}
        missing = len(tasks) - len(results)
        if not missing:
            return Finished(results, None)
        first_line = f"{reason}{missing} of {len(tasks)} tasks are missing"
        error = CommandError("\n".join([first_line, *_summary(failures)]), status)
        if not results:
            raise error
        return Finished(results, error)

    def _outcomes(self, tasks: Mapping[str, Task]) -> Iterable[Outcome]:
        """Run tasks, and return an `Outcome` for each task, on this machine as it ends."""
        import joblib  # imported here, as it is slow to import

        calls = [joblib.delayed(_attempt)(name, task) for name, task in tasks.items()]
        if self.backend == "ray":
            _connect_to_ray()
            # For Joblib, -1 is one task per core.
            by_ray: list[Outcome] = joblib.Parallel(self.jobs or -1, backend="ray")(calls)
            return by_ray
        # A terminal sends Ctrl-C to all processes, but only the first process shall act on it.
        with joblib.parallel_config(
            "loky",
            inner_max_num_threads=1,
            initializer=signal.signal,
            initargs=(signal.SIGINT, signal.SIG_IGN),
        ):
            parallel = joblib.Parallel(
                self.jobs or -1, return_as="generator_unordered", batch_size=1
            )
        outcomes: Iterable[Outcome] = parallel(calls)
        return outcomes


def _attempt(name: str, task: Task) -> Outcome:
    """Run the task called `name`, and return an `Outcome` with the result or the error.

    An `Outcome` holds an error as text, because some exceptions cannot be pickled.
    """
    try:
        return Outcome(name, task(), "")
    except CommandError as refusal:
        return Outcome(name, None, str(refusal))
    except Exception:
        return Outcome(name, None, traceback.format_exc())


def _summary(failures: Mapping[str, str]) -> list[str]:
    """Return a line for each failed task, with its name and error, and the first traceback."""
    # The last line of a traceback has the error.
    lines = [f"{name}: {text.splitlines()[-1]}" for name, text in failures.items()]
    tracebacks = [text for text in failures.values() if "\n" in text]
    return [*lines, *tracebacks[:1]]


def with_progress_bar(items: Iterable[Item], title: str, total: int) -> Iterable[Item]:
    """Return `items`, whose progress a bar shows on a terminal (standard error stream)."""
    from rich.console import Console
    from rich.progress import track

    return track(items, title, total, console=Console(stderr=True), transient=True)


def _connect_to_ray() -> None:
    """Send the checkout to the Ray cluster at RAY_ADDRESS, or else on this machine."""
    import ray  # imported here, as it is optional and slow to import
    from ray.util.joblib import register_ray

    register_ray()
    # Ray also leaves out what .gitignore names, such as .venv and results.
    code = {"working_dir": str(ROOT), "excludes": ["/.git"]}
    ray.init("auto", runtime_env=code, log_to_driver=False)
