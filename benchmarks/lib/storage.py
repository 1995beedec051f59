"""Write texts and tables to files, with the same bytes on all systems."""

import json
import re
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.lib.errors import UsageError


def write_text(path: Path, text: str) -> None:
    """Write a text file, in UTF-8 and with the line ends of Unix."""
    path.write_text(text, encoding="utf-8", newline="\n")


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file; values that JSON does not know, such as paths, are written as text."""
    write_text(path, json.dumps(value, indent=2, default=str) + "\n")


def write_csv(path: Path, table: Any) -> None:
    """Write a table of pandas as a CSV file without its index."""
    table.to_csv(path, index=False, lineterminator="\n")


def out_folder(folder: Path, option: str = "--out") -> Path:
    """Create and return a folder; a `UsageError` names the option if it is not writable."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        reason = error.strerror
        raise UsageError(f"{option}: {folder} cannot be written to: {reason}") from error
    return folder


def file_name(text: str) -> str:
    """Return a text as part of the name of a file, so that it cannot name another folder.

    Characters other than letters, digits, `-` and `_` become `_`. The result has at most 100
    characters.
    """
    return re.sub(r"[^\w-]", "_", text)[:100]
