"""Declare and run the commands `python -m benchmarks.NAME`, and run their tasks in parallel.

The code of the command NAME is the file `benchmarks/NAME.py`, or a folder `benchmarks/NAME`
with a `__main__.py`. The code of a command defines a dataclass `Options`, whose docstrings are
the text of `--help`, and a function `work`. The function `work` takes an instance of `Options`,
writes the results and returns the last line to print. Packages that are slow to import are
imported within `work`, so that `--help` is quick. The line
`main = command("NAME", Options, work)` makes the command.
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
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, NoReturn, TypeVar

from benchmarks.lib.errors import UnfinishedError, UsageError
from benchmarks.lib.provenance import COMMAND_LINE, ROOT
from benchmarks.lib.results import KeptResults

# The extra of this project, as in `pip install -e ".[EXTRA]"`, that installs each package.
EXTRAS = {
    **dict.fromkeys(("cyclopts", "filelock", "joblib", "matplotlib", "pandas"), "compare"),
    **dict.fromkeys(("rich", "scipy", "tabulate"), "compare"),
    **dict.fromkeys(("optuna", "PIL", "pygame", "stable_baselines3"), "bench"),
    **dict.fromkeys(("h5py", "minari"), "data"),
    "ray": "ray",
    "torch": "torch",
}
# System errors after which nothing more can be written: the disk is full, the quota or the
# largest size of a file is exceeded, or the reader of a pipe has ended.
NOTHING_WRITABLE = errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EPIPE


def stop(error: BaseException, program: str = "python -m benchmarks") -> NoReturn:
    """Print the message of an error, without a traceback, and end this process with status 2.

    Parameters
    ----------
    error
        The error. For an `ImportError` of a missing package in `EXTRAS`, the message names the
        extra that installs the package. Any other `ImportError` is a bug, and is raised again.
    program
        The command, such as "python -m benchmarks.compare", which begins the message.
    """
    message = str(error)
    cause = error.__cause__ or error
    package = str(getattr(cause, "name", "")).partition(".")[0]
    if package in EXTRAS:
        extra = EXTRAS[package]
        message = f'{package} is not installed: pip install -e ".[{extra}]" ({cause})'
    elif isinstance(error, ImportError):
        raise error
    print(f"{program}: error: {message}", file=sys.stderr)
    raise SystemExit(2) from error


try:
    from cyclopts import App, CycloptsError
    from cyclopts import Parameter as Parameter  # The commands import it from this module.
    from cyclopts.validators import Number
except ImportError as _missing:
    stop(_missing)

Group = TypeVar("Group")  # a dataclass whose fields are options of a command

# A decorator of dataclasses: the fields become options of a command, `--field VALUE`, also if
# the dataclass is the type of a field of another dataclass.
options: Callable[[type[Group]], type[Group]] = Parameter(name="*")


def _whole_number(_type: object, tokens: Sequence[Any]) -> int:
    """Convert the text that a user typed to an integer, for cyclopts.

    The text is `tokens[0].value`. A ValueError is raised if the text is not a whole number;
    cyclopts without this converter would turn 2.5 into 2.
    """
    typed = tokens[0].value
    try:
        return int(typed)
    except ValueError as error:
        raise ValueError(f"must be a whole number, got {typed}") from error


def _folder(_type: object, tokens: Sequence[Any]) -> Path:
    """Convert the text that a user typed to the path of a folder, for cyclopts.

    The text is `tokens[0].value`. A ValueError is raised if the text is empty; cyclopts without
    this converter would turn "" into the current folder.
    """
    if not tokens[0].value:
        raise ValueError("must name a folder")
    return Path(tokens[0].value)


def _integers(least: int, most: int) -> Parameter:
    """Return an annotation of an option that accepts integers from `least` to `most` only."""
    allowed = Number(gte=least, lte=most)
    return Parameter(converter=_whole_number, n_tokens=1, validator=allowed)


# Types of options, with limits that no useful value exceeds.
Count = Annotated[int, _integers(1, 1_000_000_000)]
Runs = Annotated[int, _integers(1, 100_000)]
Seed = Annotated[int, _integers(0, 2**63)]
Finite = Annotated[float, Parameter(validator=Number(gt=-math.inf, lt=math.inf))]
Names = Annotated[tuple[str, ...], Parameter(consume_multiple=True)]
Folder = Annotated[
    Path, Parameter(help="The folder to write to.", converter=_folder, n_tokens=1)
]


@contextmanager
def blame(option: str) -> Iterator[None]:
    """Turn a ValueError in the block of a `with` statement into a `UsageError`.

    The message begins with `option`, the name of an option such as "--agent".
    """
    try:
        yield
    except ValueError as error:
        raise UsageError(f"{option}: {error}") from error


def known(option: str, listed: Sequence[str], names: Collection[str]) -> list[str]:
    """Return the names that a user has listed in an option, each once and in the same order.

    Parameters
    ----------
    option
        The name of the option, such as "--scenarios", for the error message.
    listed
        The names that the user has listed.
    names
        All valid names.

    Raises
    ------
    UsageError
        If a listed name is not valid.
    """
    for name in listed:
        if name not in names:
            raise UsageError(f"{option}: there is no {name!r}; choose from {', '.join(names)}")
    return list(dict.fromkeys(listed))


def _default_as_typed(default: object) -> str | None:
    """Return the default of an option as a user would type it, for the text of `--help`.

    The result is None if the help is not to show a default: for None, False and ().
    """
    if default is None or default is False or default == ():
        return None
    if isinstance(default, tuple):
        return " ".join(map(str, default))
    return str(default)


def read(declared: type[Group], program: str, words: Sequence[str]) -> Group | None:
    """Convert the words of a command line to options, or print the help after `--help`.

    Parameters
    ----------
    declared
        The dataclass of options.
    program
        The command, such as "python -m benchmarks.compare", for the help.
    words
        The words of the command line after the command.

    Returns
    -------
    object or None
        An instance of `declared`; None if the help was printed.

    Raises
    ------
    UsageError
        If an option is unknown or has an invalid value.
    """
    app = App(
        name=program,
        help=inspect.getdoc(declared),
        version_flags=[],
        default_parameter=Parameter(
            negative=(), allow_repeating=True, show_default=_default_as_typed
        ),
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
    """Return the function `main` of the command `python -m benchmarks.NAME`.

    `main(arguments)` takes the words of a command line after the command, by default the words
    with which this process was started. The function `main` reads the options, calls `work`,
    and returns the exit status of the command, as `finish` does.

    Parameters
    ----------
    name
        NAME, such as "compare".
    declared
        The dataclass of options.
    work
        Does the work for an instance of `declared`, and returns the last line to print.
    """
    program = f"python -m benchmarks.{name}"

    def main(arguments: Sequence[str] | None = None) -> int:
        words = sys.argv[1:] if arguments is None else list(arguments)
        if arguments is None:  # This process runs the command alone.
            _interrupt_on_signals()

        def read_and_work() -> str:
            chosen = read(declared, program, words)
            return "" if chosen is None else work(chosen)

        token = COMMAND_LINE.set(shlex.join([*program.split(), *words]))
        try:
            return finish(read_and_work, program)
        finally:
            COMMAND_LINE.reset(token)

    return main


def finish(work: Callable[[], str], program: str) -> int:
    """Call `work`, print the line that it returns, and return the exit status of a command.

    The status is 0 for success; 1 if tasks failed, memory ran out, or nothing more could be
    written; 130 after Ctrl-C and 143 after SIGTERM. After a `UsageError`, or if a package is
    missing, this process ends with status 2. `program` is the command, such as
    "python -m benchmarks.compare", which begins the error messages.
    """
    try:
        closing_line = work()
        if closing_line:
            print(closing_line, flush=True)
        return 0
    except KeyboardInterrupt as interrupt:
        print("\nInterrupted.", flush=True)
        number = interrupt.args[0] if interrupt.args else signal.SIGINT
        return 128 + int(number)
    except UnfinishedError as error:
        print(error)
    except MemoryError:
        print("There is not enough memory for so many runs or samples.")
    except (UsageError, ImportError) as error:
        stop(error, program)
    except OSError as error:
        if error.errno not in NOTHING_WRITABLE:
            raise
        print(f"{program}: nothing more can be written: {error.strerror}", file=sys.stderr)
        # Python writes the rest of its output at exit, which would raise the error again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 1


def _interrupt_on_signals() -> None:
    """Make the first Ctrl-C or SIGTERM raise a KeyboardInterrupt in this process.

    The number of the signal is the argument of the KeyboardInterrupt. After the first signal,
    Ctrl-C and SIGTERM are ignored, so that the command can write its finished results. A signal
    that this process ignored when it was started, as with `nohup`, stays ignored.
    """
    signals = [
        number
        for number in (signal.SIGINT, signal.SIGTERM)
        if signal.getsignal(number) is not signal.SIG_IGN
    ]

    def interrupt(number: int, _frame: object) -> NoReturn:
        for later in signals:
            signal.signal(later, signal.SIG_IGN)
        raise KeyboardInterrupt(number)

    for number in signals:
        signal.signal(number, interrupt)


Task = Callable[[], Any]  # a part of a command's work that can run in another process


class Answer(NamedTuple):
    """The outcome of a task that has ended."""

    task: str  # the name of the task
    result: Any  # what the task returned; None if the task failed
    error: str  # the message or traceback of a task that failed; "" after success


@options
@dataclass(frozen=True, kw_only=True)
class FanOut:
    """The options that say how many tasks run at once, and where joblib runs the tasks.

    With `--jobs 1`, tasks run in this process. The result of a task does not depend on these
    two options if all random numbers of the task come from seeds in its arguments.
    """

    jobs: Count | None = None
    """The number of tasks that run at once (default: one per core)."""
    backend: Literal["loky", "ray"] = "loky"
    """Where tasks run: loky is this machine, and ray is the Ray cluster at RAY_ADDRESS."""

    def stream(
        self, tasks: Mapping[str, Task], title: str = "", store: KeptResults | None = None
    ) -> Iterator[tuple[str, Any]]:
        """Run tasks, and yield the name and the result of each task that has succeeded.

        A result is yielded as soon as the task has finished, in any order. On a Ray cluster,
        all results are yielded at the end.

        Parameters
        ----------
        tasks
            The tasks by name: functions without arguments that can be pickled, such as a
            `functools.partial` of a function of a module.
        title
            Title of the progress bar; "" for no progress bar.
        store
            Stored results. A task whose result is stored is not run: its result is yielded
            before all others. The results of tasks that run are added to the store.

        Raises
        ------
        UnfinishedError
            At the end, if tasks failed. The message names the failed tasks and their errors.
        """
        missing: dict[str, Task] = {}
        errors: dict[str, str] = {}
        with progress_bar(title, len(tasks)) as advance:
            for name, task in tasks.items():
                result = store.load(name) if store else None
                if result is None:
                    missing[name] = task
                    continue
                advance()
                yield name, result
            for answer in self._answers(missing):
                advance()
                if answer.error:
                    errors[answer.task] = answer.error
                    continue
                if store:
                    store.save(answer.task, answer.result)
                yield answer.task, answer.result
        if errors:
            raise UnfinishedError(_summary(errors, len(tasks)))

    def _answers(self, tasks: Mapping[str, Task]) -> Iterator[Answer]:
        """Run tasks, and yield the outcome of a task when the task has ended, in any order.

        `tasks` are as in `stream`. An `UnfinishedError` is raised if the system killed a
        process that ran tasks; failed tasks raise nothing.
        """
        import joblib  # imported here, as it is slow to import

        calls = [joblib.delayed(_attempt)(name, task) for name, task in tasks.items()]
        if self.backend == "ray":
            _connect_to_ray()
            with joblib.parallel_config("ray", n_jobs=self.jobs or -1):
                yield from joblib.Parallel()(calls)
            return
        jobs = max(1, min(self.jobs or joblib.cpu_count(), len(calls)))
        with joblib.parallel_config(
            "loky",
            inner_max_num_threads=1,
            initializer=_prepare_worker,
            initargs=(os.getpid(),),
        ):
            parallel = joblib.Parallel(jobs, return_as="generator_unordered", batch_size=1)
        try:
            with _ctrl_c_ignored():  # The processes that start here ignore Ctrl-C, too.
                answers = parallel(calls)
            yield from answers
        except BrokenProcessPool as error:
            raise UnfinishedError(
                "a process was killed, perhaps because memory ran out: try fewer --jobs"
            ) from error


@contextmanager
def _ctrl_c_ignored() -> Iterator[None]:
    """Ignore Ctrl-C in this process during the block of a `with` statement.

    In a thread other than the main thread, nothing is done, since Python lets no other thread
    change how signals are handled.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)


