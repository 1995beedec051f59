"""What the commands share: options, how they run, and how they end."""

from __future__ import annotations

import argparse
import math
import sys
import textwrap
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console

from benchmarks.lib.fan_out import BACKENDS, CellsFailedError, FanOut
from benchmarks.lib.storage import ROOT, NotWrittenError, check_folder

Main = Callable[[Sequence[str] | None], int]


class UsageError(ValueError):
    """An option that does not fit. The message names it."""


class _HelpFormatter(argparse.HelpFormatter):
    """Shows the defaults that tell something, as one would type them, and keeps names whole."""

    def _split_lines(self, text: str, width: int) -> list[str]:
        return textwrap.wrap(" ".join(text.split()), width, break_on_hyphens=False)

    def _get_help_string(self, action: argparse.Action) -> str:
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
        choices=BACKENDS,
        default=BACKENDS[0],
        help=f"where {what} run: loky, on this machine; ray, on a Ray cluster",
    )


def fan_out(options: argparse.Namespace) -> FanOut:
    """Return the fan-out that the options of `add_fan_out` ask for."""
    with blame("--backend"):
        return FanOut(getattr(options, "jobs", None), options.backend)
