"""Declare and run the commands `python -m benchmarks.NAME`, and their tasks in parallel.

A command is a file, `benchmarks/NAME.py`, or a folder with a `__main__.py`. It has a dataclass
of options, whose docstrings are the help, and a function `work` that takes these options. The
function prints its results, returns the closing line, and imports what is slow to import.
`main = command("NAME", Options, work)` makes the command of the two.
"""

import errno
import inspect
import math
import os
import shlex
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn, TypeVar

from benchmarks.lib.errors import UnfinishedError, UsageError
from benchmarks.lib.provenance import COMMAND_LINE, ROOT
from benchmarks.lib.results import KeptResults

EXTRAS = {
    "compare": "cyclopts filelock joblib markdown matplotlib pandas rich scipy tabulate",
    "data": "h5py minari",
    "bench": "optuna PIL stable_baselines3",
    "ray": "ray",
    "torch": "torch",
}
SIGNALS = signal.SIGINT, signal.SIGTERM


def stop(error: BaseException, program: str = "python -m benchmarks") -> NoReturn:
    """Print an error in a sentence and end the program with status 2.

    If a package is missing, the sentence names the extra that installs it. An import that fails
    for another reason is a bug, and is raised.
    """
    message = str(error)
    cause = error.__cause__ or error
    name = str(getattr(cause, "name", "")).partition(".")[0]
    extras = [extra for extra, packages in EXTRAS.items() if name in packages.split()]
    if extras:
        message = f'{name} is not installed: pip install -e ".[{extras[0]}]" ({cause})'
    elif isinstance(error, ImportError):
        raise error
    print(f"{program}: error: {message}", file=sys.stderr)
    raise SystemExit(2) from error


try:
    from cyclopts import App, CycloptsError
    from cyclopts import Parameter as Parameter  # for the commands, whose first import this is
    from cyclopts.validators import Number
except ImportError as _missing:
    stop(_missing)

Group = TypeVar("Group")

# Decorates a dataclass whose fields are options, also when it is nested in another dataclass.
options: Callable[[type[Group]], type[Group]] = Parameter(name="*")


def _strictly(kind: Callable[[str], Any], _type: object, tokens: Sequence[Any]) -> Any:
    """Read 2.5 not as an integer, which cyclopts would round, and "" not as this folder."""
    with suppress(ValueError):
        if value := tokens[0].value:
            return kind(value)
    raise ValueError  # for which cyclopts has words


def _integers(least: int, most: int) -> Parameter:
    whole = partial(_strictly, int)
    return Parameter(converter=whole, n_tokens=1, validator=Number(gte=least, lte=most))


Count = Annotated[int, _integers(1, 1_000_000_000)]
Runs = Annotated[int, _integers(1, 100_000)]
Seed = Annotated[int, _integers(0, 2**63)]
Finite = Annotated[float, Parameter(validator=Number(gt=-math.inf, lt=math.inf))]
Names = Annotated[tuple[str, ...], Parameter(consume_multiple=True)]
Folder = Annotated[
    Path, Parameter(help="Folder to write to.", converter=partial(_strictly, Path), n_tokens=1)
]


@contextmanager
def blame(option: str) -> Iterator[None]:
    """Turn a ValueError into a `UsageError` that names the option."""
    try:
        yield
    except ValueError as error:
        raise UsageError(f"{option}: {error}") from error


def known(option: str, listed: Sequence[str], names: Collection[str]) -> list[str]:
    """Return the names that an option lists, each once; `UsageError` if one is not known."""
    for name in listed:
        if name not in names:
            raise UsageError(f"{option}: no {name!r}; there are {', '.join(names)}")
    return list(dict.fromkeys(listed))


def _typed(default: object) -> str | None:
    """Return a default as a user would type it; None if it is not worth showing."""
    if default is None or default is False or default == ():
        return None
    return " ".join(map(str, default)) if isinstance(default, tuple) else str(default)


def read(declared: type[Group], program: str, words: Sequence[str]) -> Group | None:
    """Read a command line into options; with --help, print the help and return None.

    An invalid option is a `UsageError`.
    """
    app = App(
        name=program,
        help=inspect.getdoc(declared),
        version_flags=[],
        default_parameter=Parameter(negative=(), allow_repeating=True, show_default=_typed),
        result_action="return_value",
    )
    app["--help"].show = False
    app.default(declared)
    try:
        chosen = app(list(words), exit_on_error=False, print_error=False)
    except CycloptsError as error:
        raise UsageError(" ".join(str(error).split())) from error
    return chosen if isinstance(chosen, declared) else None


