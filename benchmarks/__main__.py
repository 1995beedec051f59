"""List the questions and the command that answers each: `python -m benchmarks`."""

from __future__ import annotations

import difflib
import importlib
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks.lib.command import cut_off, stop

FOLDER = Path(__file__).parent


def commands() -> dict[str, str]:
    """Return the module of each command: of a file in this folder, or a `__main__` below it."""
    files = {path.stem: f"benchmarks.{path.stem}" for path in FOLDER.glob("[a-z]*.py")}
    for path in FOLDER.glob("*/**/__main__.py"):
        name = ".".join(path.parent.relative_to(FOLDER).parts)
        files[name] = f"benchmarks.{name}.__main__"
    return dict(sorted(files.items()))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command that is named, or print the questions in README.md in this folder."""
    given = [*(sys.argv[1:] if arguments is None else arguments)]
    modules, name = commands(), given[0] if given else "--help"
    if name in modules:
        run = importlib.import_module(modules[name]).main
        if arguments is not None:
            return int(run(given[1:]))
        sys.argv = [f"benchmarks.{name}", *given[1:]]  # the command is the program
        return int(run())
    if name not in ("-h", "--help"):
        close = difflib.get_close_matches(name, modules, n=1) or modules
        stop(ValueError(f"no command {name!r}; there is {', '.join(close)}"))
    page = FOLDER.joinpath("README.md").read_text(encoding="utf-8")
    try:
        for row in page[page.index("|") :].partition("\n\n")[0].splitlines()[2:]:
            question, command, _ = (cell.strip(" `") for cell in row.strip("|").split("|"))
            print(f"{question.lstrip('[').partition('](')[0]}\n    {command}")
        print("\nEach command has --help.", flush=True)
    except OSError as error:
        return cut_off(error, "python -m benchmarks")
    return 0


if __name__ == "__main__":
    sys.exit(main())
