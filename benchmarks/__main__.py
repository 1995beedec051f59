"""List the questions and the command that answers each: `python -m benchmarks`."""

from __future__ import annotations

import difflib
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks.lib.command import stop

FOLDER = Path(__file__).parent
COMMANDS = sorted(
    ".".join(path.parent.relative_to(FOLDER).parts) for path in FOLDER.glob("*/**/__main__.py")
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table of questions from README.md in this folder."""
    for name in sys.argv[1:] if arguments is None else arguments:
        close = difflib.get_close_matches(name, COMMANDS, n=1)
        meant = f"did you mean benchmarks.{close[0]}?" if close else "none is like it"
        stop(ValueError(f"no command {name!r}; {meant}"))
    try:
        from rich.console import Console
        from rich.markdown import Markdown
    except ImportError as error:
        stop(error)
    page = FOLDER.joinpath("README.md").read_text(encoding="utf-8")
    table = page[page.index("|") :].partition("\n\n")[0]  # the first one
    console = Console(width=None if sys.stdout.isatty() else 150, highlight=False)
    console.print(Markdown(table), "Each command has --help.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
