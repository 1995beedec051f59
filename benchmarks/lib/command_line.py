"""Report invalid options in a sentence, and check options that several commands share.

Only the standard library is imported here.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path


class UsageError(ValueError):
    """An invalid option, named by the message."""


@contextmanager
def blame(option: str) -> Iterator[None]:
    """Turn a ValueError into a `UsageError` that names the option."""
    try:
        yield
    except UsageError:
        raise
    except ValueError as error:
        raise UsageError(f"{option}: {error}") from error


def out_folder(folder: Path, option: str = "--out") -> Path:
    """Create and return the folder of an option; `UsageError` if it is not writable."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as probe:
            probe.write(b"x")
    except OSError as error:
        why = "it is no folder" if folder.exists() and not folder.is_dir() else error.strerror
        raise UsageError(f"{option}: {folder} cannot be written to: {why}") from error
    return folder


def known(option: str, given: Sequence[str], names: Sequence[str]) -> list[str]:
    """Return the names that an option lists, separated by spaces or commas, each once.

    A name that is not in `names` raises `UsageError`.
    """
    chosen = [name for text in given for name in text.split(",") if name]
    for name in chosen:
        if name not in names:
            raise UsageError(f"{option}: no {name!r}; there are {', '.join(names)}")
    return list(dict.fromkeys(chosen))
