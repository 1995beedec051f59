"""Make the command `python -m benchmarks.NAME` from a dataclass of options and a function.

The module `benchmarks.NAME` defines a dataclass `Options`, whose docstrings are the text of
`--help`, and a function `work(options)`, which writes results and then prints them. The line
`main = command("NAME", Options, work)` makes the command. Slow packages such as pandas are
imported inside the function `work`, so that `--help` is quick.
"""

import inspect
import os
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

try:
    from cyclopts import App, CycloptsError
    from cyclopts import Parameter as Parameter  # The commands import it from this module.
    from cyclopts.types import NonNegativeInt, PositiveInt
except ModuleNotFoundError as error:
    raise SystemExit(f'{error}: pip install -e ".[bench]"') from error

Value = TypeVar("Value")
Declared = TypeVar("Declared")  # a dataclass whose fields are options of a command

# A decorator of dataclasses: the fields become options of a command, `--field VALUE`, also if
# the dataclass is the type of a field of another dataclass.
options: Callable[[type[Declared]], type[Declared]] = Parameter(name="*")

# The extra of this project that installs a package, for packages that are not in `bench`.
EXTRAS = {"ray": "ray"}


def _whole(_: type, tokens: Sequence[Any]) -> int:
    """Return the integer that a user typed. Cyclopts would round 2.5."""
    return int(tokens[0].value)


# Types of options.
Count = Annotated[PositiveInt, Parameter(converter=_whole)]
Seed = Annotated[NonNegativeInt, Parameter(converter=_whole)]
Names = Annotated[tuple[str, ...], Parameter(consume_multiple=True)]
_OUT_HELP = "The folder to write to, new or empty (default: the next free one in results/)."
Folder = Annotated[Path | None, Parameter(help=_OUT_HELP)]


class CommandError(Exception):
    """An error that a command reports by its message, without a traceback.

    Parameters
    ----------
    message
        What is wrong, with the value and what is allowed.
    status
        Exit status of the command: 1 if tasks failed, 2 if the command line or a file that it
        names is wrong, and 130 after Ctrl-C or SIGTERM.
    """

    def __init__(self, message: str, status: int = 2) -> None:
        super().__init__(message)
        self.status = status


def choose(
    option: str, names: Sequence[str], available: Mapping[str, Value]
) -> dict[str, Value]:
    """Return the values that a user chose by name, in the order of the names.

    Parameters
    ----------
    option
        Name of the command-line option for the error message, such as "--scenarios".
    names
        Names that the user typed.
    available
        All values by name.

    Raises
    ------
    CommandError
        If a name in `names` is not in `available`.
    """
    try:
        return {name: available[name] for name in names}
    except KeyError as error:
        choices = ", ".join(available)
        raise CommandError(f"{option}: there is no {error}; choose from {choices}") from error


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
    CommandError
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
    app.default(declared)  # which Cyclopts calls with the options, by their names
    try:
        chosen = app(list(words), exit_on_error=False, print_error=False)
    except CycloptsError as error:
        raise CommandError(" ".join(str(error).split())) from error
    return chosen if isinstance(chosen, declared) else None


def _as_typed(default: Any) -> str | None:
    """Return the default of an option as a user would type it; None if there is none."""
    if isinstance(default, tuple):
        return " ".join(default) or None
    return None if default is None or default is False else str(default)


def command(
    name: str, declared: type[Declared], work: Callable[[Declared], object]
) -> Callable[..., int]:
    """Return the function `main` of the command `python -m benchmarks.NAME`.

    `main(words)` converts the command-line words `words` (default: `sys.argv[1:]`) to options,
    calls `work` with the options, and returns the exit status: 0 for success; 1 if tasks
    failed, or if a file could not be read or written; 2 if an option is wrong or a Python
    package is missing; and 130 after Ctrl-C or SIGTERM. An error message on the standard error
    stream begins with the name of the command.

    Parameters
    ----------
    name
        Name of the command, such as "compare".
    declared
        Dataclass whose fields are the options of the command.
    work
        Function that takes an instance of `declared`, and does the work of the command.
    """
    program = f"python -m benchmarks.{name}"

    def main(words: Sequence[str] | None = None) -> int:
        if words is None:  # The process was started for this command only.
            words = sys.argv[1:]
            _ignore_surroundings()
        try:
            chosen = read(declared, program, words)
            if chosen is not None:  # None after --help
                work(chosen)
            return 0
        except CommandError as error:
            message, status = str(error), error.status
        except ModuleNotFoundError as error:
            extra = EXTRAS.get(str(error.name), "bench")
            message, status = f'{error}: pip install -e ".[{extra}]"', 2
        except OSError as error:
            message, status = str(error), 1
        except KeyboardInterrupt:
            message, status = "interrupted", 130
        print(f"{program}: {message}", file=sys.stderr)
        return status

    return main


def _ignore_surroundings() -> None:
    """Make a command independent of the notebook, terminal or scheduler that calls it."""
    # A scheduler stops a command by SIGTERM, which else would leave processes that run tasks.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    # A notebook names a backend that need not be installed here, which matplotlib refuses.
    os.environ["MPLBACKEND"] = "agg"
    # A terminal without Unicode shows "?" in place of a degree sign.
    sys.stdout.reconfigure(errors="replace")  # type: ignore[union-attr]
