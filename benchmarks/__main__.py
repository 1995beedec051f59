"""List the questions, and the command that answers each: `python -m benchmarks`."""

from __future__ import annotations

import re
import sys
from pathlib import Path

from benchmarks.lib.commands import sentence

MAP = Path(__file__).with_name("README.md")


def main() -> int:
    """Print the map: the table of questions at the top of the page beside this file."""
    try:
        import pandas as pd
        from rich.console import Console

        from benchmarks.lib.tables import on_screen
    except ImportError as error:
        print(f"python -m benchmarks: error: {sentence(error)}", file=sys.stderr)
        return 2
    page = MAP.read_text(encoding="utf-8")
    plain = re.sub(r"\[([^]]*)\]\([^)]*\)|`", r"\1", page)  # without links and code
    lines = [line for line in plain.splitlines() if line.startswith("|")]
    rows = [[cell.strip() for cell in line[1:-1].split("|")] for line in lines]
    header, _, *questions = rows
    Console(width=None if sys.stdout.isatty() else 150, highlight=False, markup=False).print(
        on_screen(pd.DataFrame(questions, columns=header)),
        "Each command has --help.",
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
