"""Print a list of questions, each with the command that answers it: `python -m benchmarks`."""

import re
import sys
from pathlib import Path

from benchmarks.lib.command import run_program

FOLDER = Path(__file__).parent


def commands() -> dict[str, str]:
    """Return the module of each command `python -m benchmarks.NAME` by the command's name.

    The module of a command is a file in the folder `benchmarks`, or the `__main__.py` of a
    folder in `benchmarks`.
    """
    modules = {path.stem: f"benchmarks.{path.stem}" for path in FOLDER.glob("[a-z]*.py")}
    for path in FOLDER.glob("*/__main__.py"):
        name = path.parent.name
        modules[name] = f"benchmarks.{name}.__main__"
    return dict(sorted(modules.items()))


def questions() -> str:
    """Return the text that `python -m benchmarks` prints: questions, each above its command.

    The questions and commands come from the table in `benchmarks/README.md`.
    """
    page = FOLDER.joinpath("README.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| \[?(.+?)(?:\]\(\S+\))? \| `(python .+?)`", page, re.MULTILINE)
    lines = [f"{question}\n    {command}" for question, command in rows]
    lines.append("\nEach command has --help.")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(run_program("python -m benchmarks", questions))
