"""Write files completely or not at all."""

import json
import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from benchmarks.lib.errors import UnfinishedError, UsageError


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path to write to, and move the file to `path` at the end.

    `path` is left as it was if there is an error or the process is killed.
    """
    # The name is short, as names may have 255 bytes. The suffix stays last, since some writers
    # choose the format by it or append it.
    partial = path.with_name(f".{os.getpid()}.partial{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield partial
        partial.replace(path)
    except OSError as error:
        reason = error.strerror or error
        raise UnfinishedError(f"{path} could not be written: {reason}") from error
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file, completely or not at all."""
    with replacing(path) as partial:
        # The same line ends, and so the same bytes, on Windows as elsewhere.
        partial.write_text(text, encoding="utf-8", newline="\n")


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file, completely or not at all; paths are written as text."""
    write_text(path, json.dumps(value, indent=2, default=str) + "\n")


def write_csv(path: Path, table: Any) -> None:
    """Write a table of pandas without its index, completely or not at all."""
    with replacing(path) as partial:
        table.to_csv(partial, index=False, lineterminator="\n")


def out_folder(folder: Path, option: str = "--out") -> Path:
    """Create and return the folder of an option; `UsageError` if it is not writable."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        why = error.strerror
        raise UsageError(f"{option}: {folder} cannot be written to: {why}") from error
    return folder


def file_name(text: str) -> str:
    """Return a text as part of a file's name, without separators of folders.

    Anything but letters, digits, `-` and `_` becomes `_`; at most 100 characters are taken.
    """
    return re.sub(r"[^\w-]", "_", text)[:100]