def command(
    name: str, declared: type[Group], work: Callable[[Group], str]
) -> Callable[..., int]:
    """Return the `main` of the command `python -m benchmarks.NAME`.

    It takes the command line without the program's name, by default that of the process, and
    returns the exit status of `finish`.
    """
    program = f"python -m benchmarks.{name}"

    def main(arguments: Sequence[str] | None = None) -> int:
        words = sys.argv[1:] if arguments is None else arguments
        token = COMMAND_LINE.set(shlex.join(["python", "-m", f"benchmarks.{name}", *words]))
        os.environ["MPLBACKEND"] = "agg"  # figures go to files, whatever the shell has set
        for stream in (sys.stdout, sys.stderr):
            if hasattr(stream, "reconfigure"):
                stream.reconfigure(errors="replace")  # for "°C" on an ASCII terminal
        for number in SIGNALS:
            if arguments is None and signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, _interrupt)

        def read_and_work() -> str:
            chosen = read(declared, program, words)
            closing_line = "" if chosen is None else work(chosen)
            if arguments is None:  # the process ends: nothing is left to be interrupted
                _ignore_signals()
            return closing_line

        try:
            return finish(read_and_work, program)
        finally:
            COMMAND_LINE.reset(token)

    return main


def finish(work: Callable[[], str], program: str) -> int:
    """Do work, print the line that it returns, and return the exit status.

    This is 0 for success; 1 if tasks failed, a file could not be written or memory ran out; 130
    after Ctrl-C and 143 after SIGTERM. An invalid option or a missing package ends the program
    with 2.
    """
    try:
        if closing_line := work():
            print(closing_line, flush=True)
    except KeyboardInterrupt as stopped:
        print("\nInterrupted.", flush=True)
        return 128 + (stopped.args[0] if stopped.args else signal.SIGINT)
    except (UnfinishedError, MemoryError) as error:
        print(str(error) or "There is not enough memory for so many runs or samples.")
        return 1
    except (UsageError, ImportError) as error:
        stop(error, program)
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EPIPE):
            raise  # it is no full disk, and no reader that has gone
        print(f"{program}: the output is cut off: {error.strerror}", file=sys.stderr)
        # What is left is flushed at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return 0


def _ignore_signals() -> None:
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def _interrupt(number: int, _frame: object) -> NoReturn:
    """Raise KeyboardInterrupt; later signals are ignored while what has finished is written."""
    _ignore_signals()
    raise KeyboardInterrupt(number)


Task = Callable[[], Any]
Answer = tuple[str, Any, str]  # the name of a task, its result, and its error or ""


@options
@dataclass(frozen=True, kw_only=True)
class FanOut:
    """Where tasks run, by joblib, and how many at once. With one job they run in this process.

    A result depends on neither, as long as all randomness of a task comes from its arguments.
    """

    jobs: Count | None = None
    """Number of tasks run at once (default: one per core)."""
    backend: Literal["loky", "ray"] = "loky"
    """Where tasks run: loky for this machine, ray for the Ray cluster at RAY_ADDRESS."""

    def stream(
        self, tasks: Mapping[str, Task], title: str = "", kept: KeptResults | None = None
    ) -> Iterator[tuple[str, Any]]:
        """Run tasks, and yield the name and result of each as it finishes; on Ray, at the end.

        Tasks are functions without arguments, by name, such as a `functools.partial` of a
        function of a module. Results that are kept already are yielded first. A progress bar
        has the title, if there is one. `UnfinishedError`, at the end, says what went wrong.
        """
        missing, errors = dict(tasks), {}
        with progress_bar(title, len(tasks)) as advance:
            for name in tasks:
                result = kept.load(name) if kept else None
                if result is not None:
                    del missing[name]
                    advance()
                    yield name, result
            for name, result, error in self._answers(missing):
                advance()
                if error:
                    errors[name] = error
                    continue
                if kept:
                    kept.save(name, result)
                yield name, result
        if errors:
            raise UnfinishedError(_summary(errors, len(tasks)))

    def _answers(self, tasks: Mapping[str, Task]) -> Iterator[Answer]:
        """Run tasks, and yield each answer as it comes."""
        import joblib  # here: slow to import
        from joblib.externals.loky.process_executor import TerminatedWorkerError

        if self.backend == "ray":
            _connect()
            calls = [joblib.delayed(_attempt)(name, task) for name, task in tasks.items()]
            with joblib.parallel_config("ray", n_jobs=self.jobs or -1):
                yield from joblib.Parallel()(calls)
            return
        process = os.getpid()
        calls = [joblib.delayed(_attempt)(name, task, process) for name, task in tasks.items()]
        jobs = max(1, min(self.jobs or joblib.cpu_count(), len(calls)))
        try:
            with joblib.parallel_config("loky", inner_max_num_threads=1):
                parallel = joblib.Parallel(jobs, return_as="generator_unordered", batch_size=1)
                with _processes_that_ignore(signal.SIGINT):
                    answers: Iterator[Answer] = parallel(calls)
            yield from answers
        except TerminatedWorkerError as error:
            raise UnfinishedError(
                "a process was killed, perhaps for lack of memory: try fewer --jobs"
            ) from error


