"""Write text, JSON and CSV files with the same bytes on all operating systems."""

import json
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.lib.errors import UsageError


def write_text(path: Path, text: str) -> None:
    """Write `text` to the file `path`, in UTF-8 and with the line ends of Unix."""
    path.write_text(text, encoding="utf-8", newline="\n")


def write_json(path: Path, value: Any) -> None:
    """Write `value` to the JSON file `path`.

    Objects whose type JSON does not have, such as paths, are written as `str(object)`.
    """
    write_text(path, json.dumps(value, indent=2, default=str) + "\n")


def write_csv(path: Path, table: Any) -> None:
    """Write `table`, a DataFrame of pandas, to the CSV file `path`, without the row index."""
    table.to_csv(path, index=False, lineterminator="\n")


def out_folder(folder: Path, option: str = "--out") -> Path:
    """Create `folder` with its parent folders, if `folder` is missing, and return `folder`.

    Parameters
    ----------
    folder
        Folder that a user has chosen by a command-line option.
    option
        Name of the command-line option for the error message, such as "--out".

    Raises
    ------
    UsageError
        If `folder` cannot be created, or if no file can be written to `folder`.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        reason = error.strerror
        raise UsageError(f"{option}: {folder} cannot be written to: {reason}") from error
    return folder
