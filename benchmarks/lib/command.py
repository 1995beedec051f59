"""Run the commands `python -m benchmarks.NAME`: options in, a sentence and an exit status out.

Each command is a folder. Its `__main__.py` declares the options, a dataclass whose docstring is
the description in the help, and imports nothing heavy; its `command.py` does the work.
"""

from __future__ import annotations

import importlib
import inspect
import math
import os
import signal
import sys
import tempfile
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, Any, NoReturn, TypeVar

from benchmarks.lib.storage import UnfinishedError

EXTRAS = {
    "compare": "cyclopts joblib matplotlib pandas rich scipy tabulate tqdm",
    "render": "pygame",
    "data": "h5py minari",
    "bench": "optuna PIL stable_baselines3",
    "ray": "ray",
    "torch": "torch",
}


class UsageError(ValueError):
    """An invalid option, named by the message."""


def stop(error: BaseException, program: str = "python -m benchmarks") -> NoReturn:
    """Print an error in a sentence and end the program with status 2.

    If a package is missing, the sentence names the extra that installs it. An import that fails
    for another reason is a bug, and is raised.
    """
    cause, said = error, str(error)
    while cause.__cause__ is not None:
        cause = cause.__cause__
    name = (cause.name or "").partition(".")[0] if isinstance(cause, ImportError) else ""
    for extra, packages in EXTRAS.items():
        if name in packages.split():
            said = f'{name} is not installed: pip install -e ".[{extra}]" ({cause})'
            break
    else:
        if isinstance(error, ImportError):
            raise error
    print(f"{program}: error: {said}", file=sys.stderr)
    raise SystemExit(2) from error


try:
    from cyclopts import App, CycloptsError, MissingArgumentError, Parameter
    from cyclopts.validators import Number
except ImportError as _missing:
    stop(_missing)

Group = TypeVar("Group")

# Decorates a dataclass whose fields are options, also when it is nested in another dataclass.
options: Callable[[type[Group]], type[Group]] = Parameter(name="*")


def _integer(_type: object, tokens: Sequence[Any]) -> int:
    """Read an integer, and reject 2.5, which cyclopts would round."""
    return int(tokens[0].value)


def _integers(least: int, most: int) -> Parameter:
    return Parameter(converter=_integer, n_tokens=1, validator=Number(gte=least, lte=most))


Count = Annotated[int, _integers(1, 1_000_000_000)]
Runs = Annotated[int, _integers(1, 100_000)]
Seed = Annotated[int, _integers(0, 2**63)]
Finite = Annotated[float, Parameter(validator=Number(gt=-math.inf, lt=math.inf))]
Positive = Annotated[float, Parameter(validator=Number(gt=0.0, lt=math.inf))]
Names = Annotated[tuple[str, ...], Parameter(consume_multiple=True)]
Repeated = tuple[str, ...]
Folder = Annotated[Path, Parameter(help="Folder to write to.")]


@contextmanager
def blame(option: str) -> Iterator[None]:
    """Turn a ValueError into a `UsageError` that names the option."""
    try:
        yield
    except UsageError:
        raise
    except ValueError as error:
        raise UsageError(f"{option}: {error}") from error


def out_folder(folder: Path, option: str = "--out") -> Path:
    """Create and return the folder of an option; `UsageError` if it is not writable."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as probe:
            probe.write(b"x")
    except OSError as error:
        why = "it is no folder" if folder.is_file() else error.strerror
        raise UsageError(f"{option}: {folder} cannot be written to: {why}") from error
    return folder


def known(option: str, given: Sequence[str], names: Collection[str]) -> list[str]:
    """Return the names that an option lists, each once; `UsageError` if one is not known."""
    for name in given:
        if name not in names:
            raise UsageError(f"{option}: no {name!r}; there are {', '.join(names)}")
    return list(dict.fromkeys(given))


def _typed(default: object) -> str | None:
    """Return a default as a user would type it; None if it is not worth showing."""
    if default is None or default is False or default == ():
        return None
    return " ".join(map(str, default)) if isinstance(default, tuple) else str(default)


def read(declared: type[Group], program: str, given: Sequence[str]) -> Group | None:
    """Read a program's command line into a dataclass of options.

    With --help, the help is printed and None is returned. An invalid option raises
    `UsageError`.
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
        found = app(list(given), exit_on_error=False, print_error=False)
    except CycloptsError as error:
        text = " ".join(str(error).split())
        if isinstance(error, MissingArgumentError) and error.argument:
            choices = error.argument.get_choices()
            text = f"{text[:-1]}, one of {', '.join(choices)}." if choices else text
        raise UsageError(text) from error
    return found if isinstance(found, declared) else None


def command(
    declared: type[Group],
    work: str,
    *,
    width: int = 120,
    interrupted: str = "what has finished is kept; the same command goes on from there.",
) -> Callable[[Sequence[str] | None], int]:
    """Return the `main` of a command.

    It takes the command line without the program's name and returns the exit status: 0 for
    success; 1 if tasks failed, a file could not be written or memory ran out; 130 after Ctrl-C
    and 143 after SIGTERM. An invalid option or a missing package ends the program with 2.

    Parameters
    ----------
    declared
        Dataclass of the options.
    work
        Module whose function `execute(options, console)` does the work, prints on the `rich`
        console and returns the closing line. It is imported once the options are read.
    width
        Width of the console, in columns, if the output is not a terminal.
    interrupted
        Message after Ctrl-C.
    """
    program = f"python -m {work.rpartition('.')[0]}"

    def main(arguments: Sequence[str] | None = None) -> int:
        os.environ["MPLBACKEND"] = "agg"  # figures go to files, whatever the shell has set
        for stream in (sys.stdout, sys.stderr):
            if hasattr(stream, "reconfigure"):
                stream.reconfigure(errors="replace")  # for "°C" on an ASCII terminal
        with suppress(ValueError):  # not in the main thread
            signal.signal(signal.SIGTERM, _interrupt)
        try:
            given = sys.argv[1:] if arguments is None else arguments
            if (chosen := read(declared, program, given)) is not None:
                from rich.console import Console

                columns = None if sys.stdout.isatty() else width
                console = Console(width=columns, highlight=False, markup=False)
                console.print(importlib.import_module(work).execute(chosen, console))
        except KeyboardInterrupt as stopped:
            print(f"\nInterrupted: {interrupted}")
            return 128 + (stopped.args[0] if stopped.args else signal.SIGINT)
        except (UnfinishedError, MemoryError) as error:
            print(str(error) or "There is not enough memory for so many runs or samples.")
            return 1
        except (UsageError, ImportError) as error:
            stop(error, program)
        return 0

    return main


def _interrupt(number: int, _frame: object) -> NoReturn:
    """End as after Ctrl-C, so that what has finished is reported."""
    raise KeyboardInterrupt(number)