def _summary(errors: Mapping[str, str], tasks: int) -> str:
    """Return a text about errors, by task: each kind once, and the first with its traceback."""
    summary = [f"{len(errors)} of {tasks} tasks failed; the others are done"]
    first_of_kind: dict[str, str] = {}
    for name, text in errors.items():
        first_of_kind.setdefault(text.splitlines()[-1], name)
    for last_line, name in list(first_of_kind.items())[:20]:
        summary.append(f"{name}: {last_line}")
    return "\n".join([*summary, next(iter(errors.values()))])


@contextmanager
def _processes_that_ignore(number: int) -> Iterator[None]:
    """Start processes that ignore a signal, such as Ctrl-C, on which this process ends them.

    Only the main thread can ask for that. Those of another thread ignore it from their first
    task on.
    """
    before = signal.getsignal(number)
    if threading.current_thread() is not threading.main_thread() or before is None:
        yield
        return
    signal.signal(number, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(number, before)


def _attempt(name: str, task: Task, parent: int = 0) -> Answer:
    """Run a task, and return its error as text, since not every exception can be pickled.

    `parent` is the process that started the one of this task; 0 on a cluster.
    """
    if parent not in (0, os.getpid()):
        _prepare_process(parent)
    try:
        return name, task(), ""
    except UsageError as error:  # a sentence, of a user's own controller
        return name, None, str(error)
    except (Exception, SystemExit):
        return name, None, traceback.format_exc().strip()


@cache
def _prepare_process(parent: int) -> None:
    """Make this process ignore Ctrl-C, and end when the process that started it is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def end_with_parent() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()


@contextmanager
def progress_bar(title: str, total: int) -> Iterator[Callable[[], None]]:
    """Show a progress bar on a terminal, and yield what moves it on by one task."""
    from rich.console import Console
    from rich.progress import Progress

    console, hidden = Console(stderr=True), not (title and sys.stderr.isatty())
    with Progress(console=console, transient=True, disable=hidden) as progress:
        bar = progress.add_task(title, total=total)
        yield lambda: progress.advance(bar)


def _connect() -> None:
    """Connect to the cluster at RAY_ADDRESS, or the one that was started on this machine.

    Ray brings the checkout to its nodes, which need the packages that a task imports.
    """
    import ray  # here: an optional package that takes a second to import
    from ray.util.joblib import register_ray

    register_ray()
    stays = "/*", "!/.", "!/agents", "!/benchmarks", "!/mptc_gym", "!/*.py", "published", "*.md"
    try:
        ray.init(
            address=os.environ.get("RAY_ADDRESS", "auto"),
            runtime_env={"working_dir": str(ROOT), "excludes": [*stays]},
            ignore_reinit_error=True,
            log_to_driver=False,
        )
    except (OSError, RuntimeError, ValueError) as error:
        raise UsageError(
            "--backend: no Ray cluster can be reached: start one with `ray start --head`, or "
            f"set RAY_ADDRESS ({error})"
        ) from error