def _attempt(name: str, task: Task) -> Answer:
    """Run the task called `name` in a worker process, and return the outcome of the task.

    If the task raises an error, the outcome has the error as text, since not every exception
    can be pickled.
    """
    try:
        return Answer(name, task(), "")
    except UsageError as error:  # The message is for the user, who needs no traceback.
        return Answer(name, None, str(error))
    except (Exception, SystemExit):
        return Answer(name, None, traceback.format_exc().strip())


def _summary(errors: Mapping[str, str], tasks: int) -> str:
    """Return the message of the `UnfinishedError` for failed tasks.

    The message has the last line of the error of each failed task, of at most 20 tasks, and
    then all lines of the first error.

    Parameters
    ----------
    errors
        The message or traceback of each failed task, by the name of the task.
    tasks
        The number of all tasks, with those that succeeded.
    """
    lines = [f"{len(errors)} of {tasks} tasks failed; the other tasks have finished"]
    for name, text in list(errors.items())[:20]:
        lines.append(f"{name}: {text.splitlines()[-1]}")
    lines.append(next(iter(errors.values())))
    return "\n".join(lines)


def _prepare_worker(parent: int) -> None:
    """Make this worker process ignore Ctrl-C, and end when its parent process has ended.

    joblib calls this function at the start of each worker process. `parent` is the process
    identifier of the parent. A terminal sends Ctrl-C to the parent and to all workers; the
    parent then ends the workers.
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
    `total` is the number of tasks. The bar is hidden if `title` is "" or if the standard error
    stream is not a terminal.
    """
    from rich.console import Console
    from rich.progress import Progress

    hidden = not (title and sys.stderr.isatty())
    with Progress(console=Console(stderr=True), transient=True, disable=hidden) as progress:
        bar = progress.add_task(title, total=total)
        yield lambda: progress.advance(bar)


def _connect_to_ray() -> None:
    """Connect this process to a Ray cluster, and make "ray" a backend of joblib.

    The environment variable RAY_ADDRESS has the address of the cluster; by default, a cluster
    on this machine is looked for. Ray copies the code of the checkout to the nodes of the
    cluster. A `UsageError` is raised if no cluster can be reached.
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
