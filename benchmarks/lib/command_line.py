"""Run the commands `python -m benchmarks.NAME`, and end them with a sentence and a status.

Only the standard library is imported before `main` is called, so that Ctrl-C and a missing
package are answered in a sentence, too.
"""

from __future__ import annotations

import argparse
import importlib
import math
import os
import sys
import textwrap
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

    from benchmarks.lib.fan_out import FanOut

Main = Callable[[Sequence[str] | None], int]

EXTRAS = {
    **dict.fromkeys(("cyclopts", "joblib", "matplotlib", "pandas", "rich"), "compare"),
    **dict.fromkeys(("scipy", "tabulate", "tqdm"), "compare"),
    **dict.fromkeys(("moviepy", "pygame"), "render"),
    **dict.fromkeys(("h5py", "minari"), "data"),
    **dict.fromkeys(("optuna", "PIL", "stable_baselines3"), "bench"),
    "ray": "ray",
    "tclab": "test",
    "torch": "torch",
}


class UsageError(ValueError):
    """An option that does not fit. The message names it."""


def runner(
    name: str,
    *,
    module: str = "",
    width: int = 120,
    interrupted: str = "what has finished is kept.",
) -> Callable[[Sequence[str] | None], int]:
    """Return the `main` of `python -m benchmarks.<name>`.

    Parameters
    ----------
    name
        Of the command.
    module
        Prefix of the modules that it is made of; `benchmarks.<name>.` by default. In `options`
        there is a dataclass `Options`, whose docstring is the description in the help. In
        `command` there is `run`, which is called with the options and a `rich` console, does
        the work and returns the closing line. It is imported after the options were read.
    width
        Columns of the console where nothing says how wide it is.
    interrupted
        What the user is told after Ctrl-C.

    Returns
    -------
    callable
        It takes the command line without the program's name and returns the exit status: 0; 1
        if tasks failed or a file could not be written; 130 if it was interrupted. An option
        that does not fit, or a package that is missing, ends the program with status 2.
    """
    prefix = module or f"benchmarks.{name}."

    def main(arguments: Sequence[str] | None = None) -> int:
        os.environ["MPLBACKEND"] = "agg"  # pictures go to files, whatever the user's shell says
        for stream in (sys.stdout, sys.stderr):
            if hasattr(stream, "reconfigure"):
                stream.reconfigure(
                    errors="replace"
                )  # of "°C" on a console that has ASCII alone
        program = f"python -m benchmarks.{name}"
        try:
            given = sys.argv[1:] if arguments is None else arguments
            return _main(program, prefix, given, width)
        except KeyboardInterrupt:
            print(f"\nInterrupted: {interrupted}")
            return 130
        except MemoryError:
            print("There is not enough memory for so many runs or samples.", file=sys.stderr)
            return 1
        except (UsageError, ModuleNotFoundError) as error:
            print(f"{program}: error: {_sentence(error)}", file=sys.stderr)
            raise SystemExit(2) from error

    return main


def _main(program: str, prefix: str, given: Sequence[str], width: int) -> int:
    declared = importlib.import_module(f"{prefix}options").Options
    from benchmarks.lib.options import read

    options = read(declared, program, given)
    if options is None:
        return 0
    run = importlib.import_module(f"{prefix}command").run
    from rich.console import Console

    from benchmarks.lib.fan_out import CellsFailedError
    from benchmarks.lib.storage import NotWrittenError

    console = Console(
        width=None if sys.stdout.isatty() else width, highlight=False, markup=False
    )
    try:
        console.print(run(options, console))
    except (CellsFailedError, NotWrittenError) as error:
        console.print(str(error))
        return 1
    return 0


def _sentence(error: BaseException) -> str:
    """Return the message of an error, with the extra that would have what was not found."""
    cause: BaseException | None = error
    while cause is not None:
        missing = (getattr(cause, "name", None) or "").partition(".")[0]
        if isinstance(cause, ModuleNotFoundError) and missing in EXTRAS:
            return f'{missing} is not installed: pip install -e ".[{EXTRAS[missing]}]"'
        cause = cause.__cause__
    if isinstance(error, ModuleNotFoundError):
        raise error  # a fault of ours
    return str(error)


class _HelpFormatter(argparse.HelpFormatter):
    """Shows the defaults that tell something, as one would type them, and keeps names whole."""

    def _split_lines(self, text: str, width: int) -> list[str]:
        return textwrap.wrap(" ".join(text.split()), width, break_on_hyphens=False)

    def _get_help_string(self, action: argparse.Action) -> str:
        from benchmarks.lib.storage import ROOT

        text, default = action.help or "", action.default
        if default is None or default is False or default is argparse.SUPPRESS:
            return text
        if isinstance(default, list):
            default = " ".join(default)
        elif isinstance(default, Path) and default.is_relative_to(ROOT):
            default = default.relative_to(ROOT)
        return f"{text} (default: {default})" if str(default) else text


