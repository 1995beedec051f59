"""Print a list of questions, each with the command that answers it: `python -m benchmarks`."""

import re
from pathlib import Path

FOLDER = Path(__file__).parent


def questions() -> str:
    """Return the text that `python -m benchmarks` prints: questions, each above its command.

    The questions and commands come from the table in `benchmarks/README.md`.
    """
    page = FOLDER.joinpath("README.md").read_text(encoding="utf-8")
    # A row begins with "| [QUESTION](PAGE) | `COMMAND`" or "| QUESTION | `COMMAND`".
    rows = re.findall(r"^\| \[?(.+?)(?:\]\(\S+\))? \| `(python .+?)`", page, re.MULTILINE)
    lines = [f"{question}\n    {command}" for question, command in rows]
    lines.append("\nEach command has --help.")
    return "\n".join(lines)


if __name__ == "__main__":
    print(questions())
