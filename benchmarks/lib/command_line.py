"""Say in one sentence which option does not fit."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path


class UsageError(ValueError):
    """An option that does not fit. The message names it."""


@contextmanager
def blame(option: str) -> Iterator[None]:
    """Turn a ValueError into a `UsageError` that names an option."""
    try:
        yield
    except UsageError:
        raise
    except ValueError as error:
        raise UsageError(f"{option}: {error}") from error


def out_folder(folder: Path, option: str = "--out") -> Path:
    """Return the folder of an option, which is made; `UsageError` if it is not writable."""
    from benchmarks.lib.storage import NotWrittenError, check_folder

    try:
        check_folder(folder)
    except NotWrittenError as error:
        raise UsageError(f"{option}: {error}") from error
    return folder


def known(option: str, given: Sequence[str], names: Sequence[str]) -> list[str]:
    """Return the names that an option lists, with spaces or commas between them, each once.

    Raises
    ------
    UsageError
        If one of them is not among `names`.
    """
    chosen = [name for text in given for name in text.split(",") if name]
    for name in chosen:
        if name not in names:
            raise UsageError(f"{option}: no {name!r}; there are {', '.join(names)}")
    return list(dict.fromkeys(chosen))
