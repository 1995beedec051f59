"""Make the command `python -m benchmarks.NAME` from a dataclass of options and a function.

The module of a command defines a dataclass `Options` and a function `work`. The docstrings of
`Options` are the text of `--help`. The function `work` takes an instance of `Options`, writes
the results and returns the last line to print. Packages that are slow to import are imported
within `work`, so that `--help` is quick. The line `main = command("NAME", Options, work)` makes
the command.
"""

import errno
import inspect
import math
import os
import shlex
import signal
import sys
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, NoReturn, TypeVar

from benchmarks.lib.errors import UnfinishedError, UsageError, stop
from benchmarks.lib.provenance import COMMAND_LINE

try:
    from cyclopts import App, CycloptsError
    from cyclopts import Parameter as Parameter  # The commands import it from this module.
    from cyclopts.validators import Number
except ImportError as error:
    stop("python -m benchmarks", error)

Declared = TypeVar("Declared")  # a dataclass whose fields are options of a command

# A decorator of dataclasses: the fields become options of a command, `--field VALUE`, also if
# the dataclass is the type of a field of another dataclass.
options: Callable[[type[Declared]], type[Declared]] = Parameter(name="*")

# System errors after which nothing more can be written: the disk is full, the quota or the
# largest size of a file is exceeded, or the reader of a pipe has ended.
DISK_FULL_OR_PIPE_CLOSED = errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EPIPE


def _to_integer(_type: object, tokens: Sequence[Any]) -> int:
    """Return the word that a user typed, `tokens[0].value`, as an integer.

    A ValueError is raised if the word is not a whole number. Without this converter, cyclopts
    would read 2.5 as 2.
    """
    word = tokens[0].value
    try:
        return int(word)
    except ValueError as error:
        raise ValueError(f"must be a whole number, got {word}") from error


def _integers(least: int, most: int) -> Parameter:
    """Return an annotation of an option that accepts integers from `least` to `most` only."""
    allowed = Number(gte=least, lte=most)
    return Parameter(converter=_to_integer, n_tokens=1, validator=allowed)


# Types of options. No useful value exceeds the limits of the numbers.
Count = Annotated[int, _integers(1, 1_000_000_000)]
Runs = Annotated[int, _integers(1, 100_000)]
Seed = Annotated[int, _integers(0, 2**63)]
Finite = Annotated[float, Parameter(validator=Number(gt=-math.inf, lt=math.inf))]
Names = Annotated[tuple[str, ...], Parameter(consume_multiple=True)]
Folder = Annotated[Path, Parameter(help="The folder to write to.")]


@contextmanager
def blame(option: str) -> Iterator[None]:
    """Turn a ValueError in the block of a `with` statement into a `UsageError`.

    The message begins with `option`, the name of an option such as "--device".
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


def read(declared: type[Declared], program: str, words: Sequence[str]) -> Declared | None:
    """Convert the words of a command line to options, or print the help after `--help`.

    The result is an instance of the dataclass `declared`, or None if the help was printed. A
    `UsageError` is raised if an option is unknown or has an invalid value.

    Parameters
    ----------
    declared
        The dataclass of options.
    program
        The command, such as "python -m benchmarks.compare", for the help.
    words
        The words of the command line after the command.
    """
    defaults = Parameter(negative=(), allow_repeating=True, show_default=_as_typed)
    app = App(
        name=program,
        help=inspect.getdoc(declared),
        version_flags=[],
        default_parameter=defaults,
        result_action="return_value",
    )
    app["--help"].show = False
    app.default(declared)
    try:
        chosen = app(list(words), exit_on_error=False, print_error=False)
    except CycloptsError as error:
        one_line = " ".join(str(error).split())
        raise UsageError(one_line) from error
    return chosen if isinstance(chosen, declared) else None


def _as_typed(default: object) -> str | None:
    """Return the default of an option as a user would type it, for the text of `--help`.

    The result is None, and the help shows no default, for an option that is off or empty by
    default.
    """
    if default is None or default is False or default == ():
        return None
    if isinstance(default, tuple):
        return " ".join(default)
    return str(default)


def command(
    name: str, declared: type[Declared], work: Callable[[Declared], str]
) -> Callable[..., int]:
    """Return the function `main` of the command `python -m benchmarks.NAME`.

    `main(words)` takes the words of a command line after the command, by default the words with
    which this process was started. The function `main` reads the options, calls `work`, and
    returns the exit status of the command, as `run_program` does.

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

    def main(words: Sequence[str] | None = None) -> int:
        if words is None:  # This process runs nothing but the command.
            words = sys.argv[1:]
            _interrupt_on_signals()

        def read_and_work() -> str:
            chosen = read(declared, program, words)
            return "" if chosen is None else work(chosen)

        earlier = COMMAND_LINE.set(shlex.join([*program.split(), *words]))
        try:
            return run_program(program, read_and_work)
        finally:
            COMMAND_LINE.reset(earlier)

    return main


def run_program(program: str, work: Callable[[], str]) -> int:
    """Call `work`, print the line that it returns, and return the exit status of a command.

    The status is 0 for success; 1 if tasks failed or nothing more could be written; 130 after
    Ctrl-C; and 143 after SIGTERM. After a `UsageError`, or if a package is missing, this
    process ends with status 2.

    Parameters
    ----------
    program
        The command, such as "python -m benchmarks.compare", which begins error messages.
    work
        Does the work, and returns the last line to print, or "".
    """
    try:
        last_line = work()
        if last_line:
            print(last_line, flush=True)
        return 0
    except (UsageError, ImportError) as error:
        stop(program, error)
    except KeyboardInterrupt as interrupt:
        print("\nInterrupted.", flush=True)
        # Without a handler of this module, Python does not say which signal it was.
        number = interrupt.args[0] if interrupt.args else signal.SIGINT
        return 128 + int(number)
    except UnfinishedError as error:
        print(error)
    except OSError as error:
        if error.errno not in DISK_FULL_OR_PIPE_CLOSED:
            raise
        print(f"{program}: nothing more can be written: {error.strerror}", file=sys.stderr)
        # Python writes the rest of its output at exit, which would raise the error again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 1


def _interrupt_on_signals() -> None:
    """Make the first Ctrl-C or SIGTERM raise a KeyboardInterrupt in this process.

    A signal that this process has ignored since its start stays ignored: a shell starts
    commands in the background with Ctrl-C ignored.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _interrupt)


def _interrupt(number: int, _frame: object) -> NoReturn:
    """Raise a KeyboardInterrupt whose argument is the signal `number`.

    Later signals are ignored, so that the command can write its finished results.
    """
    for later in (signal.SIGINT, signal.SIGTERM):
        signal.signal(later, signal.SIG_IGN)
    raise KeyboardInterrupt(number)
