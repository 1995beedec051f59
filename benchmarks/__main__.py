"""List the questions and the command that answers each: `python -m benchmarks`."""

from __future__ import annotations

import sys
from pathlib import Path

from benchmarks.lib.commands import sentence

MAP = Path(__file__).with_name("README.md")


def main() -> int:
    """Print the table of questions from README.md in this folder."""
    try:
        from rich.console import Console
        from rich.markdown import Markdown
    except ImportError as error:
        print(f"python -m benchmarks: error: {sentence(error)}", file=sys.stderr)
        return 2
    page = MAP.read_text(encoding="utf-8")
    table = "\n".join(line for line in page.splitlines() if line.startswith("|"))
    console = Console(width=None if sys.stdout.isatty() else 150, highlight=False)
    console.print(Markdown(table), "Each command has --help.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
