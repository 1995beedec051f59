"""List the questions and the command that answers each: `python -m benchmarks`."""

import difflib
import importlib
import re
import sys
from collections.abc import Collection, Sequence
from pathlib import Path

from benchmarks.lib.command import finish
from benchmarks.lib.errors import UsageError

FOLDER = Path(__file__).parent


def commands() -> dict[str, str]:
    """Return the module of each command: of a file in this folder, or a `__main__` below it."""
    files = {path.stem: f"benchmarks.{path.stem}" for path in FOLDER.glob("[a-z]*.py")}
    for path in FOLDER.glob("*/__main__.py"):
        files[path.parent.name] = f"benchmarks.{path.parent.name}.__main__"
    return dict(sorted(files.items()))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command that is named, or print the questions in README.md in this folder."""
    given = [*(sys.argv[1:] if arguments is None else arguments)]
    modules, name = commands(), given[0] if given else "--help"
    if name not in modules:
        return finish(lambda: questions(name, modules), "python -m benchmarks")
    run = importlib.import_module(modules[name]).main
    if arguments is not None:
        return int(run(given[1:]))
    sys.argv = [f"benchmarks.{name}", *given[1:]]  # the command is the program
    return int(run())


def questions(name: str, known: Collection[str]) -> str:
    """Return the questions and their commands, as in README.md, for --help."""
    if name not in ("-h", "--help"):
        close = difflib.get_close_matches(name, known, n=1) or known
        raise UsageError(f"no command {name!r}; there is {', '.join(close)}")
    page = FOLDER.joinpath("README.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| \[?(.+?)(?:\]\(\S+\))? \| `(python .+?)`", page, re.MULTILINE)
    lines = [f"{question}\n    {command}" for question, command in rows]
    return "\n".join([*lines, "\nEach command has --help."])


if __name__ == "__main__":
    sys.exit(main())
