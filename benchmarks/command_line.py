"""What command lines have in common."""

from __future__ import annotations

import argparse
import sys

from rich.console import Console

from benchmarks.fan_out import BACKENDS, FanOut


def number(text: str) -> int:
    """Read a number of at least 1; argparse shows this function's name in its complaints."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1, got {value}")
    return value


def seed(text: str) -> int:
    """Read a number of at least 0, as `number` does."""
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"must be at least 0, got {value}")
    return value


def parser(name: str, description: str | None) -> argparse.ArgumentParser:
    """Return a parser for `python -m benchmarks.<name>` that shows defaults in its help."""
    return argparse.ArgumentParser(
        prog=f"python -m benchmarks.{name}",
        description=description,
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )


def console(width: int = 120) -> Console:
    """Return a console as wide as the terminal, or as given where nothing says how wide."""
    return Console(width=None if sys.stdout.isatty() else width, highlight=False, markup=False)


def add_fan_out(parser: argparse.ArgumentParser, what: str) -> None:
    """Add the options that say where and how many at once; `what` names what is run."""
    parser.add_argument(
        "--jobs",
        type=number,
        default=argparse.SUPPRESS,
        help=f"how many {what} to run at once (default: as many as there are cores)",
    )
    parser.add_argument(
        "--backend",
        choices=BACKENDS,
        default=BACKENDS[0],
        help=f"where to run {what}: loky, on this machine; ray, on a Ray cluster",
    )


def fan_out(options: argparse.Namespace) -> FanOut:
    """Return the fan-out that the options of `add_fan_out` ask for, or raise ValueError."""
    return FanOut(getattr(options, "jobs", None), options.backend)
