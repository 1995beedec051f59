"""Write files completely or not at all, keep results of tasks, and tell where they are from.

Also the two errors by which a command ends with a sentence: `UsageError` and `UnfinishedError`.
"""

from __future__ import annotations

import errno
import json
import os
import pickle
import platform
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime, timezone
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # pandas is slow to import
    import pandas as pd

ROOT = Path(__file__).resolve().parent.parent.parent  # the checkout


class UsageError(ValueError):
    """An option that does not fit, named by the message: the exit status is 2."""


class UnfinishedError(RuntimeError):
    """A command could not do all of its work, or write a file: the exit status is 1."""


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path to write to, and move the file to `path` at the end.

    `path` is left as it was if there is an error or the process is killed.
    """
    # Short, as names may have 255 bytes. The suffix stays last, since some writers choose the
    # format by it or append it.
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


def write_csv(path: Path, table: pd.DataFrame) -> None:
    """Write a table without its index, completely or not at all, the same on every system."""
    with replacing(path) as partial:
        table.to_csv(partial, index=False, lineterminator="\n")


def out_folder(folder: Path, option: str = "--out") -> Path:
    """Create and return the folder of an option; `UsageError` if it is not writable."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as probe:
            probe.write(b"x")
    except OSError as error:
        why = "it is no folder" if error.errno == errno.EEXIST else error.strerror
        raise UsageError(f"{option}: {folder} cannot be written to: {why}") from error
    return folder


@dataclass(frozen=True)
class Kept:
    """Results of tasks in a folder, a file each, below a folder named after the commit.

    Nothing is kept or found while files of the checkout differ from the commit.
    """

    folder: Path

    def path(self, task: Callable[[], Any]) -> Path | None:
        """Return the file of a task, named after its function and arguments.

        There is none without a commit, at one that is dirty, and of what cannot be pickled.
        """
        import joblib  # here: slow to import

        with suppress(Exception):
            if (name := commit()).isalnum():
                return self.folder / name[:12] / f"{joblib.hash(task)}.pkl"
        return None

    def load(self, task: Callable[[], Any]) -> Any:
        """Return the result of a task; None if it is missing or damaged."""
        path = self.path(task)
        with suppress(Exception):  # whatever a damaged file raises
            return pickle.loads(path.read_bytes()) if path else None
        return None

    def save(self, task: Callable[[], Any], result: Any) -> None:
        """Write the result of a task, completely or not at all."""
        if path := self.path(task):
            with replacing(path) as partial:
                partial.write_bytes(pickle.dumps(result))


@cache
def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that affect a result."""
    import mptc_gym  # here: Gymnasium and NumPy are slow to import

    found = {"python": platform.python_version(), "mptc_gym": mptc_gym.__version__}
    for package in ("gymnasium", "numpy", "optuna", "scipy", "stable_baselines3", "torch"):
        with suppress(metadata.PackageNotFoundError):
            found[package] = metadata.version(package)
    return found


def origin() -> dict[str, Any]:
    """Return the provenance of results made now: time, versions and commit."""
    now = datetime.now(timezone.utc).isoformat(timespec="seconds")
    return {"started": now, "versions": versions(), "commit": commit()}


@cache
def commit() -> str:
    """Return the checkout's commit, with "-dirty" if files differ; "" without git."""
    hashed, differing = ["git", "rev-parse", "HEAD"], ["git", "status", "--porcelain"]
    try:
        name, changes = (
            subprocess.run(each, cwd=ROOT, capture_output=True, text=True, check=True).stdout
            for each in (hashed, differing)
        )
    except (OSError, subprocess.CalledProcessError):
        return ""
    return name.strip() + "-dirty" * bool(changes)
