"""Write files completely or not at all, keep results of tasks, and tell where they are from.

Also the two errors by which a command ends with a sentence: `UsageError` and `UnfinishedError`.
"""

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
from typing import Any

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


@dataclass(frozen=True)
class Kept:
    """Results of tasks in a folder, a file each, below a folder named after the commit.

    Nothing is kept or found while files of the checkout differ from the commit.
    """

    folder: Path

    def path(self, task: Callable[[], Any]) -> Path:
        """Return the file of a task, named after its function and arguments."""
        import joblib  # here: slow to import

        return self.folder / commit()[:12] / f"{joblib.hash(task)}.pkl"

    def load(self, task: Callable[[], Any]) -> Any:
        """Return the result of a task; None if it is missing or damaged."""
        with suppress(Exception):  # whatever a damaged file raises
            return pickle.loads(self.path(task).read_bytes()) if commit().isalnum() else None
        return None

    def save(self, task: Callable[[], Any], result: Any) -> None:
        """Write the result of a task, completely or not at all."""
        if commit().isalnum():  # neither missing nor dirty
            with replacing(self.path(task)) as partial:
                partial.write_bytes(pickle.dumps(result))


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
    status = ["git", "status", "--porcelain=v2", "--branch"]
    try:
        run = subprocess.run(status, cwd=ROOT, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return ""
    first, *others = run.stdout.splitlines()  # "# branch.oid NAME", more of it, and files
    changed = any(not line.startswith("#") for line in others)
    return first.split()[-1] + "-dirty" * changed