def command(
    name: str,
    description: str | None,
    add_options: Callable[[argparse.ArgumentParser], None],
    *,
    width: int = 120,
    interrupted: str = "what has finished is kept.",
) -> Callable[[Callable[[argparse.Namespace, Console], str]], Main]:
    """Make a function the `main` of `python -m benchmarks.<name>`.

    Parameters
    ----------
    name
        Of the command.
    description
        Its help text.
    add_options
        Adds its options to a parser.
    width
        Columns of the console where nothing says how wide it is.
    interrupted
        What the user is told after Ctrl-C.

    Returns
    -------
    callable
        A decorator. The function that it takes is called with the options and a console, does
        the work and returns the closing line. The function that it returns takes the command
        line without the program's name and returns the exit status: 0; 1 if cells failed or a
        file could not be written; 130 if it was interrupted. A `UsageError` ends the program
        with status 2.
    """

    def decorate(work: Callable[[argparse.Namespace, Console], str]) -> Main:
        def main(arguments: Sequence[str] | None = None) -> int:
            from rich.console import Console

            from benchmarks.lib.fan_out import CellsFailedError
            from benchmarks.lib.storage import NotWrittenError

            parser = argparse.ArgumentParser(
                prog=f"python -m benchmarks.{name}",
                description=description,
                formatter_class=_HelpFormatter,
            )
            add_options(parser)
            options = parser.parse_args(arguments)
            console = Console(
                width=None if sys.stdout.isatty() else width, highlight=False, markup=False
            )
            try:
                closing = work(options, console)
            except UsageError as error:
                parser.error(str(error))
            except (CellsFailedError, NotWrittenError) as error:
                console.print(str(error))
                return 1
            except KeyboardInterrupt:
                console.print(f"\nInterrupted: {interrupted}")
                return 130
            console.print(closing)
            return 0

        main.__doc__ = work.__doc__
        return main

    return decorate


@contextmanager
def blame(option: str) -> Iterator[None]:
    """Turn a ValueError into a `UsageError` that names an option."""
    try:
        yield
    except UsageError:
        raise
    except ValueError as error:
        raise UsageError(f"{option}: {error}") from error


def out_folder(folder: Path, option: str = "--out") -> Path:
    """Return the folder of an option, which is made; `UsageError` if it is not writable."""
    from benchmarks.lib.storage import NotWrittenError, check_folder

    try:
        check_folder(folder)
    except NotWrittenError as error:
        raise UsageError(f"{option}: {error}") from error
    return folder


def number(text: str) -> int:
    """Read a number of at least 1."""
    return _integer(text, 1)


def seed(text: str) -> int:
    """Read a number of at least 0."""
    return _integer(text, 0)


def _integer(text: str, least: int) -> int:
    allowed = f"must be an integer of at least {least}, got {text!r}"
    try:
        value = int(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(allowed) from error
    if value < least:
        raise argparse.ArgumentTypeError(allowed)
    return value


def finite(text: str) -> float:
    """Read a number that is neither infinite nor NaN."""
    return _number(text, "a finite number", lambda value: True)


def positive(text: str) -> float:
    """Read a finite number above 0."""
    return _number(text, "a number above 0", lambda value: value > 0.0)


def price(text: str) -> float:
    """Read a finite number of at least 0."""
    return _number(text, "a number of at least 0", lambda value: value >= 0.0)


def _number(text: str, what: str, fits: Callable[[float], bool]) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and fits(value)):
        raise argparse.ArgumentTypeError(f"must be {what}, got {text!r}")
    return value


def known(option: str, given: Sequence[str], names: Sequence[str]) -> list[str]:
    """Return the names that an option lists, with spaces or commas between them, each once.

    Raises
    ------
    UsageError
        If one of them is not among `names`.
    """
    chosen = [name for text in given for name in text.split(",") if name]
    for name in chosen:
        if name not in names:
            raise UsageError(f"{option}: no {name!r}; there are {', '.join(names)}")
    return list(dict.fromkeys(chosen))


def add_out(parser: argparse.ArgumentParser, folder: str) -> None:
    """Add `--out`, with the folder that is written to unless told otherwise."""
    parser.add_argument(
        "--out", type=Path, default=Path(folder), metavar="FOLDER", help="folder to write to"
    )


def add_fan_out(parser: argparse.ArgumentParser, what: str) -> None:
    """Add the options that say where and how many at once; `what` names what runs."""
    parser.add_argument(
        "--jobs",
        type=number,
        default=argparse.SUPPRESS,
        metavar="N",
        help=f"how many {what} run at once (default: as many as there are cores)",
    )
    parser.add_argument(
        "--backend",
        choices=("loky", "ray"),
        default="loky",
        help=f"where {what} run: loky, on this machine; ray, on a Ray cluster",
    )


def fan_out(options: argparse.Namespace) -> FanOut:
    """Return the fan-out that the options of `add_fan_out` ask for."""
    from benchmarks.lib.fan_out import FanOut

    with blame("--backend"):
        return FanOut(getattr(options, "jobs", None), options.backend)
