"""List the questions and the command that answers each of them: `python -m benchmarks`."""

import re
import sys
from pathlib import Path

from benchmarks.lib.command import finish

FOLDER = Path(__file__).parent


def commands() -> dict[str, str]:
    """Return the module of each command by the command's name.

    A command is a file in this folder, or a folder with a `__main__.py`.
    """
    modules = {path.stem: f"benchmarks.{path.stem}" for path in FOLDER.glob("[a-z]*.py")}
    for path in FOLDER.glob("*/__main__.py"):
        name = path.parent.name
        modules[name] = f"benchmarks.{name}.__main__"
    return dict(sorted(modules.items()))


def questions() -> str:
    """Return the questions and their commands, from the table in README.md of this folder."""
    page = FOLDER.joinpath("README.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| \[?(.+?)(?:\]\(\S+\))? \| `(python .+?)`", page, re.MULTILINE)
    lines = [f"{question}\n    {command}" for question, command in rows]
    lines.append("\nEach command has --help.")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(finish(questions, "python -m benchmarks"))
