"""What command lines have in common."""

from __future__ import annotations

import argparse
import sys

from rich.console import Console


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
