"""Run the commands `python -m benchmarks.NAME`: options in, a sentence and an exit status out.

Each command is a folder. Its `__main__.py` declares the options, a dataclass whose docstring is
the description in the help, and imports nothing heavy; its `command.py` does the work.
"""

from __future__ import annotations

import importlib
import inspect
import math
import os
import re
import signal
import sys
import tempfile
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, Any, NoReturn, TypeVar

from benchmarks.lib.storage import ROOT, UnfinishedError

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
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, ImportError):
        cause = cause.__cause__
    said = str(error)
    if cause is not None:
        words = set(re.findall(r"\w+", f"{cause.name} {cause}"))
        found = [(name, extra) for extra in EXTRAS for name in EXTRAS[extra].split()]
        missing = [each for each in found if each[0] in words]
        if missing:
            name, extra = missing[0]
            said = f'{name} is not installed: pip install -e ".[{extra}]" ({cause})'
        elif cause is error:
            raise error
    print(f"{program}: error: {said}", file=sys.stderr)
    raise SystemExit(2) from error


try:
    from cyclopts import App, CycloptsError, Parameter, Token
    from cyclopts.validators import Number
except ImportError as _missing:
    stop(_missing)

Group = TypeVar("Group")

# Decorates a dataclass whose fields are options, also when it is nested in another dataclass.
options: Callable[[type[Group]], type[Group]] = Parameter(name="*")


def _latest(_type: object, tokens: Sequence[Token]) -> tuple[str, ...]:
    """Return the names of the last occurrence of an option, which overrides earlier ones."""
    begins = [i for i, token in enumerate(tokens) if token.keyword and token.index == 0]
    return tuple(token.value for token in tokens[max(begins, default=0) :] if token.value)


def _integers(_type: object, tokens: Sequence[Token]) -> Any:
    """Read integers, and reject 2.5, which cyclopts would round."""
    try:
        found = [int(token.value) for token in tokens]
    except ValueError as error:
        given = " ".join(token.value for token in tokens)
        raise ValueError(f"must be an integer, got {given!r}") from error
    return tuple(found) if len(found) > 1 else found[0]


def integer(least: int, most: int, *, many: int = 1) -> Parameter:
    """Return a parameter for an integer within limits, or for `many` of them."""
    limits = Number(gte=least, lte=most)
    return Parameter(converter=_integers, validator=limits, n_tokens=many)


def choice(names: Collection[str], text: str) -> Parameter:
    """Return a parameter for one of `names`, which its help text lists."""
    listed = ", ".join(names)

    def convert(_: object, tokens: Sequence[Token]) -> str:
        if tokens[0].value not in names:
            raise ValueError(f"no {tokens[0].value!r}; there are {listed}")
        return tokens[0].value

    return Parameter(converter=convert, n_tokens=1, help=f"{text}: {listed}.")


Count = Annotated[int, integer(1, 1_000_000_000)]
Runs = Annotated[int, integer(1, 100_000)]
Seed = Annotated[int, integer(0, 2**63)]
Finite = Annotated[float, Parameter(validator=Number(gt=-math.inf, lt=math.inf))]
Positive = Annotated[float, Parameter(validator=Number(gt=0.0, lt=math.inf))]
Names = Annotated[tuple[str, ...], Parameter(converter=_latest, consume_multiple=True)]
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
        why = "it is no folder" if folder.exists() and not folder.is_dir() else error.strerror
        raise UsageError(f"{option}: {folder} cannot be written to: {why}") from error
    return folder


def known(option: str, given: Sequence[str], names: Sequence[str]) -> list[str]:
    """Return the names that an option lists, separated by spaces or commas, each once.

    A name that is not in `names` raises `UsageError`.
    """
    chosen = [name for text in given for name in text.split(",") if name]
    for name in chosen:
        if name not in names:
            raise UsageError(f"{option}: no {name!r}; there are {', '.join(names)}")
    return list(dict.fromkeys(chosen))


def _typed(default: object) -> str | None:
    """Return a default as a user would type it; None if it is not worth showing."""
    if isinstance(default, tuple):
        default = " ".join(map(str, default))
    elif isinstance(default, Path) and default.is_relative_to(ROOT):
        default = default.relative_to(ROOT)
    return None if default is None or default is False or default == "" else str(default)


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
        name = error.argument.name if error.argument else ""
        text = " ".join(str(error).split()).removeprefix("Invalid value for ")
        raise UsageError(text if name in text else f"{name}: {text}") from error
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
        before = None
        with suppress(ValueError):  # not in the main thread
            before = signal.signal(signal.SIGTERM, _interrupt)
        try:
            given = sys.argv[1:] if arguments is None else arguments
            return _run(declared, program, work, given, width)
        except KeyboardInterrupt as stopped:
            print(f"\nInterrupted: {interrupted}")
            return 128 + (stopped.args[0] if stopped.args else signal.SIGINT)
        except MemoryError:
            print("There is not enough memory for so many runs or samples.", file=sys.stderr)
            return 1
        except (UsageError, ImportError) as error:
            stop(error, program)
        finally:
            if before is not None:
                signal.signal(signal.SIGTERM, before)

    return main


def _interrupt(number: int, _frame: object) -> NoReturn:
    """End as after Ctrl-C, so that what has finished is reported."""
    raise KeyboardInterrupt(number)


def _run(
    declared: type[Group], program: str, work: str, given: Sequence[str], width: int
) -> int:
    chosen = read(declared, program, given)
    if chosen is None:
        return 0
    execute = importlib.import_module(work).execute
    from rich.console import Console

    console = Console(
        width=None if sys.stdout.isatty() else width, highlight=False, markup=False
    )
    try:
        console.print(execute(chosen, console))
    except UnfinishedError as error:
        console.print(str(error))
        return 1
    except SystemExit as left:
        raise UsageError(f"a controller called sys.exit({left.code!r})") from left
    return 0
