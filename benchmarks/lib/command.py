"""Make the command `python -m benchmarks.NAME` from a dataclass of options and a function.

The module `benchmarks.NAME` defines a dataclass `Options`, whose docstrings are the text of
`--help`, and a function `work(options)`, which writes results and returns the last line to
print. The line `main = command("NAME", Options, work)` makes the command. Slow packages such as
pandas are imported inside the function `work`, so that `--help` is quick.
"""

import errno
import inspect
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

    The package cyclopts by itself would convert the word "2.5" to the integer 2.
    """
    word = tokens[0].value
    try:
        return int(word)
    except ValueError as error:
        raise ValueError(f"must be a whole number, got {word}") from error


def _integers(least: int, most: int) -> Parameter:
    """Return the annotation of an option whose value is an integer from `least` to `most`."""
    allowed = Number(gte=least, lte=most)
    return Parameter(converter=_to_integer, n_tokens=1, validator=allowed)


# Types of options. The upper limits of the integers are far above all useful values.
Count = Annotated[int, _integers(1, 1_000_000_000)]
Runs = Annotated[int, _integers(1, 100_000)]
Seed = Annotated[int, _integers(0, 2**63)]
Names = Annotated[tuple[str, ...], Parameter(consume_multiple=True)]
Folder = Annotated[Path, Parameter(help="The folder to write to.")]


@contextmanager
def blame(option: str) -> Iterator[None]:
    """Turn a ValueError in the block of a `with` statement into a `UsageError`.

    The message of the `UsageError` begins with `option`, the name of a command-line option such
    as "--device".
    """
    try:
        yield
    except ValueError as error:
        raise UsageError(f"{option}: {error}") from error


def known(option: str, listed: Sequence[str], names: Collection[str]) -> list[str]:
    """Return the names that a user typed after an option, in order and without repetitions.

    Parameters
    ----------
    option
        Name of the command-line option for the error message, such as "--scenarios".
    listed
        Names that the user typed.
    names
        All valid names.

    Raises
    ------
    UsageError
        If a name in `listed` is not in `names`.
    """
    for name in listed:
        if name not in names:
            raise UsageError(f"{option}: there is no {name!r}; choose from {', '.join(names)}")
    return list(dict.fromkeys(listed))


def read(declared: type[Declared], program: str, words: Sequence[str]) -> Declared | None:
    """Convert the words of a command line to an instance of the dataclass `declared`.

    If the user typed `--help`, the help is printed and the result is None.

    Parameters
    ----------
    declared
        Dataclass whose fields are the options of the command.
    program
        Name of the command in the help, such as "python -m benchmarks.compare".
    words
        Words that the user typed after the name of the command.

    Raises
    ------
    UsageError
        If an option in `words` is unknown or has an invalid value.
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

    The result is None, so that `--help` shows no default, if `default` is None, False or ().
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

    `main(words)` converts the command-line words `words` (default: `sys.argv[1:]`) to options,
    calls `work` with the options, and returns the exit status that `run_program` describes.

    Parameters
    ----------
    name
        Name of the command, such as "compare".
    declared
        Dataclass whose fields are the options of the command.
    work
        Function that takes an instance of `declared`, does the work of the command, and returns
        the last line to print.
    """
    program = f"python -m benchmarks.{name}"

    def main(words: Sequence[str] | None = None) -> int:
        if words is None:  # The process was started for this command only.
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
    """Call `work`, print the text that `work` returns, and return the command's exit status.

    The exit status is 0 for success; 1 if tasks failed, the disk is full or the output pipe is
    closed; 130 after Ctrl-C; and 143 after SIGTERM. After a `UsageError`, or if a Python
    package is missing, the process ends with the exit status 2. Messages on the standard error
    stream begin with `program`, such as "python -m benchmarks.compare".
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
        # `args` is empty if Python's own handler of Ctrl-C has raised the interrupt.
        number = interrupt.args[0] if interrupt.args else signal.SIGINT
        return 128 + int(number)
    except UnfinishedError as error:
        print(error)
    except OSError as error:
        if error.errno not in DISK_FULL_OR_PIPE_CLOSED:
            raise
        print(f"{program}: nothing more can be written: {error.strerror}", file=sys.stderr)
        # At exit, Python writes the buffered output, which would raise the same error again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 1


def _interrupt_on_signals() -> None:
    """Make the first Ctrl-C or SIGTERM raise a KeyboardInterrupt in this process.

    A process that a shell has started in the background continues to ignore Ctrl-C.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _interrupt)


def _interrupt(number: int, _frame: object) -> NoReturn:
    """Raise a KeyboardInterrupt whose argument is the signal `number`.

    After the first Ctrl-C or SIGTERM, later signals are ignored, so that the command has time
    to write finished results.
    """
    for later in (signal.SIGINT, signal.SIGTERM):
        signal.signal(later, signal.SIG_IGN)
    raise KeyboardInterrupt(number)
