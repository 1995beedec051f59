"""Declare and run the commands `python -m benchmarks.NAME`, and run their tasks in parallel.

A command is a file `benchmarks/NAME.py`, or a folder `benchmarks/NAME` with a `__main__.py`. It
has a dataclass of options, whose docstrings are the help, and a function `work`. The function
takes the options, writes the results and returns the last line to print. The function also
imports the packages that are slow to import, so that `--help` is quick.
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

# The extra of this project that installs a package.
EXTRAS = {
    **dict.fromkeys(("cyclopts", "filelock", "joblib", "matplotlib", "pandas"), "compare"),
    **dict.fromkeys(("rich", "scipy", "tabulate"), "compare"),
    **dict.fromkeys(("optuna", "PIL", "pygame", "stable_baselines3"), "bench"),
    **dict.fromkeys(("h5py", "minari"), "data"),
    "ray": "ray",
    "torch": "torch",
}
NOTHING_WRITABLE = errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EPIPE


def stop(error: BaseException, program: str = "python -m benchmarks") -> NoReturn:
    """Print an error as a sentence and end the program with status 2.

    If a package is missing, the sentence names the extra that installs it. An `ImportError` for
    another reason is raised again, since it is a bug.
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

Group = TypeVar("Group")

# Decorates a dataclass whose fields are options, also when it is nested in another dataclass.
options: Callable[[type[Group]], type[Group]] = Parameter(name="*")


def _whole_number(_type: object, tokens: Sequence[Any]) -> int:
    """Return the whole number that a user typed; cyclopts alone would round 2.5 to 2."""
    typed = tokens[0].value
    try:
        return int(typed)
    except ValueError as error:
        raise ValueError(f"must be a whole number, got {typed}") from error


def _folder(_type: object, tokens: Sequence[Any]) -> Path:
    """Return the folder that a user typed; cyclopts alone would take "" for this folder."""
    if not tokens[0].value:
        raise ValueError("must name a folder")
    return Path(tokens[0].value)


def _integers(least: int, most: int) -> Parameter:
    """Return what makes an option accept the integers from `least` to `most` alone."""
    allowed = Number(gte=least, lte=most)
    return Parameter(converter=_whole_number, n_tokens=1, validator=allowed)


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
    """Turn a ValueError into a `UsageError` that names the option."""
    try:
        yield
    except ValueError as error:
        raise UsageError(f"{option}: {error}") from error


def known(option: str, listed: Sequence[str], names: Collection[str]) -> list[str]:
    """Return the names that an option lists, without repetitions.

    A `UsageError` names the option if a listed name is not among `names`.
    """
    for name in listed:
        if name not in names:
            raise UsageError(f"{option}: there is no {name!r}; choose from {', '.join(names)}")
    return list(dict.fromkeys(listed))


def _default_as_typed(default: object) -> str | None:
    """Return a default as a user would type it; None hides it in the help."""
    if default is None or default is False or default == ():
        return None
    if isinstance(default, tuple):
        return " ".join(map(str, default))
    return str(default)


def read(declared: type[Group], program: str, words: Sequence[str]) -> Group | None:
    """Read the words of a command line into options.

    With `--help`, the help is printed and None is returned. An invalid option raises a
    `UsageError`.
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

    `main` takes the words of the command line after the program's name, by default those of
    this process, and returns the exit status of `finish`.
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
    """Do work, print the line that it returns, and return the exit status.

    The status is 0 for success; 1 if tasks failed, memory ran out, or nothing more could be
    written; 130 after Ctrl-C and 143 after SIGTERM. An invalid option or a missing package ends
    the program with status 2.
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

    Later signals are ignored, while the command writes what has finished. A signal that the
    shell made this process ignore stays ignored.
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


Task = Callable[[], Any]


class Answer(NamedTuple):
    """The outcome of a task: its result, or its error as text, "" if it succeeded."""

    task: str
    result: Any
    error: str


@options
@dataclass(frozen=True, kw_only=True)
class FanOut:
    """Where joblib runs tasks, and how many run at once. A single job runs in this process.

    The result of a task does not depend on these options, as long as all randomness of the task
    comes from its arguments.
    """

    jobs: Count | None = None
    """The number of tasks that run at once (default: one per core)."""
    backend: Literal["loky", "ray"] = "loky"
    """Where tasks run: loky is this machine, and ray is the Ray cluster at RAY_ADDRESS."""

    def stream(
        self, tasks: Mapping[str, Task], title: str = "", store: KeptResults | None = None
    ) -> Iterator[tuple[str, Any]]:
        """Run tasks, and yield the name and the result of a task as soon as it has finished.

        Parameters
        ----------
        tasks
            Functions without arguments by name, such as a `functools.partial` of a function of
            a module. On a Ray cluster, all results come at the end.
        title
            Title of the progress bar; "" for no progress bar.
        store
            Results of an earlier run of the same tasks, which are yielded first. New results
            are added to the store.

        Raises
        ------
        UnfinishedError
            If tasks failed, after all other tasks have finished. The message names the failed
            tasks and their errors.
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
        """Run tasks, and yield their answers in the order in which they come."""
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
    """Ignore Ctrl-C in this process; Python allows that in its main thread alone."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)


def _attempt(name: str, task: Task) -> Answer:
    """Run a task, and return its error as text, since not every exception can be pickled."""
    try:
        return Answer(name, task(), "")
    except UsageError as error:  # The message is for the user, who needs no traceback.
        return Answer(name, None, str(error))
    except (Exception, SystemExit):
        return Answer(name, None, traceback.format_exc().strip())


def _summary(errors: Mapping[str, str], tasks: int) -> str:
    """Return a text about the errors of some of the tasks, with the first one as a whole.

    `errors` are texts by the name of the task. The last line of a text names the error.
    """
    lines = [f"{len(errors)} of {tasks} tasks failed; the other tasks have finished"]
    for name, text in list(errors.items())[:20]:
        lines.append(f"{name}: {text.splitlines()[-1]}")
    lines.append(next(iter(errors.values())))
    return "\n".join(lines)


def _prepare_worker(parent: int) -> None:
    """Make this worker process ignore Ctrl-C, and end when the process `parent` has ended.

    On Ctrl-C, which a terminal sends to all processes, the parent ends its workers.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def end_with_parent() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()


@contextmanager
def progress_bar(title: str, total: int) -> Iterator[Callable[[], None]]:
    """Show a progress bar on a terminal, and yield a function that adds a finished task.

    Nothing is shown if `title` is "". `total` is the number of tasks.
    """
    from rich.console import Console
    from rich.progress import Progress

    hidden = not (title and sys.stderr.isatty())
    with Progress(console=Console(stderr=True), transient=True, disable=hidden) as progress:
        bar = progress.add_task(title, total=total)
        yield lambda: progress.advance(bar)


def _connect_to_ray() -> None:
    """Connect to the Ray cluster at RAY_ADDRESS, by default the one on this machine.

    Ray copies the checkout to its nodes. A `UsageError` is raised if no cluster can be reached.
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
