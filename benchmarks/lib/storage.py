"""Write texts and tables to files, with the same bytes on all systems."""

import json
import re
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.lib.errors import UsageError


def write_text(path: Path, text: str) -> None:
    """Write `text` to the file `path`, in UTF-8 and with the line ends of Unix."""
    path.write_text(text, encoding="utf-8", newline="\n")


def write_json(path: Path, value: Any) -> None:
    """Write `value` to the JSON file `path`.

    Objects of types that JSON does not have, such as paths, are written as `str(object)`.
    """
    write_text(path, json.dumps(value, indent=2, default=str) + "\n")


def write_csv(path: Path, table: Any) -> None:
    """Write `table`, a DataFrame of pandas, to the CSV file `path`, without the row index."""
    table.to_csv(path, index=False, lineterminator="\n")


def out_folder(folder: Path, option: str = "--out") -> Path:
    """Create a folder with its parent folders if it is missing, and return the folder.

    Parameters
    ----------
    folder
        The folder, which a user has chosen by an option of a command.
    option
        The option, such as "--out", which the error message names.

    Raises
    ------
    UsageError
        If the folder cannot be created, or if no file can be written to the folder.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        reason = error.strerror
        raise UsageError(f"{option}: {folder} cannot be written to: {reason}") from error
    return folder


def file_name(text: str) -> str:
    """Return `text` in a form that is safe as part of a file name.

    Characters other than letters, digits, `-` and `_` become `_`, so the result contains no
    path separator. The result has at most 100 characters.
    """
    return re.sub(r"[^\w-]", "_", text)[:100]
