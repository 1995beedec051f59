"""Write files completely or not at all, and record the provenance of results."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime, timezone
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent.parent  # the checkout


class UnfinishedError(RuntimeError):
    """A command could not do all of its work, or write a file; the message says why."""


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path to write to, and move the file to `path` at the end.

    `path` is left as it was if there is an error or the process is killed.
    """
    # The suffix stays last, since some writers choose the format by it or append it.
    partial = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield partial
            partial.replace(path)
        finally:
            partial.unlink(missing_ok=True)
    except OSError as error:
        reason = error.strerror or error
        raise UnfinishedError(f"{path} could not be written: {reason}") from error


def write_text(path: Path, text: str) -> None:
    """Write a text file, completely or not at all."""
    with replacing(path) as partial:
        # The same line ends, and so the same bytes, on Windows as elsewhere.
        partial.write_text(text, encoding="utf-8", newline="\n")


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file, completely or not at all; paths are written as text."""
    write_text(path, json.dumps(value, indent=2, default=str) + "\n")


@dataclass(frozen=True)
class Kept:
    """Results in a folder, each in a file named after all that shapes it; see `key`."""

    folder: Path
    suffix: str = ".json"
    write: Callable[[Any, Path], object] = lambda x, file: file.write_text(json.dumps(x))
    """Writes a result. JSON gives floats back to the last digit, and tuples as lists."""
    read: Callable[[Path], Any] = lambda file: json.loads(file.read_bytes())
    """Reads it; raises a ValueError or OSError if the file is damaged or missing."""

    def load(self, task: Callable[[], Any]) -> Any:
        """Return the result of a task; raise a `LookupError` if it is missing or damaged."""
        try:
            return self.read(self.folder / f"{key(task)}{self.suffix}")
        except (ValueError, OSError) as error:
            raise LookupError(str(error)) from error

    def save(self, task: Callable[[], Any], result: Any) -> Any:
        """Write a result, completely or not at all, and return it as it is read.

        That of a task without a key is not written.
        """
        if not (name := key(task)):
            return result
        with replacing(self.folder / f"{name}{self.suffix}") as partial:
            self.write(result, partial)
        return self.load(task)


def key(*task: Any) -> str | None:
    """Return a hash of everything that shapes the result of a task.

    That is the task, the versions of packages and the code of the checkout. None stands for a
    task that cannot be hashed, such as a lambda.
    """
    import joblib  # here: slow to import

    try:
        return str(joblib.hash((task, versions(), code())))
    except Exception:  # whatever the pickling of an object raises
        return None


@cache
def code() -> str:
    """Return a hash of the code and the networks of the checkout."""
    packages = (ROOT / name for name in ("agents", "benchmarks", "mptc_gym"))
    files = (file for package in packages for file in package.rglob("*.*"))
    digest = hashlib.sha256()
    for file in sorted(file for file in files if file.suffix in (".py", ".npz")):
        digest.update(file.relative_to(ROOT).as_posix().encode() + file.read_bytes())
    return digest.hexdigest()


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
    started = datetime.now(timezone.utc).isoformat(timespec="seconds")
    return {"started": started, "versions": versions(), "commit": commit()}


def commit() -> str:
    """Return the checkout's commit, with "-dirty" if files differ; "unknown" without git."""
    describe = ["git", "describe", "--always", "--abbrev=40", "--dirty", "--exclude=*"]
    try:
        done = subprocess.run(describe, cwd=ROOT, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return done.stdout.strip()
